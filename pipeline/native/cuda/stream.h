// The caller's stream on the device of its tensors.
#pragma once

#include "base/device.h"
#include "cuda/api.h"

namespace splat {
namespace cuda {

// Makes the stream's device this thread's for what follows: cudart is linked statically, so that it has a current
// device of its own, whatever the caller's library has. Returns a code of api.h.
inline int32_t enter(const SplatStream* given, cudaStream_t* stream) {
    *stream = given ? static_cast<cudaStream_t>(given->stream) : nullptr;
    const cudaError_t error = given ? cudaSetDevice(given->device) : cudaSuccess;
    if (error) cudaGetLastError();  // clears the error, which is reported
    return static_cast<int32_t>(error);
}

}  // namespace cuda
}  // namespace splat
