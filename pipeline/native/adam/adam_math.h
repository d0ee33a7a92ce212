// Adam's step for one value, for kernel files: a vector on the CPU, a scalar on CUDA.
#pragma once

#if defined(__CUDACC__) || SPLAT_ON_CPU
#include "base/lane.h"
#else
#include "base/simd.h"
#endif

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

struct AdamConstants {
    Floats one_less_beta1, beta2, one_less_beta2, epsilon, inverse_root_correction;
};

SPLAT_INLINE AdamConstants adam_constants(float beta1, float beta2, float epsilon, float inverse_root_correction) {
    return {fill(1.0f - beta1), fill(beta2), fill(1.0f - beta2), fill(epsilon), fill(inverse_root_correction)};
}

struct AdamValues {
    Floats value, mean, square;  // the running means of the gradient and of its square
};

// `rate` includes the bias correction.
SPLAT_INLINE AdamValues adam_step(const AdamConstants& c, Floats rate, Floats gradient, const AdamValues& old) {
    AdamValues next;
    next.mean = fma(c.one_less_beta1, gradient - old.mean, old.mean);
    next.square = fma(c.beta2, old.square, c.one_less_beta2 * gradient * gradient);
    const Floats root = fma(sqrt(next.square), c.inverse_root_correction, c.epsilon);
    next.value = old.value - rate * next.mean / root;
    return next;
}

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
