// Depth pixels as small planes, and the heights of cells from them.
#pragma once

#include <cstdint>

#include "isa.h"
#include "surface.h"

namespace splat {

constexpr double kHeightStep = 1e-4;  // metres: heights are whole multiples of this
// A height found in a cell is one whole number, to be sorted: the cell, the steps above the lowest height, how much of
// the cell is covered, and the confidence.
constexpr int kConfidenceBits = 3, kCoverBits = 8, kStepBits = 27, kCellBits = 26;
constexpr double kCoverUnit = 128.0;  // covered areas are counted in such parts of a cell
constexpr int kMostParts = 4;         // per side of a pixel; larger pixels leave gaps, which other photos fill
constexpr int kSlopeReach = 2;        // pixels around one that its slope is taken from
constexpr int kRowPadding = 64;       // values past the end of a row's inverse depths that may be read

// A row of pixels that is turned into heights of cells.
struct HeightRow {
    const DepthPicture& picture;
    const CellTile& tile;
    int row, left, right;  // of the pixels
    const float* const*
        inverses;  // rows of inverse depths from two above to two below; `left` is at kSlopeReach; padded
};

struct VoteKernels {
    // Inverse depths, NaN where there is none.
    void (*invert)(const float* depth, int count, float* inverse);
    // Where the row's pixels, as small planes, cover cells of the tile. Returns how many keys it wrote, kMostParts
    // squared a pixel at most.
    std::int64_t (*heights)(const HeightRow& job, std::uint64_t* keys);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(VoteKernels, vote_kernels)
