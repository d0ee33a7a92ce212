// Scenes, cameras and whole renders for the native tests.
#pragma once

#include <cstdint>
#include <vector>

#include "raster/raster_cpu.h"

struct Scene {
    std::vector<float> means, log_scales, quats, opacity_logits, sh;
    int sh_count;

    std::int64_t count() const { return static_cast<std::int64_t>(opacity_logits.size()); }
    splat::Parameters parameters() const;
    std::vector<std::vector<float>*> tensors();
};

struct Options {
    int sh_degree = 3;
    bool antialias = false, depth = true;
};

// Gaussians before a camera at the origin, some outside its view, some behind it. log_scale: the mean one.
Scene random_scene(std::uint64_t seed, int count, int sh_count, float log_scale = -1.5f);

// The same with NaN, infinities, the largest and smallest numbers, opacities of 0 and 1, zero quaternions.
Scene hostile_scene(std::uint64_t seed, int count, int sh_count);

// At the origin, looking along z, a little turned, its principal point off the centre.
splat::View view_of(int width, int height, int sh_count, const Options& options);

// A render, and the gradients of a sum of its pictures with random weights.
struct Outcome {
    std::vector<float> colour, alpha, depth_sum, depth_square_sum, median_depth, radii;
    std::vector<std::uint8_t> visible;
    std::vector<float> means, log_scales, quats, opacity_logits, sh, means2d, magnitudes;
    double sum;

    std::vector<const std::vector<float>*> pictures() const;
    std::vector<const std::vector<float>*> gradients() const;
    bool same_bits_as(const Outcome& other) const;
};

// unwritten: what arrays hold before; a value that a kernel does not write shows by it.
Outcome evaluate(splat::RasterFrame& frame, const Scene& scene, const splat::View& view, bool depth, float unwritten);
Outcome evaluate(const Scene& scene, const splat::View& view, bool depth, float unwritten = 77.0f);
