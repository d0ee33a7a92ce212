#include "loss/affine_colour.h"

#include <algorithm>
#include <array>
#include <cstddef>
#include <vector>

#include "base/threads.h"
#include "loss/colour.h"

namespace splat {
namespace {

std::int64_t chunks_of(std::int64_t pixels) { return (pixels + kColourChunk - 1) / kColourChunk; }

}  // namespace

void affine_colour(const float* map, const float* in, std::int64_t pixels, float* out) {
    const ColourKernels& kernels = SPLAT_KERNELS(colour_kernels);
    parallel_for(chunks_of(pixels), [&](std::int64_t chunk) {
        const std::int64_t first = chunk * kColourChunk, count = std::min(kColourChunk, pixels - first);
        kernels.forward(map, in + 3 * first, count, out + 3 * first);
    });
}

void affine_colour_backward(const float* map, const float* in, const float* upstream, std::int64_t pixels,
                            float* gradient, double* map_gradient) {
    const ColourKernels& kernels = SPLAT_KERNELS(colour_kernels);
    std::vector<std::array<float, kAffine>> sums(static_cast<std::size_t>(chunks_of(pixels)));
    parallel_for(chunks_of(pixels), [&](std::int64_t chunk) {
        const std::int64_t first = chunk * kColourChunk, count = std::min(kColourChunk, pixels - first);
        kernels.backward(map, in + 3 * first, upstream + 3 * first, count, gradient + 3 * first,
                         sums[static_cast<std::size_t>(chunk)].data());
    });
    std::fill_n(map_gradient, kAffine, 0.0);
    for (const auto& part : sums)  // in order
        for (int k = 0; k < kAffine; ++k) map_gradient[k] += double{part[static_cast<std::size_t>(k)]};
}

}  // namespace splat
