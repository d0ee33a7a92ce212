// The loss and its gradient: against central differences, and the same bits for any number of threads.
#include "loss/loss.h"

#include <cmath>
#include <string>
#include <vector>

#include "base/threads.h"
#include "check.h"
#include "loss/photo_loss.h"

namespace {

constexpr double kWeight = 0.2;

struct Pair {
    int height, width;
    splat::LossRectangle inner;  // what counts
    std::vector<float> render, photo;
    std::vector<std::uint8_t> mask;  // empty: none
};

Pair random_pair(int height, int width, bool masked) {
    Random random(static_cast<std::uint64_t>(height * 1000 + width));
    const std::size_t pixels = static_cast<std::size_t>(height) * static_cast<std::size_t>(width);
    Pair pair{height, width, {0, 0, width, height}, std::vector<float>(3 * pixels), std::vector<float>(3 * pixels), {}};
    for (float& value : pair.render) value = random.uniform(0.0f, 1.0f);
    for (std::size_t i = 0; i < pair.photo.size(); ++i)  // far enough from the render for |render - photo| to be smooth
        pair.photo[i] = pair.render[i] + (random.below(2) ? 0.1f : -0.1f) * random.uniform(1.0f, 3.0f);
    pair.mask.resize(masked ? pixels : 0);
    for (std::uint8_t& counts : pair.mask) counts = random.below(3) != 0;
    return pair;
}

double loss_of(const Pair& pair, std::vector<float>* gradient) {
    return splat::photo_loss({pair.render.data(), pair.photo.data(), pair.mask.empty() ? nullptr : pair.mask.data(),
                              gradient->data(), pair.height, pair.width, pair.inner},
                             kWeight);
}

void same_for_any_threads() {
    const int sizes[][2] = {{6, 6}, {6, 40}, {40, 6}, {7, 9}, {11, 11}, {37, 259}, {129, 33}, {130, 270}};
    for (const auto& size : sizes)
        for (bool masked : {false, true}) {
            const Pair pair = random_pair(size[0], size[1], masked);
            splat::set_threads(1);
            std::vector<float> alone(pair.render.size(), 77.0f);
            const double loss = loss_of(pair, &alone);
            check(std::isfinite(loss) && all_finite(alone), "finite");
            for (int threads : kThreadCounts) {
                splat::set_threads(threads);
                std::vector<float> gradient(pair.render.size(), -5.0f);
                const bool same = loss_of(pair, &gradient) == loss && same_bits(gradient, alone);
                check(same, std::to_string(size[0]) + " x " + std::to_string(size[1]));
            }
        }
}

void gradient_is_central_differences() {
    for (int given = 0; given < 4; ++given) {
        Pair pair = random_pair(13, 17, given % 2);
        if (given / 2) pair.inner = {3, 2, 12, 13};
        std::vector<float> gradient(pair.render.size()), unused(pair.render.size());
        loss_of(pair, &gradient);
        double error2 = 0.0, size2 = 0.0;
        for (std::size_t i = 0; i < pair.render.size(); ++i) {
            const float value = pair.render[i], up = value + 2e-3f, down = value - 2e-3f;
            pair.render[i] = up;
            const double above = loss_of(pair, &unused);
            pair.render[i] = down;
            const double below = loss_of(pair, &unused);
            pair.render[i] = value;
            const double slope = (above - below) / (double{up} - double{down});
            error2 += std::pow(double{gradient[i]} - slope, 2), size2 += slope * slope;
        }
        const double relative = std::sqrt(error2 / size2);
        check(relative < 3e-3, "off by " + std::to_string(relative));
    }
}

void nothing_counts() {
    Pair pair = random_pair(20, 21, true);
    for (std::uint8_t& counts : pair.mask) counts = 0;
    std::vector<float> gradient(pair.render.size(), 77.0f);
    check(loss_of(pair, &gradient) == 0.0, "the loss is zero");
    for (float value : gradient) check(value == 0.0f, "the gradient is zero");
}

// A non-finite render (the rasterizer never produces one) must not cause out-of-bounds access either.
void hostile_pixels() {
    Pair pair = random_pair(30, 31, true);
    for (std::size_t i = 0; i < pair.render.size(); i += 97) pair.render[i] = i % 2 ? NAN : INFINITY;
    std::vector<float> gradient(pair.render.size());
    loss_of(pair, &gradient);
}

}  // namespace

void test_loss() {
    test_each_isa("the loss is the same for any number of threads", same_for_any_threads);
    splat::set_threads(1);
    test_each_isa("the loss's gradient is central differences", gradient_is_central_differences);
    test_each_isa("where nothing counts, loss and gradient are zero", nothing_counts);
    test_each_isa("hostile pixels stay within the image", hostile_pixels);
}
