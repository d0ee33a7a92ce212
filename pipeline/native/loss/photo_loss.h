// The photometric loss over a whole image: tiles, threads and the mask around the kernels. Not for kernel files.
#pragma once

#include <cstdint>

namespace splat {

// Columns [left, right) of rows [top, bottom).
struct LossRectangle {
    int left, top, right, bottom;
};

// Contiguous (height, width, 3) images of at least kLossMinSide pixels a side.
struct LossImages {
    const float *render, *photo;
    const std::uint8_t* mask;  // (height, width), zero does not count; null: every pixel counts
    float* gradient;           // with respect to the render; written whole
    int height, width;
    LossRectangle inner;  // not empty, within the image: what counts; windows look at everything
};

// (1 - w) L1 + w (1 - SSIM), means over the pixels of `inner` that count.
double photo_loss(const LossImages& images, double ssim_weight);

}  // namespace splat
