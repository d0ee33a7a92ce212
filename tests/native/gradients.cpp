// The backward pass against central differences of the forward pass.
#include <cmath>
#include <string>

#include "base/threads.h"
#include "check.h"
#include "scenes.h"

namespace {

// Of the raw parameters. With it, the differences' own error (third derivative · step² / 6, and the pictures' rounding
// over the step) stays well below the tolerance; the Python tests compare with float64 more closely.
constexpr float kStep = 8e-3f;
constexpr double kTolerance = 1e-2;  // L2, relative

// Splats larger than the image, well inside the frustum and never opaque together: no threshold (1/255, 1e-4, a
// clamp) is crossed anywhere, so every image is smooth.
Scene smooth_scene(int sh_count) {
    Scene scene = random_scene(11, 6, sh_count);
    Random random(12);
    for (std::size_t i = 0; i < 6; ++i) {
        const float z = 3.0f + 0.4f * static_cast<float>(i);
        scene.means[3 * i] = random.uniform(-0.2f, 0.2f) - 0.1f * z,
                        scene.means[3 * i + 1] = random.uniform(-0.2f, 0.2f);
        scene.means[3 * i + 2] = z;
        scene.opacity_logits[i] = random.uniform(-1.0f, 0.5f);
        for (std::size_t j = 0; j < 3; ++j) scene.log_scales[3 * i + j] = random.uniform(-1.2f, 0.3f);
    }
    for (std::size_t i = 0; i < scene.sh.size(); ++i) {
        const bool constant = i / 3 % static_cast<std::size_t>(sh_count) == 0;
        scene.sh[i] = constant ? random.uniform(0.5f, 2.0f) : random.uniform(-0.1f, 0.1f);
    }
    return scene;
}

void check_gradients(const Options& options) {
    const int sh_count = (options.sh_degree + 1) * (options.sh_degree + 1);
    const splat::View view = view_of(19, 18, sh_count, options);
    Scene scene = smooth_scene(sh_count);
    const Outcome outcome = evaluate(scene, view, true);
    const char* names[] = {"means", "log_scales", "quats", "opacity_logits", "sh"};
    for (std::size_t t = 0; t < 5; ++t) {
        std::vector<float>& tensor = *scene.tensors()[t];
        double error2 = 0.0, size2 = 0.0;
        for (std::size_t i = 0; i < tensor.size(); ++i) {
            const float value = tensor[i], up = value + kStep, down = value - kStep;
            tensor[i] = up;
            const double above = evaluate(scene, view, true).sum;
            tensor[i] = down;
            const double below = evaluate(scene, view, true).sum;
            tensor[i] = value;
            const double slope = (above - below) / (double{up} - double{down});
            error2 += std::pow(double{(*outcome.gradients()[t])[i]} - slope, 2), size2 += slope * slope;
        }
        const double relative = std::sqrt(error2 / size2);
        check(relative < kTolerance, std::string(names[t]) + " off by " + std::to_string(relative));
    }
}

}  // namespace

void test_gradients() {
    splat::set_threads(1);
    test_each_isa("gradients are central differences", [] { check_gradients({1, false}); });
    test_each_isa("gradients are central differences, anti-aliased", [] { check_gradients({2, true}); });
}
