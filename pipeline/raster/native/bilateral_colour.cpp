#include "bilateral_colour.h"

#include <algorithm>
#include <cstddef>
#include <vector>

#include "bilateral.h"
#include "threads.h"

namespace splat {
namespace {

// Which node is left of (or above) a pixel: floor((x + 1/2) (nodes - 1) / size).
int node_before(std::int64_t pixel, std::int64_t size, int nodes) {
    return static_cast<int>((2 * pixel + 1) * (nodes - 1) / (2 * size));
}

// The same cuts whatever the number of threads.
std::vector<GridChunk> chunks_of(const ColourGrid& grid, std::int64_t height, std::int64_t width) {
    std::vector<GridChunk> chunks;
    for (std::int64_t first_y = 0, last_y = 0; first_y < height; first_y = last_y) {
        const int cell = node_before(first_y, height, grid.rows);
        while (last_y < height && node_before(last_y, height, grid.rows) == cell) ++last_y;
        for (std::int64_t x = 0; x < width; x += kGridWidth) {
            const std::int64_t last_x = std::min(x + kGridWidth, width);
            // The kernels place pixels in float, which may round one past a node: one node more on either side.
            const int left = std::max(node_before(x, width, grid.columns) - 1, 0);
            const int right = std::min(node_before(last_x - 1, width, grid.columns) + 2, grid.columns - 1);
            chunks.push_back({grid.maps, grid.levels, grid.rows, grid.columns, width, height, cell, x, last_x, first_y,
                              last_y, left, right - left + 1});
        }
    }
    return chunks;
}

std::size_t sums_of(const GridChunk& chunk) {
    return static_cast<std::size_t>(2 * chunk.levels * chunk.nodes * kAffine);
}

void add(const GridChunk& chunk, const std::vector<float>& sums, double* grid_gradient) {
    const float* part = sums.data();
    for (int row = chunk.cell; row < chunk.cell + 2; ++row)
        for (int level = 0; level < chunk.levels; ++level) {
            const std::int64_t node = (std::int64_t{level} * chunk.rows + row) * chunk.columns + chunk.first_node;
            double* total = grid_gradient + node * kAffine;
            for (int k = 0; k < chunk.nodes * kAffine; ++k) total[k] += double{part[k]};
            part += chunk.nodes * kAffine;
        }
}

}  // namespace

void bilateral_colour(const ColourGrid& grid, const float* in, std::int64_t height, std::int64_t width, float* out) {
    const BilateralKernels& kernels = SPLAT_KERNELS(bilateral_kernels);
    const std::vector<GridChunk> chunks = chunks_of(grid, height, width);
    parallel_for(static_cast<std::int64_t>(chunks.size()),
                 [&](std::int64_t i) { kernels.forward(chunks[static_cast<std::size_t>(i)], in, out); });
}

void bilateral_colour_backward(const ColourGrid& grid, const float* in, const float* upstream, std::int64_t height,
                               std::int64_t width, float* gradient, double* grid_gradient) {
    const BilateralKernels& kernels = SPLAT_KERNELS(bilateral_kernels);
    const std::vector<GridChunk> chunks = chunks_of(grid, height, width);
    std::vector<std::vector<float>> sums(chunks.size());
    parallel_for(static_cast<std::int64_t>(chunks.size()), [&](std::int64_t i) {
        const std::size_t c = static_cast<std::size_t>(i);
        sums[c].assign(sums_of(chunks[c]), 0.0f);
        kernels.backward(chunks[c], in, upstream, gradient, sums[c].data());
    });
    std::fill_n(grid_gradient, grid.size(), 0.0);
    for (std::size_t c = 0; c < chunks.size(); ++c) add(chunks[c], sums[c], grid_gradient);  // in order
}

}  // namespace splat
