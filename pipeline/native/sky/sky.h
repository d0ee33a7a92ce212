// Compositing a render over the sky, forward and backward: a band's kernels, compiled once per ISA.
//
// The colour behind a pixel is interpolated bilinearly between nodes some pixels apart, as in cuda/sky.cu.
#pragma once

#include <cstdint>

#include "base/isa.h"

namespace splat {

constexpr int kSkyMostStep = 8;  // maximum node spacing, pixels

// One call's images and constants; there is a node at every step-th pixel of every step-th row, starting at the first.
struct SkyJob {
    int width, height;
    int rows, columns, step;
    float background[3];         // the render's background
    const float* colour;         // (height, width, 3)
    const float* alpha;          // (height, width)
    const float* nodes;          // (rows, columns, 3)
    const float* elsewhere;      // the same: seen instead where `around` is zero; null: nowhere
    const std::uint8_t* around;  // (height, width); null without `elsewhere`
    const std::uint8_t* mask;    // (height, width), where the nodes have a gradient; null: nowhere
};

// A band: the rows from one row of nodes to the next.
struct SkyKernels {
    // Composites the render over the sky, into the whole image `out`.
    void (*forward)(const SkyJob& job, int band, float* out);
    // dL/d(alpha) from dL/d(out), whole images. Where there is a mask, the band's shares of dL/d(nodes) of the rows
    // above and below go to `shares`, (2, columns, 3); it may be null.
    void (*backward)(const SkyJob& job, int band, const float* upstream, float* alpha_gradient, float* shares);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(SkyKernels, sky_kernels)
