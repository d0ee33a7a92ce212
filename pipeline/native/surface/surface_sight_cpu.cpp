// Compiled once per ISA: internal linkage, no std templates.
#include "surface/surface_project.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr double kTolerancePixels = 3.0;  // pixel widths, perpendicular to the surface, within which depths agree
constexpr double kLeaning = 1.0;          // cost of a ray along the ground; one straight down costs nothing
constexpr double kCoarse = 0.5;           // cost of a photo half as fine as the cells,
constexpr double kCoarsest = 4.0;         // and the maximum multiple of it
constexpr double kRim = 0.06;     // of a photo's width: nearer to its edge it costs more, since lenses are worst there,
constexpr double kRimCost = 0.5;  // up to this much
constexpr double kMixedCost = 0.6;    // colours may be mixed there
constexpr double kUnknownCost = 0.3;  // added where the visibility is unknown
constexpr double kCostUnit = 1000.0;  // costs are integers in units of 1 / this

SPLAT_INLINE double greater(double a, double b) { return a > b ? a : b; }
SPLAT_INLINE double smaller(double a, double b) { return a < b ? a : b; }
SPLAT_INLINE double focal(const SurfaceCamera& camera) { return greater(camera.fx, camera.fy); }

// The minimum of a pixel's depth and its neighbours'; 0 if one of them has none. A point at an edge projects into a
// pixel that may show the background: only if all pixels around it do so as well, does the photo look through it.
SPLAT_INLINE float least_around(const DepthPicture& picture, int row, int column) {
    const int width = picture.camera.width, height = picture.camera.height;
    const int left = column > 0 ? column - 1 : 0, right = column + 1 < width ? column + 1 : column;
    const int top = row > 0 ? row - 1 : 0, bottom = row + 1 < height ? row + 1 : row;
    float least = picture.depth[static_cast<int64_t>(row) * width + column];
    for (int y = top; y <= bottom; ++y) {
        const float* depths = picture.depth + static_cast<int64_t>(y) * width;
        for (int x = left; x <= right; ++x) least = depths[x] < least ? depths[x] : least;
    }
    return least;
}

SPLAT_INLINE uint8_t said_of(const DepthPicture& picture, double y, double x, double depth, double limit) {
    const int row = static_cast<int>(y), column = static_cast<int>(x);
    const float near = picture.depth[static_cast<int64_t>(row) * picture.camera.width + column];
    if (!(near > 0.0f)) return kUnknown;
    const double behind = static_cast<double>(near) - depth;
    if (behind < -limit) return 0;
    const float least = least_around(picture, row, column);
    const double least_behind = static_cast<double>(least) - depth;
    if (behind <= limit) return static_cast<uint8_t>(kSeen | (least > 0.0f && least_behind < -limit ? kMixed : 0));
    return least > 0.0f && least_behind > limit ? kThrough : 0;
}

void look(const DepthPicture& picture, const Places& places, const double* sines, double least_m, uint8_t* said) {
    const SurfaceCamera& camera = picture.camera;
    const double pixel = kTolerancePixels / focal(camera);
    InPhoto at;
    double limits[kPlaces];
    for (int64_t first = 0; first < places.count; first += kPlaces) {
        project(camera, places, first, &at);
        const double* flat = sines ? sines + first : at.sine;
        for (int k = 0; k < at.count; ++k)
            limits[k] = greater(pixel * at.depth[k] / greater(flat[k], kFlattest), least_m);
        for (int k = 0; k < at.count; ++k)
            said[first + k] = at.is_in[k] ? said_of(picture, at.row[k], at.column[k], at.depth[k], limits[k]) : 0;
    }
}

int64_t rate(const SurfaceCamera& camera, const Places& places, double cell, const uint8_t* said, uint16_t* cost,
             uint8_t* seen) {
    const double per_rim = 1.0 / (kRim * camera.width), width = camera.width, height = camera.height;
    const double per_cell = 1.0 / (focal(camera) * cell);
    int64_t count = 0;
    InPhoto at;
    double totals[kPlaces];
    for (int64_t first = 0; first < places.count; first += kPlaces) {
        project(camera, places, first, &at);
        for (int k = 0; k < at.count; ++k) {
            const double sine = greater(at.sine[k], kFlattest), straight = smaller(sine, 1.0);
            const double coarse = smaller(greater(at.depth[k] * per_cell / sine - 1.0, 0.0), kCoarsest);
            const double edge =
                smaller(smaller(at.column[k], width - at.column[k]), smaller(at.row[k], height - at.row[k]));
            totals[k] = kLeaning * __builtin_sqrt(1.0 - straight * straight) + kCoarse * coarse +
                        kRimCost * greater(1.0 - edge * per_rim, 0.0);
        }
        for (int k = 0; k < at.count; ++k) {
            const uint8_t is = said[first + k];
            const bool is_seen = at.is_in[k] && (is & kSeen);
            seen[first + k] = is_seen, cost[first + k] = kHidden, count += is_seen;
            if (!at.is_in[k] || !(is & (kSeen | kUnknown))) continue;
            const double whole =
                kCostUnit * (totals[k] + (is & kMixed ? kMixedCost : 0.0) + (is & kUnknown ? kUnknownCost : 0.0)) + 0.5;
            cost[first + k] = static_cast<uint16_t>(static_cast<int>(smaller(whole, kHidden)));
        }
    }
    return count;
}

void confirm(const SurfaceCamera& camera, const float* inverse, const Places& places, const Agreeing& agreeing,
             double* sums, uint8_t* votes) {
    InPhoto at;
    for (int64_t first = 0; first < places.count; first += kPlaces) {
        project(camera, places, first, &at);
        for (int k = 0; k < at.count; ++k) {
            if (!at.is_in[k]) continue;
            const int64_t pixel = static_cast<int64_t>(at.row[k]) * camera.width + static_cast<int64_t>(at.column[k]);
            const double ratio = at.depth[k] * static_cast<double>(inverse[pixel]);  // to the depth found there
            const double far = agreeing.pixels * at.depth[k] / agreeing.parallax;
            const double most = smaller(greater(far, agreeing.share), agreeing.loosest), off = ratio - 1.0;
            if (!(off < most && -off < most)) continue;
            const double place[3] = {places.east[first + k], places.north[first + k], places.up[first + k]};
            for (int axis = 0; axis < 3; ++axis)
                sums[3 * (first + k) + axis] += camera.centre[axis] + (place[axis] - camera.centre[axis]) / ratio;
            ++votes[first + k];
        }
    }
}

}  // namespace

extern const SightKernels sight_kernels = {look, rate, confirm};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
