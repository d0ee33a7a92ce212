// Bit-reproducible sums: over a block, and over the blocks' partial sums, in order.
#pragma once

#include "base/device.h"

namespace splat {
namespace cuda {

// Partial sums of a block's warps. T: int, float or double.
template <class T>
struct WarpSums {
    T of[kWarps];
};

// The sum over the warp's threads, in its first one.
template <class T>
__device__ inline T sum_of_warp(T value) {
    for (int step = kWarp / 2; step > 0; step /= 2) value += __shfl_down_sync(kWholeWarp, value, step);
    return value;
}

// The sum over the block's threads, in each of them.
template <class T>
__device__ inline T sum_of_block(T value, WarpSums<T>* sums) {
    value = sum_of_warp(value);
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    __syncthreads();  // the last sum is read
    if (threadIdx.x % kWarp == 0) sums->of[warp] = value;
    __syncthreads();
    T total = sums->of[0];
    for (int other = 1; other < kWarps; ++other) total += sums->of[other];
    return total;
}

}  // namespace cuda
}  // namespace splat
