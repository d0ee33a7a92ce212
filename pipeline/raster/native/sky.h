// Compositing a render over the sky, forward and backward: a band's kernels, compiled once per ISA.
//
// What is behind a pixel is interpolated bilinearly between nodes some pixels apart, as cuda/sky.cu does.
#pragma once

#include <cstdint>

#include "isa.h"

namespace splat {

constexpr int kSkyMostStep = 8;  // pixels from node to node

// One call's pictures and constants; a node lies at every step-th pixel of every step-th row, from the first on.
struct SkyJob {
    int width, height;
    int rows, columns, step;
    float background[3];         // what the render has behind it
    const float* colour;         // (height, width, 3)
    const float* alpha;          // (height, width)
    const float* nodes;          // (rows, columns, 3)
    const float* elsewhere;      // the same: seen instead where `around` is zero; null: nowhere
    const std::uint8_t* around;  // (height, width); null without `elsewhere`
    const std::uint8_t* mask;    // (height, width), where the nodes have a gradient; null: nowhere
};

// A band: the rows from one row of nodes to the next.
struct SkyKernels {
    // The render over what is behind, to a whole picture's `out`.
    void (*forward)(const SkyJob& job, int band, float* out);
    // dL/d(alpha) from dL/d(out), whole pictures. Where there is a mask, the band's shares of dL/d(nodes) of the rows
    // above and below go to `shares`, (2, columns, 3); it may be null.
    void (*backward)(const SkyJob& job, int band, const float* upstream, float* alpha_gradient, float* shares);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(SkyKernels, sky_kernels)
