// Kernels whose blocks wait for each other: all of them are on the device at once (a cooperative launch).
#pragma once

#include "base/device.h"

#if !SPLAT_ON_CPU
#include <cooperative_groups.h>
#define SPLAT_LAUNCH_TOGETHER(kernel, blocks, stream, ...) \
    splat::cuda::launch_together(kernel, blocks, stream, __VA_ARGS__)
#endif

namespace splat {
namespace cuda {

#if !SPLAT_ON_CPU
// A barrier of all threads of the grid: what was written before is read after it.
__device__ inline void sync_grid() { cooperative_groups::this_grid().sync(); }

template <class... Values, class... Arguments>
void launch_together(void (*kernel)(Values...), int64_t blocks, cudaStream_t stream, const Arguments&... arguments) {
    cudaLaunchAttribute together = {};
    together.id = cudaLaunchAttributeCooperative;
    together.val.cooperative = 1;
    cudaLaunchConfig_t config = {};
    config.gridDim = dim3(static_cast<unsigned>(blocks));
    config.blockDim = dim3(kThreads);
    config.stream = stream;
    config.attrs = &together, config.numAttrs = 1;
    cudaLaunchKernelEx(&config, kernel, arguments...);  // its error is that of cudaGetLastError, as of any launch
}
#endif

// As many blocks of a kernel as the device holds at once.
template <class Kernel>
int64_t blocks_together(Kernel* kernel) {
    int device = 0, multiprocessors = 1, each = 1;
    cudaGetDevice(&device);
    cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device);
    cudaOccupancyMaxActiveBlocksPerMultiprocessor(&each, kernel, kThreads, 0);
    return int64_t{multiprocessors} * each;
}

}  // namespace cuda
}  // namespace splat
