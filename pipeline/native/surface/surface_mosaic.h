// Assigns a photo to each cell: the best one, with seams where the photos look alike. Costs are integers, so that
// tiles agree where they overlap.
#pragma once

#include <cstdint>

#include "base/isa.h"
#include "surface/surface_sight.h"

namespace splat {

constexpr int kSoft = 2;     // cells on either side over which photos are blurred before they are compared
constexpr int kSmooth = 10;  // cells on either side that a cell's costs are averaged over
constexpr int kSweeps = 6;   // number of passes that move seams to cheaper places
constexpr int kFeather = 2;  // cells on either side of a seam over which photos blend
constexpr int kMosaicMargin = kSmooth + kSoft + 2 * kSweeps + kFeather + 1;  // cells that a cell's colour depends on
constexpr std::uint16_t kNever = UINT16_MAX;  // averaged cost of a photo that does not see the cell: above all others
constexpr int kMostKept = 16;                 // maximum number of photos per cell in `keep_best`
constexpr int kCounted = 1 << 13;             // so that one sum contains up to 25 greys and their number

struct MosaicJob {
    int photos, width, height;
    int parity;                  // of the first cell's row plus column in the whole picture
    const std::uint8_t* seen;    // (photos, height, width), 0 or 1
    const std::uint8_t* colour;  // (photos, height, width, 3), levelled
    std::uint16_t* cost;         // (photos, height, width), at most kHidden; changed
};

struct MosaicResult {
    std::int16_t* label;   // (height, width); -1: no photo sees it
    std::uint8_t* colour;  // (height, width, 3); black there
};

// A row of all photos: blurred greys, and scratch memory.
struct LikenessRow {
    int photos, width;
    std::int64_t stride;       // from photo to photo in the next two arrays
    const std::uint8_t* seen;  // at the row, as above
    std::uint16_t* cost;       // likewise
    const std::uint8_t* soft;  // (photos, width)
    float* weights;            // (photos, width)
    float *total, *mean;       // (width)
};

struct MosaicKernels {
    // Inserts a photo's costs among the `most` lowest ones of each cell that it sees, and counts the photo.
    void (*rank)(const std::uint8_t* seen, const std::uint16_t* cost, int most, std::int64_t cells,
                 std::uint16_t* least, std::uint8_t* seen_by);
    // Marks photos as not seeing the cells where their costs exceed the limits.
    void (*drop)(const std::uint16_t* cost, const std::uint16_t* limits, std::int64_t cells, std::uint8_t* seen);
    void (*grey)(const std::uint8_t* colour, std::int64_t count, std::uint8_t* grey);
    // Greys of visible cells plus kCounted; 0 for others.
    void (*tag)(const std::uint8_t* grey, const std::uint8_t* seen, std::int64_t count, std::uint16_t* tagged);
    // Means of the visible ones, from sums of the output of `tag`.
    void (*soften)(const std::int32_t* sums, int count, std::uint8_t* soft);
    // Updates column sums by an added and a removed row; null: none.
    void (*slide)(const std::uint16_t* met, const std::uint16_t* left, int count, std::int32_t* sums);
    // Sums of `2 * radius + 1` columns in a row.
    void (*across)(const std::int32_t* sums, int radius, int count, std::int32_t* out);
    // Extra cost of photos that differ from most: cars that moved, objects missing in the depths.
    void (*compare)(const LikenessRow& row);
    // Averages of costs, and for each cell the first photo with the lowest one.
    void (*choose)(const std::int32_t* totals, const std::uint8_t* seen, int photo, int count, std::uint16_t* average,
                   std::uint16_t* least, std::int16_t* label);
};

// Keeps for each cell the `most` photos of lowest cost that see it, or more where costs are equal; returns how many
// saw it, at most 255.
void keep_best(int photos, std::int64_t cells, int most, const std::uint16_t* cost, std::uint8_t* seen,
               std::uint8_t* seen_by);

// Colours of a tile's cells; those within kMosaicMargin of its edge are not final.
void compose_mosaic(const MosaicJob& job, const MosaicResult& out);

}  // namespace splat

SPLAT_DECLARE_KERNELS(MosaicKernels, mosaic_kernels)
