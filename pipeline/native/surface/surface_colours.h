// Colours of points from a photo, by bicubic interpolation at the matching scale.
#pragma once

#include <cstdint>

#include "base/isa.h"
#include "surface/surface_sight.h"

namespace splat {

constexpr int kMostHalved = 6;  // maximum number of halvings: photos up to 64 times finer than the cells

// The mapping from a pinhole's pixels to a photo's: columns and rows of the photo at every `step` pixels of the
// pinhole's, linear in between.
struct Lens {
    double step;
    int rows, columns;    // at least 2
    const double* nodes;  // (rows, columns, 2); null: the photo is the pinhole's
};

// A photo, and its tone curves.
struct Photo {
    SurfaceCamera camera;  // a pinhole
    Lens lens;
    int width, height;           // of the photo itself
    const std::uint8_t* pixels;  // (height, width, 3)
    const std::uint8_t* tone;    // (256, 3)
};

// A part of a photo after `times` halvings: four bytes per pixel, the last one unused.
struct Halved {
    int left, top, width, height;   // of the part, halved pixels
    int whole_width, whole_height;  // of the photo
    int times;
    std::uint32_t* pixels;
};

struct ColourKernels {
    // Positions of points in a photo, and the number of halvings there; -1: not visible.
    void (*find)(const Photo& photo, const Places& places, double cell, const std::uint8_t* seen, double* column,
                 double* row, std::int8_t* times);
    // A row of a part after the tone curve; the photo's edge is replicated.
    void (*read)(const Photo& photo, int row, int left, int count, std::uint32_t* out);
    // Means of 2 x 2 pixels, from two rows of 2 * `count` pixels.
    void (*halve)(const std::uint32_t* upper, const std::uint32_t* lower, int count, std::uint32_t* out);
    // Colours of the points with this number of halvings.
    void (*sample)(const Halved& part, std::int64_t count, const double* column, const double* row,
                   const std::int8_t* times, std::uint8_t* colour);
};

// Colours of visible points; black elsewhere. Bit-identical whatever else is requested in the same call.
void sample_photo(const Photo& photo, const Places& places, double cell, const std::uint8_t* seen,
                  std::uint8_t* colour);

}  // namespace splat

SPLAT_DECLARE_KERNELS(ColourKernels, colour_sample_kernels)
