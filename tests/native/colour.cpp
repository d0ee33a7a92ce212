// Affine maps of colours, one or a grid of them, and their gradients: against the definition, and the same bits for any
// number of threads.
#include "colour.h"

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "affine_colour.h"
#include "bilateral_colour.h"
#include "check.h"
#include "threads.h"

namespace {

struct Mapped {
    std::vector<float> out, gradient;
    double map_gradient[splat::kAffine];
};

Mapped mapped(const std::vector<float>& map, const std::vector<float>& in, const std::vector<float>& upstream) {
    Mapped m{std::vector<float>(in.size(), 77.0f), std::vector<float>(in.size(), -5.0f), {}};
    const std::int64_t pixels = static_cast<std::int64_t>(in.size() / 3);
    splat::affine_colour(map.data(), in.data(), pixels, m.out.data());
    splat::affine_colour_backward(map.data(), in.data(), upstream.data(), pixels, m.gradient.data(), m.map_gradient);
    return m;
}

std::vector<float> random_floats(std::size_t count, std::uint64_t seed) {
    Random random(seed);
    std::vector<float> values(count);
    for (float& value : values) value = random.uniform(-1.0f, 1.0f);
    return values;
}

// Pixels that end within a vector, at its end, and in a second and third chunk.
void follows_the_definition() {
    const std::vector<float> map = random_floats(splat::kAffine, 1);
    for (std::size_t pixels : {std::size_t{1}, std::size_t{15}, std::size_t{16}, std::size_t{33}, std::size_t{40000}}) {
        const std::vector<float> in = random_floats(3 * pixels, 2), upstream = random_floats(3 * pixels, 3);
        const Mapped m = mapped(map, in, upstream);
        double sums[splat::kAffine] = {}, error = 0.0;
        for (std::size_t p = 0; p < pixels; ++p)
            for (std::size_t i = 0; i < 3; ++i) {
                double out = double{map[4 * i + 3]}, back = 0.0;
                for (std::size_t j = 0; j < 3; ++j) {
                    out += double{map[4 * i + j]} * double{in[3 * p + j]};
                    back += double{map[4 * j + i]} * double{upstream[3 * p + j]};
                    sums[4 * i + j] += double{upstream[3 * p + i]} * double{in[3 * p + j]};
                }
                sums[4 * i + 3] += double{upstream[3 * p + i]};
                error = std::fmax(error, std::fabs(double{m.out[3 * p + i]} - out));
                error = std::fmax(error, std::fabs(double{m.gradient[3 * p + i]} - back));
            }
        check(error < 1e-6, std::to_string(pixels) + " pixels: off by " + std::to_string(error));
        for (int k = 0; k < splat::kAffine; ++k)
            check(std::fabs(m.map_gradient[k] - sums[k]) < 1e-4 * std::sqrt(static_cast<double>(pixels)),
                  std::to_string(pixels) + " pixels: entry " + std::to_string(k));
    }
}

void same_for_any_threads() {
    const std::vector<float> map = random_floats(splat::kAffine, 1);
    const std::vector<float> in = random_floats(3 * 70001, 2), upstream = random_floats(3 * 70001, 3);
    splat::set_threads(1);
    const Mapped alone = mapped(map, in, upstream);
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        const Mapped m = mapped(map, in, upstream);
        check(same_bits(m.out, alone.out) && same_bits(m.gradient, alone.gradient), "pictures");
        for (int k = 0; k < splat::kAffine; ++k)
            check(m.map_gradient[k] == alone.map_gradient[k], "the map's gradient");
    }
}

struct Sliced {
    std::vector<float> out, gradient;
    std::vector<double> grid_gradient;
};

Sliced sliced(const splat::ColourGrid& grid, const std::vector<float>& in, const std::vector<float>& upstream,
              std::int64_t height, std::int64_t width) {
    Sliced s{std::vector<float>(in.size(), 77.0f), std::vector<float>(in.size(), -5.0f),
             std::vector<double>(static_cast<std::size_t>(grid.size()), 9.0)};
    splat::bilateral_colour(grid, in.data(), height, width, s.out.data());
    splat::bilateral_colour_backward(grid, in.data(), upstream.data(), height, width, s.gradient.data(),
                                     s.grid_gradient.data());
    return s;
}

// A pixel's entry k of its map, and its slope by the luminance: eight nodes; dL/d(entry) to them.
void at_pixel(const splat::ColourGrid& grid, const double* place, std::size_t k, double upstream, double* entry,
              double* slope, std::vector<double>* gradient) {
    const int sizes[3] = {grid.levels, grid.rows, grid.columns};
    int before[3];
    for (int a = 0; a < 3; ++a) before[a] = std::min(static_cast<int>(std::floor(place[a])), sizes[a] - 2);
    for (int corner = 0; corner < 8; ++corner) {
        double weight[3];
        int node[3];
        for (int a = 0; a < 3; ++a) {
            node[a] = before[a] + ((corner >> a) & 1);
            weight[a] = 1.0 - std::fabs(place[a] - node[a]);
        }
        const int index = (node[0] * grid.rows + node[1]) * grid.columns + node[2];
        const std::size_t at = static_cast<std::size_t>(index) * splat::kAffine + k;
        *entry += weight[0] * weight[1] * weight[2] * double{grid.maps[at]};
        *slope += (corner & 1 ? 1.0 : -1.0) * weight[1] * weight[2] * double{grid.maps[at]};
        (*gradient)[at] += weight[0] * weight[1] * weight[2] * upstream;
    }
}

void check_grid(int levels, int rows, int columns, int height, int width) {
    const std::vector<float> maps =
        random_floats(static_cast<std::size_t>(levels * rows * columns * splat::kAffine), 1);
    const splat::ColourGrid grid{maps.data(), levels, rows, columns};
    std::vector<float> in = random_floats(static_cast<std::size_t>(3 * height * width), 2);
    const std::vector<float> upstream = random_floats(in.size(), 3);
    for (float& value : in) value = 0.5f + 0.7f * value;  // some darker than black, some brighter than white
    const Sliced s = sliced(grid, in, upstream, height, width);
    std::vector<double> by_grid(maps.size(), 0.0);
    double error = 0.0;
    for (int p = 0; p < height * width; ++p) {
        const std::size_t at = static_cast<std::size_t>(3 * p);
        const double luma[3] = {0.299, 0.587, 0.114};
        double luminance = 0.0, by_luminance = 0.0, out[3] = {}, by_in[3] = {};
        for (std::size_t j = 0; j < 3; ++j) luminance += luma[j] * double{in[at + j]};
        const double place[3] = {std::clamp(luminance, 0.0, 1.0) * (levels - 1),
                                 (p / width + 0.5) * (rows - 1) / height, (p % width + 0.5) * (columns - 1) / width};
        for (std::size_t k = 0; k < splat::kAffine; ++k) {
            const std::size_t i = k / 4, j = k % 4;
            const double colour = j < 3 ? double{in[at + j]} : 1.0, up = double{upstream[at + i]};
            double entry = 0.0, slope = 0.0;
            at_pixel(grid, place, k, up * colour, &entry, &slope, &by_grid);
            out[i] += entry * colour;
            if (j < 3) by_in[j] += entry * up;
            if (luminance > 0.0 && luminance < 1.0) by_luminance += up * colour * slope * (levels - 1);
        }
        for (std::size_t j = 0; j < 3; ++j) {
            error = std::fmax(error, std::fabs(double{s.out[at + j]} - out[j]));
            const double difference = double{s.gradient[at + j]} - by_in[j] - by_luminance * luma[j];
            error = std::fmax(error, std::fabs(difference) / levels);
        }
    }
    const std::string what = std::to_string(height) + " x " + std::to_string(width) + " pixels";
    check(error < 1e-5, what + ": off by " + std::to_string(error));
    for (std::size_t k = 0; k < by_grid.size(); ++k)
        check(std::fabs(s.grid_gradient[k] - by_grid[k]) < 1e-4, what + ": entry " + std::to_string(k));
}

// Fewer pixels than nodes, rows that end within a vector, and in a second and third chunk.
void grid_follows_the_definition() {
    check_grid(4, 8, 8, 1, 1);
    check_grid(2, 2, 2, 3, 15);
    check_grid(4, 8, 8, 5, 16);
    check_grid(16, 3, 64, 9, 33);
    check_grid(3, 5, 7, 61, 300);
}

void grid_same_for_any_threads() {
    const std::vector<float> maps = random_floats(4 * 8 * 8 * splat::kAffine, 1);
    const splat::ColourGrid grid{maps.data(), 4, 8, 8};
    const std::vector<float> in = random_floats(3 * 90 * 401, 2), upstream = random_floats(3 * 90 * 401, 3);
    splat::set_threads(1);
    const Sliced alone = sliced(grid, in, upstream, 90, 401);
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        const Sliced s = sliced(grid, in, upstream, 90, 401);
        check(same_bits(s.out, alone.out) && same_bits(s.gradient, alone.gradient), "pictures");
        check(same_bits(s.grid_gradient, alone.grid_gradient), "the grid's gradient");
    }
}

}  // namespace

void test_colour() {
    splat::set_threads(1);
    test_each_isa("colours are mapped by the definition", follows_the_definition);
    test_each_isa("mapped colours are the same for any number of threads", same_for_any_threads);
    test_each_isa("colours are sliced from a grid by the definition", grid_follows_the_definition);
    test_each_isa("sliced colours are the same for any number of threads", grid_same_for_any_threads);
}
