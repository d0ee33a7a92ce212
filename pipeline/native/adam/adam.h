// Adam (Kingma and Ba, ICLR 2015) over tensors with common rows, one per Gaussian; compiled once per ISA.
#pragma once

#include <cstdint>

#include "base/isa.h"

namespace splat {

constexpr int kAdamBlock = 16;      // rows processed at once, a multiple of any vector's lanes
constexpr int kAdamTaskRows = 256;  // maximum rows per call: their gradients stay in the cache between two passes
constexpr int kAdamWidth = 64;      // maximum floats per row of one tensor
constexpr int kAdamTensors = 8;     // maximum tensors per call

// One tensor of (rows, width) floats, contiguous, with its gradient and moments.
struct AdamTensor {
    float* values;
    const float* gradient;
    float* mean;         // running mean of the gradient
    float* square;       // running mean of its square
    const float* rates;  // (kAdamBlock, width): the step size of every column, bias correction included, repeated
    const std::int32_t* row_of;  // (kAdamBlock, width): the row of each value in a block
    int width;
};

struct AdamJob {
    AdamTensor tensors[kAdamTensors];
    int tensor_count;
    std::int64_t rows;
    const std::uint8_t* visible;  // (rows,): rows with zero are not stepped; null: all rows are
    float beta1, beta2, epsilon;
    float inverse_root_correction;  // 1 / sqrt(1 - beta2^step)
};

struct AdamKernels {
    // Steps rows [from, to), at most kAdamTaskRows; rows with a gradient that is not finite are skipped.
    // Returns the number of skipped rows.
    std::int64_t (*rows)(const AdamJob& job, std::int64_t from, std::int64_t to);
    // The same for `count` rows at arbitrary indices; -1 skips one. gradients[t]: their gradients for tensor t, stored
    // contiguously, used instead of the job's; whole vectors are read.
    std::int64_t (*some)(const AdamJob& job, const std::int32_t* rows, int count, const float* const* gradients);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(AdamKernels, adam_kernels)
