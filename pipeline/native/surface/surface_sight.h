// Visibility of points in a photo, and the cost of colouring them from it.
#pragma once

#include <cstdint>

#include "base/isa.h"
#include "surface/surface.h"

namespace splat {

// Points in the world; NaN for none.
struct Places {
    std::int64_t count;
    const double *east, *north, *up;
};

// Flags: the visibility of a point in a photo.
constexpr std::uint8_t kSeen = 1;     // it sees the point
constexpr std::uint8_t kThrough = 2;  // it sees something behind it
constexpr std::uint8_t kMixed = 4;    // it sees it, but a neighbouring pixel shows a nearer surface
constexpr std::uint8_t kUnknown = 8;  // the point projects into it but it has no depth there: may be visible

constexpr std::uint16_t kHidden = 4000;  // cost of a photo that does not see the point; the maximum cost

// Tolerances for two photos' depths of one point.
struct Agreeing {
    double share;     // of the depth;
    double pixels;    // for far points, the change of depth that moves the point so far in the other photo,
    double loosest;   // maximum, relative to the depth
    double parallax;  // between the two photos, of a point at unit depth, pixels
};

struct SightKernels {
    // Visibility by the depths; differences of up to `least` metres are ignored. `sines` are those of the rays' angles
    // to the surface; null: to the ground.
    void (*look)(const DepthPicture& picture, const Places& places, const double* sines, double least,
                 std::uint8_t* said);
    // The cost of colouring cells from a photo with the flags `said`, and whether it sees them (0 or 1); returns the
    // number that it sees.
    std::int64_t (*rate)(const SurfaceCamera& camera, const Places& places, double cell, const std::uint8_t* said,
                         std::uint16_t* cost, std::uint8_t* seen);
    // Adds the points that inverse depths (0: none) give along the camera's rays to `sums` (count, 3) where they agree,
    // and one vote each.
    void (*confirm)(const SurfaceCamera& camera, const float* inverse, const Places& places, const Agreeing& agreeing,
                    double* sums, std::uint8_t* votes);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(SightKernels, sight_kernels)
