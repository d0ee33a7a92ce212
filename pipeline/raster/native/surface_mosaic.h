// Which photo colours which cell: the best one, with seams where the photos look alike. Costs are integers, so that
// tiles agree where they overlap.
#pragma once

#include <cstdint>

#include "isa.h"
#include "surface_sight.h"

namespace splat {

constexpr int kSoft = 2;     // cells on either side over which photos are softened before they are compared
constexpr int kSmooth = 10;  // cells on either side that a cell's costs are averaged over
constexpr int kSweeps = 6;   // in which seams move to better places
constexpr int kFeather = 2;  // cells on either side of a seam over which photos blend
constexpr int kMosaicMargin = kSmooth + kSoft + 2 * kSweeps + kFeather + 1;  // cells that a cell's colour depends on
constexpr std::uint16_t kNever = UINT16_MAX;  // averaged cost of a photo that does not see a cell: more than any other
constexpr int kMostKept = 16;                 // photos of a cell that `keep_best` can be asked for
constexpr int kCounted = 1 << 13;             // so that one sum holds greys and their number: of 25 greys at most

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

// A row of all photos: softened greys, and room for numbers.
struct LikenessRow {
    int photos, width;
    std::int64_t stride;       // from photo to photo in what follows
    const std::uint8_t* seen;  // at the row, as above
    std::uint16_t* cost;       // likewise
    const std::uint8_t* soft;  // (photos, width)
    float* weights;            // (photos, width)
    float *total, *mean;       // (width)
};

struct MosaicKernels {
    // Puts a photo's costs among the least ones of each cell, `most` rows of them, where it sees the cell; and counts
    // it.
    void (*rank)(const std::uint8_t* seen, const std::uint16_t* cost, int most, std::int64_t cells,
                 std::uint16_t* least, std::uint8_t* seen_by);
    // Photos no longer see cells where their costs are higher than the limits.
    void (*drop)(const std::uint16_t* cost, const std::uint16_t* limits, std::int64_t cells, std::uint8_t* seen);
    void (*grey)(const std::uint8_t* colour, std::int64_t count, std::uint8_t* grey);
    // Greys of cells that are seen, plus kCounted; 0 of others.
    void (*tag)(const std::uint8_t* grey, const std::uint8_t* seen, std::int64_t count, std::uint16_t* tagged);
    // Means of those that are seen from sums of what `tag` wrote.
    void (*soften)(const std::int32_t* sums, int count, std::uint8_t* soft);
    // Sums of columns change by a row that is met and one that is left; null: none.
    void (*slide)(const std::uint16_t* met, const std::uint16_t* left, int count, std::int32_t* sums);
    // Sums of `2 * radius + 1` columns in a row.
    void (*across)(const std::int32_t* sums, int radius, int count, std::int32_t* out);
    // Extra cost of photos that differ from most: cars that moved, objects missing in the depths.
    void (*compare)(const LikenessRow& row);
    // Averages of costs, and of each cell the first photo with the least one.
    void (*choose)(const std::int32_t* totals, const std::uint8_t* seen, int photo, int count, std::uint16_t* average,
                   std::uint16_t* least, std::int16_t* label);
};

// Leaves each cell the `most` photos of least cost that see it, or more where costs are the same; tells how many saw
// it, 255 at most.
void keep_best(int photos, std::int64_t cells, int most, const std::uint16_t* cost, std::uint8_t* seen,
               std::uint8_t* seen_by);

// Colours of a tile's cells; those within kMosaicMargin of its rim are not final.
void compose_mosaic(const MosaicJob& job, const MosaicResult& out);

}  // namespace splat

SPLAT_DECLARE_KERNELS(MosaicKernels, mosaic_kernels)
