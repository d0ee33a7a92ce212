// Heights of cells from many photos' depths: each photo's votes, surfaces that several agree on, and a robust mean.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "surface/surface.h"

namespace splat {

constexpr int kSurfaceLayers = 3;  // stacked surfaces considered per cell

// A height that a photo found in a cell.
struct Vote {
    double height;
    float sigma;             // expected deviation, metres
    std::int32_t weight;     // how much it counts
    std::int32_t cell;       // of the tile
    std::uint16_t cover;     // how much of the cell it covers, in parts of kCoverUnit
    std::uint8_t confirmed;  // maximum number of confirming photos
};

// Surfaces that enough photos agree on, from the top: (kSurfaceLayers, cells).
struct LayerPlanes {
    double* height;  // of the middle vote; NaN where a cell has none
    std::int32_t* count;
    double* cover;  // share of the cell
};

// Robust means of cells.
struct FitPlanes {
    double* height;  // NaN if there is none
    double* sigma;
    std::int32_t* photos;  // that agree: votes, or photos that confirm one where those are more
};

class CellVotes {
  public:
    explicit CellVotes(const CellTile& tile);
    int cells() const { return tile_.height * tile_.width; }
    const CellTile& tile() const { return tile_; }

    // A photo's votes, from the pixels of a window.
    void add(const DepthPicture& picture, int left, int top, int right, int bottom);
    void layers(const LayerPlanes& out);
    // Robust means about starts; NaN: no start.
    void fit(const double* start, const FitPlanes& out);

  private:
    void read_window(const DepthPicture& picture, int left, int top, int right, int bottom);
    void sort_keys();
    void vote(const SurfaceCamera& camera, std::size_t begin, std::size_t end, int cell);
    void sort_votes();

    CellTile tile_;
    std::vector<std::uint64_t> keys_, sorted_keys_;
    std::vector<std::size_t> starts_;  // of cells in what was sorted last
    std::vector<Vote> votes_;
    bool sorted_ = false;
};

}  // namespace splat
