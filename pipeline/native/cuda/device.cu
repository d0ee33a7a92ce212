// Library and device information, and error texts.
#include "base/device.h"
#include "cuda/api.h"

namespace {

// Architectures that this was compiled for; the last one also has PTX, which newer devices compile themselves.
bool has_kernels_for(int architecture) {
#if defined(__CUDA_ARCH_LIST__)
    constexpr int kBuilt[] = {__CUDA_ARCH_LIST__};  // 100 * major + 10 * minor
    int newest = 0;
    for (const int built_times_10 : kBuilt) {
        const int built = built_times_10 / 10;
        if (built / 10 == architecture / 10 && built <= architecture) return true;
        newest = built > newest ? built : newest;
    }
    return architecture > newest;
#else
    return architecture > 0;
#endif
}

void copy_name(const char* from, char* to, int size) {
    int i = 0;
    for (; i + 1 < size && from[i]; ++i) to[i] = from[i];
    to[i] = '\0';
}

}  // namespace

int32_t splat_abi(void) { return SPLAT_CUDA_ABI; }

const char* splat_error(int32_t code) {
    switch (code) {
        case SPLAT_OK:
            return "no error";
        case SPLAT_BAD_ARGUMENT:
            return "an argument makes no sense";
        case SPLAT_TOO_LITTLE:
            return "less memory than was asked for";
        case SPLAT_NO_KERNEL:
            return "no kernel for this device";
        default:
            return cudaGetErrorString(static_cast<cudaError_t>(code));
    }
}

int32_t splat_device(int32_t device, SplatDevice* out) {
    if (!out) return SPLAT_BAD_ARGUMENT;
    *out = SplatDevice{};
    cudaDriverGetVersion(&out->driver);
    cudaRuntimeGetVersion(&out->runtime);
    cudaDeviceProp properties;
    const cudaError_t error = cudaGetDeviceProperties(&properties, device);
    if (error) {
        cudaGetLastError();  // clears the error, which has been reported
        return error;
    }
    out->architecture = 10 * properties.major + properties.minor;
    out->multiprocessors = properties.multiProcessorCount;
    out->memory_bytes = static_cast<int64_t>(properties.totalGlobalMem);
    copy_name(properties.name, out->name, static_cast<int>(sizeof(out->name)));
    return has_kernels_for(out->architecture) ? SPLAT_OK : SPLAT_NO_KERNEL;
}
