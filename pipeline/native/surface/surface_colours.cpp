#include "surface/surface_colours.h"

#include <algorithm>
#include <cstddef>
#include <vector>

namespace splat {
namespace {

constexpr int kReach = 3;  // pixels on each side of a position that the cubic uses

// Bounding box of positions, in pixels of the halved photo.
struct Extent {
    double left = 1e30, top = 1e30, right = -1e30, bottom = -1e30;
};

int halved_size(int size, int times) { return (size + (1 << times) - 1) >> times; }

// Reads and halves the part of a photo that the cubic needs for positions within an extent.
std::vector<std::uint32_t> open_part(const Photo& photo, const Extent& extent, Halved* part) {
    const ColourKernels& kernels = SPLAT_KERNELS(colour_sample_kernels);
    const double side = 1 << part->times;
    part->whole_width = halved_size(photo.width, part->times);
    part->whole_height = halved_size(photo.height, part->times);
    part->left = std::max(static_cast<int>(extent.left / side) - kReach, 0);
    part->top = std::max(static_cast<int>(extent.top / side) - kReach, 0);
    part->width = std::min(static_cast<int>(extent.right / side) + kReach + 1, part->whole_width) - part->left;
    part->height = std::min(static_cast<int>(extent.bottom / side) + kReach + 1, part->whole_height) - part->top;
    const auto row_of = [](std::vector<std::uint32_t>& pixels, int row, int width) {
        return pixels.data() + static_cast<std::size_t>(row) * static_cast<std::size_t>(width);
    };
    int width = part->width << part->times, height = part->height << part->times;
    std::vector<std::uint32_t> rows(static_cast<std::size_t>(width) * static_cast<std::size_t>(height));
    for (int row = 0; row < height; ++row)
        kernels.read(photo, (part->top << part->times) + row, part->left << part->times, width,
                     row_of(rows, row, width));
    for (int time = 0; time < part->times; ++time) {
        width /= 2, height /= 2;
        for (int row = 0; row < height; ++row)  // in place: only rows that have been read are overwritten
            kernels.halve(row_of(rows, 2 * row, 2 * width), row_of(rows, 2 * row + 1, 2 * width), width,
                          row_of(rows, row, width));
    }
    return rows;
}

}  // namespace

void sample_photo(const Photo& photo, const Places& places, double cell, const std::uint8_t* seen,
                  std::uint8_t* colour) {
    const ColourKernels& kernels = SPLAT_KERNELS(colour_sample_kernels);
    const std::size_t count = static_cast<std::size_t>(places.count);
    std::fill(colour, colour + 3 * count, std::uint8_t{0});
    std::vector<double> column(count), row(count);
    std::vector<std::int8_t> times(count);
    kernels.find(photo, places, cell, seen, column.data(), row.data(), times.data());
    Extent extents[kMostHalved + 1];
    for (std::size_t k = 0; k < count; ++k) {
        if (times[k] < 0) continue;
        Extent& extent = extents[times[k]];
        extent.left = std::min(extent.left, column[k]), extent.right = std::max(extent.right, column[k]);
        extent.top = std::min(extent.top, row[k]), extent.bottom = std::max(extent.bottom, row[k]);
    }
    for (int time = 0; time <= kMostHalved; ++time) {
        if (extents[time].right < 0.0) continue;
        Halved part{};
        part.times = time;
        std::vector<std::uint32_t> pixels = open_part(photo, extents[time], &part);
        part.pixels = pixels.data();
        kernels.sample(part, places.count, column.data(), row.data(), times.data(), colour);
    }
}

}  // namespace splat
