// Kernels that take activated values and plain features: the same bits for any number of threads and any input.
#include <cmath>
#include <string>
#include <vector>

#include "base/threads.h"
#include "check.h"
#include "raster/features_cpu.h"
#include "scenes.h"

namespace {

struct Case {
    int width, height, channels;
    bool slanted, compensated;
};

// Everything that the kernels write.
struct Result {
    std::vector<float> means2d, depths, covariances, determinants, compensations, slants, colours, pictures, alpha;
    std::vector<std::int32_t> radii;
    std::vector<float> by_means2d, by_covariances, by_opacities, by_features, by_slants, magnitudes;
    std::vector<float> by_means, by_quats, by_scales, by_sh;

    std::vector<const std::vector<float>*> arrays() const {
        return {&means2d,    &depths,   &covariances, &determinants,   &compensations, &slants,      &colours,
                &pictures,   &alpha,    &by_means2d,  &by_covariances, &by_opacities,  &by_features, &by_slants,
                &magnitudes, &by_means, &by_quats,    &by_scales,      &by_sh};
    }
};

std::vector<float> random_values(std::uint64_t seed, std::size_t size) {
    Random random(seed);
    std::vector<float> values(size);
    for (float& value : values) value = random.normal();
    return values;
}

Result evaluate_features(const Scene& scene, const splat::View& view, const Case& how) {
    const std::size_t n = static_cast<std::size_t>(scene.count()), channels = static_cast<std::size_t>(how.channels);
    const std::size_t pixels = static_cast<std::size_t>(how.width) * static_cast<std::size_t>(how.height);
    const auto blank = [](std::size_t size) { return std::vector<float>(size, 77.0f); };
    std::vector<float> scales = scene.log_scales, opacities = scene.opacity_logits;  // scales of either sign
    for (float& opacity : opacities) opacity = 1.0f / (1.0f + std::exp(-opacity));
    const splat::ActivatedGaussians gaussians = {scene.count(), scene.means.data(), scene.quats.data(), scales.data(),
                                                 opacities.data()};
    const splat::ProjectOptions options = {1e6f, 0.3f, 0.0f, 0.0f, 0.0f};
    Result r;
    r.means2d = blank(2 * n), r.depths = blank(n), r.covariances = blank(3 * n), r.determinants = blank(n);
    r.compensations = blank(how.compensated ? n : 0), r.slants = blank(how.slanted ? 2 * n : 0);
    r.radii.assign(2 * n, 77), r.colours = blank(3 * n);
    splat::project_activated(
        view, options, gaussians,
        {r.means2d.data(), r.depths.data(), r.covariances.data(), r.determinants.data(),
         how.compensated ? r.compensations.data() : nullptr, how.slanted ? r.slants.data() : nullptr, r.radii.data()});
    const splat::ShRows sh = {scene.count(), scene.means.data(), scene.sh.data(), r.radii.data()};
    splat::sh_colours(view, sh, r.colours.data());

    const std::vector<float> values = random_values(3, n * channels), background = random_values(4, channels);
    const splat::Features features = {how.channels,      0.999f,        std::log2(0.999f),
                                      background.data(), values.data(), how.slanted};
    const splat::ScreenSplats splats = {
        scene.count(),         r.means2d.data(), r.depths.data(), r.covariances.data(),
        r.determinants.data(), opacities.data(), values.data(),   how.slanted ? r.slants.data() : nullptr,
        r.radii.data()};
    r.pictures = blank(pixels * channels), r.alpha = blank(pixels);
    splat::FeatureFrame frame;
    frame.forward(view, features, splats, {r.pictures.data(), r.alpha.data()});

    const std::vector<float> by_pictures = random_values(5, pixels * channels), by_alpha = random_values(6, pixels);
    const auto zeros = [](std::size_t size) { return std::vector<float>(size); };
    r.by_means2d = zeros(2 * n), r.by_covariances = zeros(3 * n), r.by_opacities = zeros(n);
    r.by_features = zeros(n * channels), r.by_slants = zeros(how.slanted ? 2 * n : 0), r.magnitudes = zeros(2 * n);
    frame.backward(features, splats, {by_pictures.data(), by_alpha.data()},
                   {r.by_means2d.data(), r.by_covariances.data(), r.by_opacities.data(), r.by_features.data(),
                    how.slanted ? r.by_slants.data() : nullptr, r.magnitudes.data()});
    r.by_means = zeros(3 * n), r.by_quats = zeros(4 * n), r.by_scales = zeros(3 * n), r.by_sh = zeros(scene.sh.size());
    splat::project_activated_backward(
        view, options, gaussians, r.radii.data(),
        {r.by_means2d.data(), r.depths.data(), r.by_covariances.data(),
         how.compensated ? r.by_opacities.data() : nullptr, how.slanted ? r.by_slants.data() : nullptr},
        {r.by_means.data(), r.by_quats.data(), r.by_scales.data()});
    splat::sh_colours_backward(view, sh, r.colours.data(), r.by_means.data(), r.by_sh.data());
    return r;
}

void check_features(const Scene& scene, const Case& how, bool finite) {
    const splat::View view = view_of(how.width, how.height, scene.sh_count, {scene.sh_count == 16 ? 3 : 0});
    const std::string what = std::to_string(how.width) + " x " + std::to_string(how.height) + ", " +
                             std::to_string(how.channels) + " channels, " + std::to_string(scene.count()) + " rows";
    splat::set_threads(1);
    const Result alone = evaluate_features(scene, view, how);
    for (const std::vector<float>* array : alone.arrays()) check(!finite || all_finite(*array), what + ": finite");
    check(all_finite(alone.alpha) && all_finite(alone.pictures), what + ": finite pictures");
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        const Result again = evaluate_features(scene, view, how);
        check(same_bits(again.radii, alone.radii), what + ": the same radii");
        for (std::size_t i = 0; i < alone.arrays().size(); ++i)
            check(same_bits(*again.arrays()[i], *alone.arrays()[i]), what + ": the same bits");
    }
}

void channels_and_sizes() {
    const Scene scene = random_scene(2, 130, 16);
    for (int channels : {1, 2, 3, 4, 5, 33})
        for (bool slanted : {false, true}) check_features(scene, {45, 37, channels, slanted, true}, true);
    for (const auto& [width, height] : {std::pair{1, 1}, {16, 16}, {17, 15}, {3, 40}, {40, 3}})
        check_features(scene, {width, height, 3, true, false}, true);
}

// Ragged ends of vectors: any number of Gaussians up to a few vectors, and none.
void counts() {
    for (int count = 0; count <= 35; ++count)
        check_features(random_scene(static_cast<std::uint64_t>(count), count, 16), {20, 18, 3, true, true}, true);
}

void hostile_values() {
    for (std::uint64_t seed = 0; seed < 8; ++seed)
        check_features(hostile_scene(seed, 150, 16), {45, 37, 5, true, true}, false);
}

}  // namespace

void test_features() {
    test_each_isa("features of any number of channels, in images of any size", channels_and_sizes);
    test_each_isa("features of any number of Gaussians", counts);
    test_each_isa("features of Gaussians with hostile values", hostile_values);
}
