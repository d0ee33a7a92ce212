// Colours of places from a photo, by a cubic that fits the scale.
#pragma once

#include <cstdint>

#include "isa.h"
#include "surface_sight.h"

namespace splat {

constexpr int kMostHalved = 6;  // times: a photo 64 times finer than the cells is softened no further

// The mapping from a pinhole's pixels to a photo's: columns and rows of the photo at every `step` pixels of the
// pinhole's, linear in between.
struct Lens {
    double step;
    int rows, columns;    // at least 2
    const double* nodes;  // (rows, columns, 2); null: the photo is the pinhole's
};

// A photo, and what becomes of each of its values in each channel.
struct Photo {
    SurfaceCamera camera;  // a pinhole
    Lens lens;
    int width, height;           // of the photo itself
    const std::uint8_t* pixels;  // (height, width, 3)
    const std::uint8_t* tone;    // (256, 3)
};

// A part of a photo that was halved some times: four bytes a pixel, the last one unused.
struct Halved {
    int left, top, width, height;   // of the part, halved pixels
    int whole_width, whole_height;  // of the photo
    int times;
    std::uint32_t* pixels;
};

struct ColourKernels {
    // Where places lie in a photo, and how often it is halved there; -1: not seen.
    void (*find)(const Photo& photo, const Places& places, double cell, const std::uint8_t* seen, double* column,
                 double* row, std::int8_t* times);
    // A row of a part, its values toned; the photo's rim goes on beyond it.
    void (*read)(const Photo& photo, int row, int left, int count, std::uint32_t* out);
    // Means of two by two pixels, of two rows of twice `count`.
    void (*halve)(const std::uint32_t* upper, const std::uint32_t* lower, int count, std::uint32_t* out);
    // Colours of the places for which the photo was halved this often.
    void (*sample)(const Halved& part, std::int64_t count, const double* column, const double* row,
                   const std::int8_t* times, std::uint8_t* colour);
};

// Colours of visible places; black elsewhere. Bit-identical whatever else is requested in the same call.
void sample_photo(const Photo& photo, const Places& places, double cell, const std::uint8_t* seen,
                  std::uint8_t* colour);

}  // namespace splat

SPLAT_DECLARE_KERNELS(ColourKernels, colour_sample_kernels)
