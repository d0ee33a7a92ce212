// A step of Adam for rows, coalesced over a block's rows whatever their width. For step.cu and adam.cu.
#pragma once

#include "adam/adam_math.h"
#include "adam/adam_step.h"
#include "cuda/four.cuh"

namespace splat {
namespace cuda {
namespace {

// A tensor's rows from a block's first on.
struct MomentRows {
    float *values, *means, *squares;
};

// A block's rows of a tensor: those that are set in `steps` (bytes in shared memory) by gradient(row, column) with
// rate(column). Each float belongs to one thread, so rows may be changed while others of the block are still read.
template <class Gradient, class Rate>
__device__ __forceinline__ void step_rows(const MomentRows& at, int width, int rows, const uint8_t* steps,
                                          const lane::AdamConstants& c, const Gradient& gradient, const Rate& rate) {
    const int n = rows * width;
    for (int j = 4 * static_cast<int>(threadIdx.x); j < n; j += 4 * kThreads) {
        int row[4], column[4];
        bool set[4];
        row[0] = j / width, column[0] = j - row[0] * width;
        SPLAT_UNROLL
        for (int e = 0; e < 4; ++e) {
            if (e > 0) {
                const bool wraps = column[e - 1] + 1 == width;
                row[e] = wraps ? row[e - 1] + 1 : row[e - 1], column[e] = wraps ? 0 : column[e - 1] + 1;
            }
            set[e] = j + e < n && steps[row[e]];
        }
        if (!(set[0] || set[1] || set[2] || set[3])) continue;
        Four values = get_four(at.values + j, n - j), means = get_four(at.means + j, n - j);
        Four squares = get_four(at.squares + j, n - j);
        SPLAT_UNROLL
        for (int e = 0; e < 4; ++e) {
            if (!set[e]) continue;
            const lane::AdamValues next = lane::adam_step(c, rate(column[e]), gradient(row[e], column[e]),
                                                          {values.of[e], means.of[e], squares.of[e]});
            values.of[e] = next.value, means.of[e] = next.mean, squares.of[e] = next.square;
        }
        put_four(at.values + j, n - j, values), put_four(at.means + j, n - j, means);
        put_four(at.squares + j, n - j, squares);
    }
}

__device__ __forceinline__ void count_skipped(int64_t* skipped) {
    atomicAdd(reinterpret_cast<unsigned long long*>(skipped), 1ull);
}

// Whether a value is finite: a non-finite value times zero is NaN, which differs from itself.
__device__ __forceinline__ bool is_finite(float x) { return x * 0.0f == 0.0f; }

}  // namespace
}  // namespace cuda
}  // namespace splat
