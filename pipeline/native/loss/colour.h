// Applying an affine map to an image's colours, forward and backward: a chunk's kernels, compiled once per ISA.
#pragma once

#include <cstdint>

#include "base/isa.h"

namespace splat {

constexpr int kAffine = 12;                     // floats: three rows of red, green, blue and one
constexpr std::int64_t kColourChunk = 1 << 14;  // maximum pixels per call; their sums are taken in float

struct ColourKernels {
    // out = map of in; (pixels, 3) floats each.
    void (*forward)(const float* map, const float* in, std::int64_t pixels, float* out);
    // dL/d(in) from dL/d(out), and the chunk's dL/d(map).
    void (*backward)(const float* map, const float* in, const float* upstream, std::int64_t pixels, float* gradient,
                     float* map_gradient);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(ColourKernels, colour_kernels)
