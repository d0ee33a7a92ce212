// Depth pixels as small planes, and the heights of cells from them.
#pragma once

#include <cstdint>

#include "base/isa.h"
#include "surface/surface.h"

namespace splat {

constexpr double kHeightStep = 1e-4;  // metres: heights are whole multiples of this
// A height in a cell is packed into one integer, for sorting: cell, steps above the lowest height, covered share of
// the cell, and confidence.
constexpr int kConfidenceBits = 3, kCoverBits = 8, kStepBits = 27, kCellBits = 26;
constexpr double kCoverUnit = 128.0;  // covered areas are in units of 1 / this of a cell
constexpr int kMostParts =
    4;  // a side: parts a pixel is divided into at most; larger pixels leave gaps, which other photos fill
constexpr int kSlopeReach = 2;   // pixels on each side that a slope is estimated from
constexpr int kRowPadding = 64;  // values past the end of a row's inverse depths that may be read

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
    // Keys of the cells of the tile that the row's pixels, as small planes, cover. Returns their number, at most
    // kMostParts squared per pixel.
    std::int64_t (*heights)(const HeightRow& job, std::uint64_t* keys);
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(VoteKernels, vote_kernels)
