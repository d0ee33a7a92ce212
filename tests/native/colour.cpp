// Affine maps of colours and their gradients: against the definition, and the same bits for any number of threads.
#include "loss/colour.h"

#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "base/threads.h"
#include "check.h"
#include "loss/affine_colour.h"

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

}  // namespace

void test_colour() {
    splat::set_threads(1);
    test_each_isa("colours are mapped by the definition", follows_the_definition);
    test_each_isa("mapped colours are the same for any number of threads", same_for_any_threads);
}
