// Shared by the kernels of the surface model and the orthophoto. World: local east, north, up in metres, or the axes of
// a drawing sheet; heights are towards the viewer.
//
// Sums and products are never fused here (-ffp-contract=off): bit-identical on every instruction set, and in every
// window, tile and vector lane.
#pragma once

#include <cstdint>

namespace splat {

// A pinhole camera in the world.
struct SurfaceCamera {
    int width, height;
    double fx, fy, cx, cy;
    double turn[9], shift[3];  // camera from world
    double centre[3];          // of projection, in the world
};

// A photo's depths: along the camera's z, 0 where there are none.
struct DepthPicture {
    SurfaceCamera camera;
    const float* depth;              // (height, width)
    const std::uint8_t* confidence;  // (height, width); null if not needed
};

// Cells of a lattice, rows from north to south, and the range of heights that count.
struct CellTile {
    double east, north;  // of the lattice's first corner
    double cell;         // side
    int row, column;     // of the tile's first cell; the tile may reach beyond the lattice
    int height, width;
    double low, high;
};

}  // namespace splat
