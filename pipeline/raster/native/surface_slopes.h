// Slopes of depths, and the rows of inverse depths that they are taken from.
#pragma once

#include <cstddef>
#include <vector>

#include "surface_votes.h"

namespace splat {

// Five rows of a picture's inverse depths, from two above a row to two below; NaN beyond the picture.
class InverseRows {
  public:
    static constexpr int kRows = 2 * kSlopeReach + 1;

    InverseRows(const float* depth, int width, int height, int left, int right);

    // The rows around a row, each from kSlopeReach before `left` on, padded; to be asked for row after row.
    const float* const* around(int row);

  private:
    void fill(int row);
    float* at(int row) { return ring_.data() + static_cast<std::size_t>((row + kRows) % kRows) * stride_; }

    const float* depth_;
    int width_, height_, left_, right_, next_ = -kSlopeReach - 1;
    std::size_t stride_;
    std::vector<float> ring_;
    const float* rows_[kRows];
};

// How the inverse depths of a picture grow, a pixel to the right and down: (2, height, width), NaN where not known.
void find_slopes(const float* depth, int width, int height, double focal, float* slopes);

}  // namespace splat
