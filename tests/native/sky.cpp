// Renders composited over the sky and their gradients: against the definition, the same bits for any number of threads.
#include "sky/sky.h"

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>
#include <vector>

#include "base/threads.h"
#include "check.h"
#include "sky/sky_behind.h"

namespace {

constexpr int kStep = 8;

struct Scene {
    int width, height, rows, columns;
    std::vector<float> colour, alpha, nodes, elsewhere, upstream;
    std::vector<std::uint8_t> around, mask;

    splat::SkyJob job(bool known) const {
        return {width,         height,
                rows,          columns,
                kStep,         {0.2f, 0.5f, 0.1f},
                colour.data(), alpha.data(),
                nodes.data(),  known ? elsewhere.data() : nullptr,
                around.data(), mask.data()};
    }
};

int nodes_along(int size) { return (size - 1 + kStep - 1) / kStep + 1; }

Scene random_scene(int width, int height) {
    Random random(static_cast<std::uint64_t>(height * 1000 + width));
    const auto floats = [&](int count) {
        std::vector<float> values(static_cast<std::size_t>(count));
        for (float& value : values) value = random.uniform(0.0f, 1.0f);
        return values;
    };
    const auto bytes = [&](int count) {
        std::vector<std::uint8_t> values(static_cast<std::size_t>(count));
        for (std::uint8_t& value : values) value = random.below(3) != 0;
        return values;
    };
    const int pixels = width * height, rows = nodes_along(height), columns = nodes_along(width);
    return {width,
            height,
            rows,
            columns,
            floats(3 * pixels),
            floats(pixels),
            floats(3 * rows * columns),
            floats(3 * rows * columns),
            floats(3 * pixels),
            bytes(pixels),
            bytes(pixels)};
}

struct Found {
    std::vector<float> out, by_alpha, by_nodes;
};

Found found(const Scene& scene, bool known) {
    Found f{std::vector<float>(scene.colour.size(), 77.0f), std::vector<float>(scene.alpha.size(), -5.0f),
            std::vector<float>(scene.nodes.size(), 3.0f)};
    const splat::SkyJob job = scene.job(known);
    check(splat::is_sound(job), "sound");
    splat::lay_over(job, f.out.data());
    splat::lay_over_backward(job, scene.upstream.data(), f.by_alpha.data(), f.by_nodes.data());
    return f;
}

// The same in double, pixel by pixel.
struct Exact {
    std::vector<double> out, by_alpha, by_nodes;
};

Exact exact(const Scene& scene, bool known) {
    Exact e{std::vector<double>(scene.colour.size()), std::vector<double>(scene.alpha.size()),
            std::vector<double>(scene.nodes.size())};
    const splat::SkyJob job = scene.job(known);
    for (int y = 0; y < scene.height; ++y)
        for (int x = 0; x < scene.width; ++x) {
            const std::size_t pixel =
                static_cast<std::size_t>(y) * static_cast<std::size_t>(scene.width) + static_cast<std::size_t>(x);
            const std::vector<float>& nodes = known && !scene.around[pixel] ? scene.elsewhere : scene.nodes;
            const double through = 1.0 - double{scene.alpha[pixel]};
            for (std::size_t k = 0; k < 3; ++k) {
                double behind = -double{job.background[k]};
                for (int corner = 0; corner < 4; ++corner) {
                    const int row = y / kStep + corner / 2, column = x / kStep + corner % 2;
                    const double down = std::fabs(double(y) / kStep - row),
                                 right = std::fabs(double(x) / kStep - column);
                    const double weight = (1.0 - down) * (1.0 - right);
                    if (weight == 0.0) continue;
                    const std::size_t node = 3 * static_cast<std::size_t>(row * scene.columns + column) + k;
                    behind += weight * double{nodes[node]};
                    if (scene.mask[pixel]) e.by_nodes[node] += weight * through * double{scene.upstream[3 * pixel + k]};
                }
                e.out[3 * pixel + k] = double{scene.colour[3 * pixel + k]} + through * behind;
                e.by_alpha[pixel] -= double{scene.upstream[3 * pixel + k]} * behind;
            }
        }
    return e;
}

double distance(const std::vector<float>& a, const std::vector<double>& b) {
    double most = 0.0;
    for (std::size_t i = 0; i < a.size(); ++i) most = std::fmax(most, std::fabs(double{a[i]} - b[i]));
    return most;
}

// One pixel; a last node at the last pixel and outside; a row, a column; vectors' ends; more columns than a tile.
constexpr int kSizes[][2] = {{1, 1}, {33, 17}, {34, 18}, {40, 1}, {1, 40}, {15, 9}, {64, 50}, {700, 23}};

void follows_the_definition() {
    for (const auto& size : kSizes)
        for (bool known : {false, true}) {
            const Scene scene = random_scene(size[0], size[1]);
            const Found ours = found(scene, known);
            const Exact right = exact(scene, known);
            const std::string name = std::to_string(size[0]) + " x " + std::to_string(size[1]);
            check(distance(ours.out, right.out) < 1e-6, name + ": picture");
            check(distance(ours.by_alpha, right.by_alpha) < 2e-6, name + ": by alpha");
            check(distance(ours.by_nodes, right.by_nodes) < 5e-5, name + ": by nodes");  // sums of 225 products
        }
}

void same_for_any_threads() {
    const Scene scene = random_scene(313, 211);
    splat::set_threads(1);
    const Found alone = found(scene, true);
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        const Found f = found(scene, true);
        check(same_bits(f.out, alone.out) && same_bits(f.by_alpha, alone.by_alpha), "pictures");
        check(same_bits(f.by_nodes, alone.by_nodes), "nodes");
    }
}

void knows_what_is_sound() {
    const Scene scene = random_scene(33, 17);
    const splat::SkyJob good = scene.job(true);
    check(splat::is_sound(good), "as it is");
    for (int wrong = 0; wrong < 5; ++wrong) {
        splat::SkyJob job = good;
        if (wrong == 0) job.step = 0;
        if (wrong == 1) job.step = splat::kSkyMostStep + 1;
        if (wrong == 2) job.rows -= 1;
        if (wrong == 3) job.columns -= 1;
        if (wrong == 4) job.around = nullptr;
        check(!splat::is_sound(job), std::to_string(wrong));
    }
}

}  // namespace

void test_sky() {
    splat::set_threads(1);
    test("nodes that do not reach the last pixel are not sound", knows_what_is_sound);
    test_each_isa("a render is laid over the sky by the definition", follows_the_definition);
    test_each_isa("the sky behind a render is the same for any number of threads", same_for_any_threads);
}
