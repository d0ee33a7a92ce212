// The kernels' platform: CUDA, or with SPLAT_ON_CPU the harness of tests/harness, which runs the same sources on a CPU
// with threads in adversarial orders.
//
// Rules that keep both true: blocks are one-dimensional, of kThreads threads; shared memory is declared by
// SPLAT_SHARED, never cleared by itself; kernels are launched by SPLAT_LAUNCH, or SPLAT_LAUNCH_TOGETHER of grid.cuh;
// warp operations name the whole warp.
#pragma once

#include <stdint.h>

#if SPLAT_ON_CPU
#include "cuda_on_cpu.h"
#define SPLAT_UNROLL
#define SPLAT_ONCE
#define __grid_constant__
#else
#include <cuda_runtime.h>
#define SPLAT_SHARED(Type, name) __shared__ Type name
#define SPLAT_UNROLL _Pragma("unroll")  // for a loop over an array that has to be in registers
#define SPLAT_ONCE __noinline__         // for a function compiled once for all kernels that call it
#define SPLAT_LAUNCH(kernel, blocks, stream, ...) \
    kernel<<<static_cast<unsigned>(blocks), splat::cuda::kThreads, 0, stream>>>(__VA_ARGS__)
#endif

namespace splat {
namespace cuda {

constexpr int kThreads = 256;  // threads per block
constexpr int kWarp = 32;
constexpr int kWarps = kThreads / kWarp;
constexpr unsigned kWholeWarp = 0xffffffffu;

inline int64_t divide_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

}  // namespace cuda
}  // namespace splat
