// Depths of a photo by PatchMatch: kernels for a row of pixels, compiled once per ISA, and the driver.
//
// Each pixel has a plane, linear in inverse depth over the photo's pixels: i(x, y) = i0 + across (x - x0) + down (y -
// y0). A plane (across, down, c) carries the pixel p = (x, y, 1) to (turn + shift (across, down, c)) p in another
// photo.
#pragma once

#include <cstdint>

#include "base/isa.h"

namespace splat {

constexpr int kPatchMostViews = 16;
constexpr float kPatchWorst = 2.0f;  // cost of a plane that no photo constrains

// A photo to compare with.
struct PatchView {
    int width, height;             // at least 4
    const std::uint32_t* corners;  // (height, width): four grey values per pixel: its own, right, below, below right
    const std::uint8_t* counts;    // (height, width)
    float turn[9], shift[3];       // from pixels of the photo to its own, as above
};

struct PatchJob {
    int width, height;
    const std::uint8_t* grey;    // (height, width)
    const std::uint8_t* counts;  // (height, width)
    const PatchView* views;
    int view_count;
    float least, most;  // inverse depths
    std::uint32_t seed;
    int begun;              // number of earlier iterations, each with smaller changes
    float* planes;          // (3, height, width): inverse depth at the pixel's centre, across and down a pixel
    float* costs;           // (height, width): 0 (alike) to 1 (unlike); kPatchWorst if no photo constrains it
    std::uint32_t* chosen;  // (height, width): the photos that a pixel is compared with at first; filled by `begin`
};

struct PatchKernels {
    // Costs of a row's planes; random ones where the inverse depth is not within the range.
    void (*begin)(const PatchJob& job, int row);
    // Every other pixel of a row, from `row + colour` on, takes a neighbour's plane or a small change of its own, if
    // that is better. Neighbours are of the other colour, so rows do not depend on each other.
    void (*improve)(const PatchJob& job, int row, int colour, int iteration);
};

// Processes rows on the pool's threads; bit-identical for any number of them.
// `job.chosen` is overwritten.
void patch_match(PatchJob job, int iterations);

}  // namespace splat

SPLAT_DECLARE_KERNELS(PatchKernels, patch_kernels)
