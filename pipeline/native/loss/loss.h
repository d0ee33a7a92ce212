// The photometric loss, (1 - w) L1 + w (1 - SSIM), with its gradient: a tile's kernel, compiled once per ISA.
#pragma once

#include <cstddef>
#include <cstdint>

#include "base/isa.h"

namespace splat {

// Pixels [row0, row1) x [col0, col1) of the image.
struct LossTile {
    int row0, row1, col0, col1;
};

// One call's images and constants. Images are (height, width, 3) float, contiguous.
struct LossJob {
    const float* render;  // masked pixels already replaced by the photo's
    const float* photo;
    const std::uint8_t* mask;  // (height, width), zero does not count; null: every pixel counts
    float* gradient;           // (height, width, 3), written whole
    int height;
    int width;
    LossTile inner;    // pixels outside are in windows but do not count
    float taps[6];     // the window's weight at a distance of 0..5 pixels
    float l1_scale;    // (1 - w) / (3 counting pixels)
    float ssim_scale;  // w / (3 counting pixels)
};

constexpr int kLossTileRows = 128;
constexpr int kLossTileCols = 192;
constexpr std::size_t kLossScratch = 120'000;  // floats a tile works in

// Sums over a tile's counting pixels and channels.
struct LossSums {
    double l1;
    double dissimilarity;  // 1 - SSIM
};

struct LossKernels {
    // The gradient of a tile's pixels, and their sums. scratch: kLossScratch floats, set once, aligned to 64 bytes.
    LossSums (*tile)(const LossJob& job, const LossTile& tile, float* scratch);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(LossKernels, loss_kernels)
