// A step of Adam for tensors with common rows, for the auxiliary models.
#include "adam/adam.h"
#include "cuda/frame.h"
#include "cuda/step.cuh"
#include "cuda/stream.h"

namespace splat {
namespace cuda {
namespace {

static_assert(SPLAT_ADAM_TENSORS == kAdamTensors, "as many as on the CPU");

struct AdamShared {
    float rates[kAdamTensors][kAdamWidth];  // with their bias correction
    int is_infinite[kThreads];              // whether a row has a gradient that is not finite
    uint8_t steps[kThreads];
};

// By value.
struct AdamStep {
    SplatAdam of;
    double rate_correction;
    float inverse_root_correction;
};

// Determines which of a block's rows step, and counts those skipped for their gradients. Its barriers are all that a
// block's turns need.
__device__ __forceinline__ bool find_stepping(const SplatAdam& adam, int64_t first, int rows, AdamShared* shared) {
    const int thread = threadIdx.x;
    shared->is_infinite[thread] = 0;
    __syncthreads();
    for (int t = 0; t < adam.tensors; ++t) {
        const float* gradient = adam.gradients[t] + first * adam.widths[t];
        for (int j = thread; j < rows * adam.widths[t]; j += kThreads)
            if (!is_finite(gradient[j])) atomicOr(&shared->is_infinite[j / adam.widths[t]], 1);
    }
    __syncthreads();
    bool steps = thread < rows && (!adam.visible || adam.visible[first + thread]);
    if (steps && shared->is_infinite[thread]) {
        steps = false;
        count_skipped(adam.skipped);
    }
    shared->steps[thread] = steps;
    return __syncthreads_or(steps);
}

__global__ void __launch_bounds__(kThreads) adam_kernel(const AdamStep step) {
    SPLAT_SHARED(AdamShared, shared);
    const SplatAdam& adam = step.of;
    for (int t = 0; t < adam.tensors; ++t)
        for (int column = threadIdx.x; column < adam.widths[t]; column += kThreads)
            shared.rates[t][column] = static_cast<float>(step.rate_correction * adam.rates[t][column]);
    const lane::AdamConstants c = lane::adam_constants(static_cast<float>(adam.beta1), static_cast<float>(adam.beta2),
                                                       static_cast<float>(adam.epsilon), step.inverse_root_correction);
    for (int64_t first = int64_t{blockIdx.x} * kThreads; first < adam.rows; first += int64_t{gridDim.x} * kThreads) {
        const int rows = static_cast<int>(adam.rows - first < kThreads ? adam.rows - first : kThreads);
        if (find_stepping(adam, first, rows, &shared))
            for (int t = 0; t < adam.tensors; ++t) {
                const int width = adam.widths[t];
                const int64_t begin = first * width;
                const float *gradients = adam.gradients[t] + begin, *rates = shared.rates[t];
                step_rows(
                    {adam.values[t] + begin, adam.means[t] + begin, adam.squares[t] + begin}, width, rows, shared.steps,
                    c, [=](int row, int column) { return gradients[row * width + column]; },
                    [=](int column) { return rates[column]; });
            }
    }
}

bool is_sound(const SplatAdam& adam) {
    if (adam.tensors < 0 || adam.tensors > SPLAT_ADAM_TENSORS || adam.rows < 0 || !adam.skipped) return false;
    if (!are_adam_options({adam.beta1, adam.beta2, adam.epsilon, adam.step})) return false;
    for (int t = 0; t < adam.tensors; ++t) {
        if (adam.widths[t] < 1 || adam.widths[t] > kAdamWidth || !adam.rates[t]) return false;
        if (adam.rows > 0 && !(adam.values[t] && adam.gradients[t] && adam.means[t] && adam.squares[t])) return false;
    }
    return true;
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat;
using namespace splat::cuda;

int32_t splat_adam(const SplatAdam* adam, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (!adam || !is_sound(*adam)) return SPLAT_BAD_ARGUMENT;
    if (adam->rows == 0 || adam->tensors == 0) return SPLAT_OK;
    const AdamCorrections corrections = corrections_of(adam->beta1, adam->beta2, adam->step);
    const AdamStep step = {*adam, corrections.rate, corrections.inverse_root};
    SPLAT_LAUNCH(adam_kernel, blocks_for(divide_up(adam->rows, kThreads)), stream, step);
    return static_cast<int32_t>(cudaGetLastError());
}
