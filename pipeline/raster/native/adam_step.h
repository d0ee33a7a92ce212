// One Adam step over all rows: tables and threads around the kernels. Not for kernel files.
#pragma once

#include <cstdint>
#include <vector>

namespace splat {

// One tensor of (rows, width) floats, contiguous, with its gradient and moments; width is at most kAdamWidth.
struct AdamRows {
    float* values;
    const float* gradient;
    float *mean, *square;
    const float* rates;  // (width,): the learning rate of every column
    int width;
};

struct AdamOptions {
    double beta1, beta2, epsilon;
    std::int64_t step;  // counts from 1
};

// Steps the visible rows (null: all) of at most kAdamTensors tensors in place; a row with a gradient that is not finite
// is left as it is. Returns how many of those there were.
std::int64_t adam_step(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
                       const AdamOptions& options);

}  // namespace splat
