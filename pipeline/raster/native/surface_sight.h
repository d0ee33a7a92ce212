// Visibility of places in a photo, and the cost of colouring them from it.
#pragma once

#include <cstdint>

#include "isa.h"
#include "surface.h"

namespace splat {

// Places in the world; NaN is nowhere.
struct Places {
    std::int64_t count;
    const double *east, *north, *up;
};

// Flags: the visibility of a place in a photo.
constexpr std::uint8_t kSeen = 1;     // it sees the place
constexpr std::uint8_t kThrough = 2;  // it sees something behind it
constexpr std::uint8_t kMixed = 4;    // it sees it, but a nearer surface lies in the next pixel
constexpr std::uint8_t kUnknown = 8;  // it covers the place but has no depth there: it may see it

constexpr std::uint16_t kHidden = 4000;  // cost of a photo that does not see a place; the maximum cost

// Tolerances for two photos' depths of one place.
struct Agreeing {
    double share;     // of the depth;
    double pixels;    // far away as much of it as moves the place so far in the other photo,
    double loosest;   // of the depth at most
    double parallax;  // of something one unit deep between the two photos, pixels
};

struct SightKernels {
    // What the depths say; differences of up to `least` metres are none. `sines` are of the rays' angles against the
    // surface; null: against the ground.
    void (*look)(const DepthPicture& picture, const Places& places, const double* sines, double least,
                 std::uint8_t* said);
    // What it costs to colour cells by a photo of which `said` is said, and whether it sees them (0 or 1); returns how
    // many it sees.
    std::int64_t (*rate)(const SurfaceCamera& camera, const Places& places, double cell, const std::uint8_t* said,
                         std::uint16_t* cost, std::uint8_t* seen);
    // Where inverse depths (0: none) put places along the camera's rays: added to `sums` (count, 3) where they agree,
    // and a vote each.
    void (*confirm)(const SurfaceCamera& camera, const float* inverse, const Places& places, const Agreeing& agreeing,
                    double* sums, std::uint8_t* votes);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(SightKernels, sight_kernels)
