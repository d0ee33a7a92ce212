#include "scenes.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "check.h"

splat::Parameters Scene::parameters() const {
    return {count(), means.data(), log_scales.data(), quats.data(), opacity_logits.data(), sh.data()};
}

std::vector<std::vector<float>*> Scene::tensors() { return {&means, &log_scales, &quats, &opacity_logits, &sh}; }

Scene random_scene(std::uint64_t seed, int count, int sh_count, float log_scale) {
    Random random(seed);
    const std::size_t n = static_cast<std::size_t>(count), k = static_cast<std::size_t>(sh_count);
    Scene scene{std::vector<float>(3 * n), std::vector<float>(3 * n),     std::vector<float>(4 * n),
                std::vector<float>(n),     std::vector<float>(3 * k * n), sh_count};
    const float spread[] = {1.5f, 1.2f, 1.5f}, middle[] = {0.0f, 0.0f, 4.0f};
    for (std::size_t i = 0; i < 3 * n; ++i) scene.means[i] = random.normal() * spread[i % 3] + middle[i % 3];
    for (float& value : scene.log_scales) value = 0.6f * random.normal() + log_scale;
    for (float& value : scene.quats) value = random.normal();
    for (float& value : scene.opacity_logits) value = 2.0f * random.normal();
    for (float& value : scene.sh) value = 0.3f * random.normal();
    return scene;
}

Scene hostile_scene(std::uint64_t seed, int count, int sh_count) {
    using Limits = std::numeric_limits<float>;
    const float values[] = {Limits::quiet_NaN(),
                            Limits::infinity(),
                            -Limits::infinity(),
                            3e38f,
                            -3e38f,
                            1e30f,
                            -1e30f,
                            Limits::denorm_min(),
                            0.0f,
                            -0.0f,
                            100.0f,
                            -100.0f,
                            10.0f,
                            -10.0f};
    Scene scene = random_scene(seed, count, sh_count);
    Random random(seed + 1);
    for (std::int64_t i = 0; i < scene.count(); ++i) {
        if (random.below(3)) continue;  // two of three are as they were
        std::vector<float>& tensor = *scene.tensors()[static_cast<std::size_t>(random.below(5))];
        const std::size_t row = tensor.size() / scene.opacity_logits.size(), start = static_cast<std::size_t>(i) * row;
        const float value = values[random.below(std::size(values))];
        const std::size_t only = start + static_cast<std::size_t>(random.below(static_cast<int>(row)));
        const bool whole = random.below(2);
        for (std::size_t j = start; j < start + row; ++j)
            if (whole || j == only) tensor[j] = value;
    }
    return scene;
}

splat::View view_of(int width, int height, int sh_count, const Options& options) {
    splat::View view{};
    view.width = width, view.height = height;
    view.tiles_x = (width + splat::kTile - 1) / splat::kTile, view.tiles_y = (height + splat::kTile - 1) / splat::kTile;
    view.fx = 60.0f, view.fy = 64.0f;
    view.cx = 0.45f * static_cast<float>(width), view.cy = 0.55f * static_cast<float>(height);
    const float c = std::cos(0.1f), s = std::sin(0.1f);
    const float rotation[] = {c, 0.0f, s, 0.0f, 1.0f, 0.0f, -s, 0.0f, c};
    std::copy(std::begin(rotation), std::end(rotation), view.rotation);
    const float w = static_cast<float>(width), h = static_cast<float>(height);
    const float margin_x = 0.5f * splat::kFrustumMargin * w, margin_y = 0.5f * splat::kFrustumMargin * h;
    view.ratio_min[0] = -(view.cx + margin_x) / view.fx, view.ratio_max[0] = (w - view.cx + margin_x) / view.fx;
    view.ratio_min[1] = -(view.cy + margin_y) / view.fy, view.ratio_max[1] = (h - view.cy + margin_y) / view.fy;
    view.near_z = 0.2f, view.depth_origin = 2.0f;
    const float background[] = {0.1f, 0.5f, 0.9f};
    std::copy(std::begin(background), std::end(background), view.background);
    view.sh_degree = options.sh_degree, view.sh_count = sh_count, view.antialias = options.antialias;
    return view;
}

std::vector<const std::vector<float>*> Outcome::pictures() const {
    return {&colour, &alpha, &depth_sum, &depth_square_sum, &median_depth, &radii};
}

std::vector<const std::vector<float>*> Outcome::gradients() const {
    return {&means, &log_scales, &quats, &opacity_logits, &sh, &means2d, &magnitudes};
}

bool Outcome::same_bits_as(const Outcome& other) const {
    bool same = same_bits(visible, other.visible);
    for (std::size_t i = 0; i < pictures().size(); ++i) same = same && same_bits(*pictures()[i], *other.pictures()[i]);
    for (std::size_t i = 0; i < gradients().size(); ++i)
        same = same && same_bits(*gradients()[i], *other.gradients()[i]);
    return same;
}

namespace {

std::vector<float> random_weights(Random* random, std::size_t size) {
    std::vector<float> weights(size);
    for (float& weight : weights) weight = random->uniform(-1.0f, 1.0f);
    return weights;
}

double weighted_sum(const std::vector<float>& picture, const std::vector<float>& weights) {
    double sum = 0.0;
    for (std::size_t i = 0; i < picture.size(); ++i) sum += double{picture[i]} * double{weights[i]};
    return sum;
}

}  // namespace

Outcome evaluate(splat::RasterFrame& frame, const Scene& scene, const splat::View& view, bool depth, float unwritten) {
    const std::size_t pixels = static_cast<std::size_t>(view.width) * static_cast<std::size_t>(view.height);
    const std::size_t n = static_cast<std::size_t>(scene.count()), depths = depth ? pixels : 0;
    const auto blank = [&](std::size_t size) { return std::vector<float>(size, unwritten); };
    Outcome out{};
    out.colour = blank(3 * pixels), out.alpha = blank(pixels);
    out.depth_sum = blank(depths), out.depth_square_sum = blank(depths), out.median_depth = blank(depths);
    out.radii = blank(n), out.visible.assign(n, static_cast<std::uint8_t>(static_cast<int>(unwritten) & 255));
    frame.forward(view, scene.parameters(),
                  {out.colour.data(), out.alpha.data(), depth ? out.depth_sum.data() : nullptr,
                   depth ? out.depth_square_sum.data() : nullptr, depth ? out.median_depth.data() : nullptr},
                  out.radii.data(), out.visible.data());
    Random random(5);
    const std::vector<float> colour = random_weights(&random, 3 * pixels), alpha = random_weights(&random, pixels);
    const std::vector<float> depth_sum = random_weights(&random, depths), squares = random_weights(&random, depths);
    out.sum = weighted_sum(out.colour, colour) + weighted_sum(out.alpha, alpha) +
              weighted_sum(out.depth_sum, depth_sum) + weighted_sum(out.depth_square_sum, squares);
    out.means = blank(3 * n), out.log_scales = blank(3 * n), out.quats = blank(4 * n), out.opacity_logits = blank(n);
    out.sh = blank(scene.sh.size()), out.means2d = blank(2 * n), out.magnitudes = blank(2 * n);
    const splat::PictureGradients pictures = {colour.data(), alpha.data(), depth ? depth_sum.data() : nullptr,
                                              depth ? squares.data() : nullptr};
    splat::ParameterGradients gradients = {out.means.data(),          out.log_scales.data(), out.quats.data(),
                                           out.opacity_logits.data(), out.sh.data(),         out.magnitudes.data()};
    frame.blend_backward(pictures, true);
    frame.project_backward(scene.parameters(), gradients);
    gradients.means2d = out.means2d.data();
    frame.blend_backward(pictures, false);
    frame.project_backward(scene.parameters(), gradients);
    return out;
}

Outcome evaluate(const Scene& scene, const splat::View& view, bool depth, float unwritten) {
    splat::RasterFrame frame;
    return evaluate(frame, scene, view, depth, unwritten);
}
