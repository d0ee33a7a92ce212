// Projection of points into a photo, in batches: for kernel files.
#pragma once

#include "base/simd.h"
#include "surface/surface_sight.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kPlaces = 64;        // at a time: their values stay in the L1 cache
constexpr double kFlattest = 0.2;  // sine of a ray's angle to the ground; flatter ones are treated as this

struct InPhoto {
    int count;
    double column[kPlaces], row[kPlaces];  // the first pixel's centre is at 0.5
    double depth[kPlaces];                 // along the camera's z
    double sine[kPlaces];                  // of the ray's angle to the ground
    uint8_t is_in[kPlaces];                // the point is in front of the camera and inside the photo
};

SPLAT_INLINE void project(const SurfaceCamera& camera, const Places& places, int64_t first, InPhoto* out) {
    const double* m = camera.turn;
    const double *east = places.east + first, *north = places.north + first, *up = places.up + first;
    out->count = places.count - first < kPlaces ? static_cast<int>(places.count - first) : kPlaces;
    const double width = camera.width, height = camera.height;
    for (int k = 0; k < out->count; ++k) {
        const double x = m[0] * east[k] + m[1] * north[k] + m[2] * up[k] + camera.shift[0];
        const double y = m[3] * east[k] + m[4] * north[k] + m[5] * up[k] + camera.shift[1];
        const double z = m[6] * east[k] + m[7] * north[k] + m[8] * up[k] + camera.shift[2];
        const double column = camera.fx * x / z + camera.cx, row = camera.fy * y / z + camera.cy;
        out->column[k] = column, out->row[k] = row, out->depth[k] = z;
        out->sine[k] = (camera.centre[2] - up[k]) / __builtin_sqrt(x * x + y * y + z * z);
        out->is_in[k] = (z > 0.0) & (column >= 0.0) & (column < width) & (row >= 0.0) & (row < height);
    }
}

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
