// Prefix sums: of a warp, of a block, and of an array by one block.
#pragma once

#include "base/device.h"

namespace splat {
namespace cuda {

constexpr int kScanItems = 8;  // per thread, for an array: few turns, since each waits for memory

__device__ inline int lane_index() { return static_cast<int>(threadIdx.x) % kWarp; }
__device__ inline int warp_index() { return static_cast<int>(threadIdx.x) / kWarp; }

// Inclusive prefix sum over the lanes.
template <class T>
__device__ inline T warp_inclusive(T value) {
    for (int step = 1; step < kWarp; step *= 2) {
        const T before = __shfl_up_sync(kWholeWarp, value, step);
        if (lane_index() >= step) value += before;
    }
    return value;
}

template <class T>
struct ScanShared {
    T warps[kWarps];
};

// Exclusive prefix sum over the block's threads; `total` gets the sum of all.
template <class T>
__device__ inline T block_exclusive(T value, ScanShared<T>* shared, T* total) {
    const T inclusive = warp_inclusive(value);
    if (lane_index() == kWarp - 1) shared->warps[warp_index()] = inclusive;
    __syncthreads();
    T before = 0, sum = 0;
    for (int warp = 0; warp < kWarps; ++warp) {
        if (warp == warp_index()) before = sum;
        sum += shared->warps[warp];
    }
    __syncthreads();  // before `shared` is used again
    *total = sum;
    return before + inclusive - value;
}

// A thread's kScanItems values from `begin` on, as far as there are `count`; returns their sum.
template <class T>
__device__ inline T read_items(const T* values, int64_t begin, int64_t count, T* items) {
    T sum = 0;
    SPLAT_UNROLL
    for (int i = 0; i < kScanItems; ++i) {
        items[i] = begin + i < count ? values[begin + i] : T{0};
        sum += items[i];
    }
    return sum;
}

// The sums before each of them; `before`: that before the first.
template <class T>
__device__ inline void write_items(T* values, int64_t begin, int64_t count, const T* items, T before) {
    SPLAT_UNROLL
    for (int i = 0; i < kScanItems; ++i) {
        if (begin + i < count) values[begin + i] = before;
        before += items[i];
    }
}

// Exclusive prefix sum in place by one block. Returns the total.
template <class T>
__device__ inline T scan_array(T* values, int64_t count, ScanShared<T>* shared) {
    T carry = 0;
    for (int64_t first = 0; first < count; first += kThreads * kScanItems) {
        const int64_t begin = first + static_cast<int64_t>(threadIdx.x) * kScanItems;
        T items[kScanItems], total;
        const T sum = read_items(values, begin, count, items);
        const T before = block_exclusive(sum, shared, &total);
        write_items(values, begin, count, items, carry + before);
        carry += total;
    }
    return carry;
}

// The same by one warp.
template <class T>
__device__ inline T scan_array_by_warp(T* values, int64_t count) {
    T carry = 0;
    for (int64_t first = 0; first < count; first += kWarp * kScanItems) {
        const int64_t begin = first + lane_index() * kScanItems;
        T items[kScanItems];
        const T sum = read_items(values, begin, count, items), up_to = warp_inclusive(sum);
        write_items(values, begin, count, items, carry + up_to - sum);
        carry += __shfl_sync(kWholeWarp, up_to, kWarp - 1);
    }
    return carry;
}

}  // namespace cuda
}  // namespace splat
