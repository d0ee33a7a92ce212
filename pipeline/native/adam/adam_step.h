// One Adam step over all rows: tables and threads around the kernels. Not for kernel files.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

namespace splat {

// One tensor of (rows, width) floats, contiguous, with its gradient and moments; width is at most kAdamWidth.
struct AdamRows {
    float* values;
    const float* gradient;
    float *mean, *square;
    const float* rates;  // (width,): the learning rate of each column
    int width;
};

struct AdamOptions {
    double beta1, beta2, epsilon;
    std::int64_t step;  // counts from 1
};

inline bool are_adam_options(const AdamOptions& o) {
    return o.beta1 >= 0.0 && o.beta1 < 1.0 && o.beta2 >= 0.0 && o.beta2 < 1.0 && o.epsilon > 0.0 && o.step >= 1;
}

// Bias corrections for moments that started at zero.
struct AdamCorrections {
    double rate;         // factor for the learning rates
    float inverse_root;  // factor for the root of the second moment
};

inline AdamCorrections corrections_of(double beta1, double beta2, std::int64_t step) {
    const double steps = static_cast<double>(step);
    return {1.0 / (1.0 - std::pow(beta1, steps)), static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(beta2, steps)))};
}

// Steps the visible rows (null: all) of at most kAdamTensors tensors in place; rows with a gradient that is not finite
// are skipped. Returns the number of skipped rows.
std::int64_t adam_step(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
                       const AdamOptions& options);

}  // namespace splat
