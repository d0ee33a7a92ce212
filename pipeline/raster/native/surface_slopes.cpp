#include "surface_slopes.h"

#include <algorithm>
#include <cstdint>
#include <limits>

namespace splat {

InverseRows::InverseRows(const float* depth, int width, int height, int left, int right)
    : depth_(depth),
      width_(width),
      height_(height),
      left_(left),
      right_(right),
      stride_(static_cast<std::size_t>(right - left) + 2 * kSlopeReach + kRowPadding),
      ring_(kRows * stride_) {}

const float* const* InverseRows::around(int row) {
    for (next_ = std::max(next_, row - kSlopeReach); next_ <= row + kSlopeReach; ++next_) fill(next_);
    for (int k = 0; k < kRows; ++k) rows_[k] = at(row - kSlopeReach + k);
    return rows_;
}

void InverseRows::fill(int row) {
    float* out = at(row);
    std::fill(out, out + stride_, std::numeric_limits<float>::quiet_NaN());
    if (row < 0 || row >= height_) return;
    const int first = std::max(left_ - kSlopeReach, 0), last = std::min(right_ + kSlopeReach, width_);
    SPLAT_KERNELS(vote_kernels)
        .invert(depth_ + static_cast<std::int64_t>(row) * width_ + first, last - first,
                out + (first - left_ + kSlopeReach));
}

void find_slopes(const float* depth, int width, int height, double focal, float* slopes) {
    InverseRows inverses(depth, width, height, 0, width);
    for (int row = 0; row < height; ++row) {
        float* across = slopes + static_cast<std::int64_t>(row) * width;
        SPLAT_KERNELS(vote_kernels)
            .slopes(inverses.around(row), width, focal, across, across + static_cast<std::int64_t>(height) * width);
    }
}

}  // namespace splat
