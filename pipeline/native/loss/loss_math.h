// The photometric loss's formulas, for a vector of values in a CPU's kernel file and for one value on a device.
// Everything has internal linkage (see isa.h).
//
// With u = render + photo - 1 and v = render - photo, the four windowed means of u, v, u^2, v^2 give SSIM, and 1 - SSIM
// without cancellation where render and photo agree. Its gradient is the transposed blur (B^T) of three maps:
//   d/d render = B^T(a) + 2 u B^T(b_u) + 2 v B^T(b_v).
#pragma once

#include <math.h>

#if defined(__CUDACC__)
#define SPLAT_LOSS_INLINE static __host__ __device__ __forceinline__
#else
#define SPLAT_LOSS_INLINE static inline __attribute__((always_inline))
#endif

namespace splat {

constexpr int kLossRadius = 5, kLossTaps = 2 * kLossRadius + 1;
constexpr int kLossBorder = kLossRadius + 1;  // pixels whose mirror images a window reaches
constexpr int kLossMinSide = 6;               // half the window must be reflected within the image
constexpr double kLossWindowSigma = 1.5;      // pixels
constexpr float kLossC1 = 0.01f * 0.01f, kLossC2 = 0.03f * 0.03f;
constexpr float kLossEpsilon = 1e-12f;  // as in kornia's denominator

// The window's weight at a distance of 0..kLossRadius pixels.
static inline void set_loss_taps(float* taps) {
    double weights[kLossRadius + 1], sum = 0.0;
    for (int d = 0; d <= kLossRadius; ++d) {
        weights[d] = exp(-0.5 * d * d / (kLossWindowSigma * kLossWindowSigma));
        sum += d ? 2.0 * weights[d] : weights[d];
    }
    for (int d = 0; d <= kLossRadius; ++d) taps[d] = static_cast<float>(weights[d] / sum);
}

// The row (or column) that reflection about the border's pixel centre shows at i; far outside, any valid one.
SPLAT_LOSS_INLINE int reflected(int i, int n) {
    const int mirrored = i < 0 ? -i : (i >= n ? 2 * (n - 1) - i : i);
    return mirrored < 0 ? 0 : (mirrored > n - 1 ? n - 1 : mirrored);
}

// What pixel i of n receives from a pixel at most kLossRadius away in the transposed blur.
SPLAT_LOSS_INLINE float transposed_tap(const float* taps, int i, int from, int n) {
    if (from < 0 || from >= n) return 0.0f;
    const int left = i + from, right = 2 * (n - 1) - i - from;  // distances to i's mirror images
    float tap = taps[from < i ? i - from : from - i];
    if (i > 0 && left <= kLossRadius) tap += taps[left];
    if (i < n - 1 && right <= kLossRadius) tap += taps[right];
    return tap;
}

// F: float, or a vector of them. From windowed means, of u, u^2, v, v^2: 1 - SSIM, and the maps a, b_u, b_v.
template <class F>
SPLAT_LOSS_INLINE F dissimilarity_of(F mu_shifted, F mean_u2, F mv, F mean_v2, F* by_means, F* by_u2, F* by_v2) {
    const F mu = mu_shifted + 1.0f, mv2 = mv * mv;
    const F var_u = mean_u2 - mu_shifted * mu_shifted;  // 2 (sxx + syy) = var_u + var_v
    const F var_v = mean_v2 - mv2;                      // 4 sxy = var_u - var_v
    const F luminance_down = 0.5f * (mu * mu + mv2) + kLossC1;
    const F contrast_down = 0.5f * (var_u + var_v) + kLossC2, contrast_up = contrast_down - var_v;
    const F inverse = 1.0f / (luminance_down * contrast_down + kLossEpsilon);
    const F f = (luminance_down * var_v + contrast_up * mv2 + kLossEpsilon) * inverse;
    const F by_luminance = (var_v - f * contrast_down) * inverse;
    const F common = 0.5f * f * luminance_down;
    *by_u2 = (0.5f * mv2 - common) * inverse;
    *by_v2 = (luminance_down - 0.5f * mv2 - common) * inverse;
    *by_means =
        mu * by_luminance - 2.0f * mu_shifted * *by_u2 + mv * (by_luminance + 2.0f * (contrast_up * inverse - *by_v2));
    return f;
}

}  // namespace splat
