// Reading and writing sixteen bytes at a time.
#pragma once

#include "base/lane.h"

namespace splat {
namespace cuda {
namespace {

// Sixteen bytes in one transaction.
struct alignas(16) Four {
    float of[4];
};

__device__ __forceinline__ bool is_aligned(const float* p) { return (reinterpret_cast<uintptr_t>(p) & 15) == 0; }

// The first four of the `left` available floats; missing ones are zero.
__device__ __forceinline__ Four get_four(const float* p, int left) {
    if (left >= 4 && is_aligned(p)) return *reinterpret_cast<const Four*>(p);
    Four four;
    SPLAT_UNROLL
    for (int e = 0; e < 4; ++e) four.of[e] = e < left ? p[e] : 0.0f;
    return four;
}

__device__ __forceinline__ void put_four(float* p, int left, const Four& four) {
    if (left >= 4 && is_aligned(p)) {
        *reinterpret_cast<Four*>(p) = four;
        return;
    }
    SPLAT_UNROLL
    for (int e = 0; e < 4; ++e)
        if (e < left) p[e] = four.of[e];
}

}  // namespace
}  // namespace cuda
}  // namespace splat
