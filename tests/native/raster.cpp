// Whole renders, forward and backward: the same bits for any number of threads and any input.
#include <atomic>
#include <string>
#include <thread>
#include <vector>

#include "base/threads.h"
#include "check.h"
#include "scenes.h"

namespace {

struct Size {
    int width, height;
};

constexpr Size kSizes[] = {{1, 1}, {16, 16}, {17, 15}, {70, 53}, {3, 40}, {40, 3}};

// Images are finite and completely written, with the same bits on 1, 2 and 5 threads.
void check_threads(const Scene& scene, const splat::View& view, bool depth, const std::string& what) {
    splat::set_threads(1);
    const Outcome alone = evaluate(scene, view, depth);
    for (const std::vector<float>* picture : alone.pictures()) check(all_finite(*picture), what + ": finite pictures");
    for (const std::vector<float>* gradient : alone.gradients())
        check(all_finite(*gradient), what + ": finite gradients");
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        const Outcome again = evaluate(scene, view, depth, -5.0f - static_cast<float>(threads));
        check(again.same_bits_as(alone), what + ": same bits with " + std::to_string(threads) + " threads");
    }
}

void sizes() {
    for (const Size& size : kSizes)
        for (bool depth : {true, false}) {
            const Options options{3, false, depth};
            check_threads(hostile_scene(3, 150, 16), view_of(size.width, size.height, 16, options), depth,
                          std::to_string(size.width) + " x " + std::to_string(size.height));
        }
}

void degrees() {
    for (int degree = 0; degree <= 3; ++degree)
        for (int sh_count : {(degree + 1) * (degree + 1), 16})
            for (bool antialias : {false, true})
                check_threads(hostile_scene(7, 90, sh_count), view_of(45, 37, sh_count, {degree, antialias}), true,
                              "degree " + std::to_string(degree) + " of " + std::to_string(sh_count));
}

// Ragged ends of vectors: any number of Gaussians up to a few vectors, and none.
void counts() {
    for (int count = 0; count <= 35; ++count)
        check_threads(random_scene(count, count, 4), view_of(20, 18, 4, {1}), true, std::to_string(count));
}

void opaque_layers_and_huge_splats() {
    Scene opaque = random_scene(2, 120, 1, -0.5f);
    for (float& logit : opaque.opacity_logits) logit += 5.0f;
    check_threads(opaque, view_of(40, 33, 1, {0}), true, "opaque");
    check_threads(random_scene(4, 30, 1, 6.0f), view_of(40, 33, 1, {0}), true, "huge");
    check_threads(random_scene(4, 200, 1, -12.0f), view_of(40, 33, 1, {0, true}), true, "tiny");
}

// Several tasks of the projection and chunks of the binning; many at the same depth.
void many_gaussians() {
    Scene scene = random_scene(9, 20'000, 1, -4.5f);
    for (std::size_t i = 2; i < scene.means.size(); i += 3) scene.means[i] = std::round(scene.means[i] * 4.0f) / 4.0f;
    check_threads(scene, view_of(120, 90, 1, {0}), true, "many");
}

// A frame reuses its memory: remains of a larger render must not show.
void a_frame_is_used_again() {
    splat::set_threads(2);
    splat::RasterFrame frame;
    for (int round = 0; round < 2; ++round)
        for (int count : {300, 7, 0, 90}) {
            const Scene scene = random_scene(static_cast<std::uint64_t>(count), count, 16);
            const splat::View view = view_of(20 + count / 4, 60 - count / 8, 16, {});
            const Outcome reused = evaluate(frame, scene, view, true, 1.0f);
            check(reused.same_bits_as(evaluate(scene, view, true)), std::to_string(count));
        }
}

// Beside the image, before the near plane, far from the origin: the cheap test culls nothing visible.
void candidates_are_all_that_is_visible() {
    const splat::ProjectKernels& kernels = SPLAT_KERNELS(project_kernels);
    for (const float log_scale : {-6.0f, -3.0f, -1.0f, 1.0f, 4.0f})
        for (std::uint64_t seed = 0; seed < 12; ++seed) {
            const float far = seed % 3 == 0 ? 0.0f : seed % 3 == 1 ? 300.0f : 1e5f;
            Scene scene = seed % 4 == 3 ? hostile_scene(seed, 2001, 1) : random_scene(seed, 2001, 1, log_scale);
            splat::View view = view_of(70 + 40 * static_cast<int>(seed % 2), 33, 1, {0, seed % 2 == 0});
            for (std::size_t i = 0; i < scene.means.size(); ++i) scene.means[i] += far;
            for (int row = 0; row < 3; ++row)
                for (int axis = 0; axis < 3; ++axis) view.translation[row] -= view.rotation[3 * row + axis] * far;
            const splat::Parameters in = scene.parameters();
            const std::size_t n = static_cast<std::size_t>(in.count);
            std::vector<std::int32_t> all(n), found(n);
            for (std::size_t i = 0; i < n; ++i) all[i] = static_cast<std::int32_t>(i);
            std::vector<splat::Splat> splats(n);
            std::vector<std::uint32_t> keys(n);
            std::vector<splat::Touched> touched(n + 1);
            std::vector<float> radii(n);
            std::vector<std::uint8_t> visible(n), kept(n);
            splat::FrameData frame{};
            frame.rows = all.data(), frame.splats = splats.data(), frame.keys = keys.data();
            frame.touched = touched.data();
            kernels.project(view, in, 0, in.count, frame, radii.data(), visible.data());
            const std::int64_t count = kernels.find_candidates(view, in, 0, in.count, found.data());
            for (std::int64_t i = 0; i < count; ++i)
                kept[static_cast<std::size_t>(found[static_cast<std::size_t>(i)])] = 1;
            std::int64_t seen = 0;
            for (std::size_t i = 0; i < n; ++i) {
                check(kept[i] || !visible[i], "row " + std::to_string(i) + " of scene " + std::to_string(seed));
                seen += visible[i];
            }
            const std::string what = std::to_string(count) + " candidates for " + std::to_string(seen);
            if (seed == 9 && log_scale < -2.0f) check(count < 1.3 * seen + 50, what);  // not anti-aliased, near, small
        }
}

// Threads that render, each with a borrowed frame, while another one changes the number of threads.
void renders_at_once() {
    splat::set_threads(2);
    std::vector<Scene> scenes;
    std::vector<Outcome> alone;
    const splat::View view = view_of(50, 40, 16, {});
    for (std::uint64_t seed = 0; seed < 4; ++seed) {
        scenes.push_back(random_scene(seed, 80, 16));
        alone.push_back(evaluate(scenes.back(), view, true));
    }
    std::atomic<int> wrong{0};
    std::vector<std::thread> callers;
    for (std::size_t i = 0; i < scenes.size(); ++i)
        callers.emplace_back([&, i] {
            for (int round = 0; round < 4; ++round) {
                const std::shared_ptr<splat::RasterFrame> frame = splat::borrow_frame();
                wrong += !evaluate(*frame, scenes[i], view, true, 3.0f).same_bits_as(alone[i]);
            }
        });
    for (int threads : {1, 3, 2, 5}) {
        splat::set_threads(threads);
        std::this_thread::yield();
    }
    for (std::thread& caller : callers) caller.join();
    check(wrong == 0, "each caller has its own render");
}

void frames_are_borrowed_and_returned_anywhere() {
    std::vector<std::thread> borrowers;
    for (int i = 0; i < 5; ++i)
        borrowers.emplace_back([] {
            for (int round = 0; round < 50; ++round) {
                const auto first = splat::borrow_frame(), second = splat::borrow_frame();
                check(first != second, "two borrowers never share a frame");
            }
        });
    for (std::thread& borrower : borrowers) borrower.join();
}

}  // namespace

void test_raster() {
    test_each_isa("hostile numbers at any picture size", sizes);
    test_each_isa("hostile numbers at any SH degree", degrees);
    test_each_isa("any number of Gaussians", counts);
    test_each_isa("opaque layers, huge and tiny splats", opaque_layers_and_huge_splats);
    test_each_isa("many Gaussians", many_gaussians);
    test_each_isa("candidates are all that is visible", candidates_are_all_that_is_visible);
    test_each_isa("a frame is used again", a_frame_is_used_again);
    test_each_isa("renders at once", renders_at_once);
    test("frames are borrowed and returned anywhere", frames_are_borrowed_and_returned_anywhere);
}
