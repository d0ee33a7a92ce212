// Surfaces: no out-of-bounds access to depths, pixels and results, for any places and depths.
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <string>
#include <vector>

#include "check.h"
#include "surface/surface_cell_votes.h"
#include "surface/surface_colours.h"
#include "surface/surface_mosaic.h"
#include "surface/surface_sight.h"

namespace {

splat::SurfaceCamera camera_of(int width, int height, double up) {
    splat::SurfaceCamera camera{};
    camera.width = width, camera.height = height, camera.fx = camera.fy = 0.8 * width;
    camera.cx = 0.5 * width, camera.cy = 0.5 * height;
    const double down[] = {1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0};
    for (int k = 0; k < 9; ++k) camera.turn[k] = down[k];
    camera.shift[2] = camera.centre[2] = up;
    return camera;
}

void check_votes(int width, int height) {
    Random random(static_cast<std::uint64_t>(width * 1000 + height));
    const std::size_t size = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    std::vector<float> depth(size);
    std::vector<std::uint8_t> confidence(size);
    for (std::size_t k = 0; k < size; ++k) {
        const float odd[] = {0.0f, -1.0f, std::numeric_limits<float>::infinity(), std::nanf("")};
        depth[k] = random.below(8) ? 20.0f + 0.01f * static_cast<float>(random.below(9)) : odd[random.below(4)];
        confidence[k] = static_cast<std::uint8_t>(random.below(256));
    }
    const splat::DepthPicture picture{camera_of(width, height, 20.0), depth.data(), confidence.data()};
    splat::CellVotes votes({-3.0, 3.0, 0.1, -2, 1, 40, 50, -1.0, 1.0});
    for (int photo = 0; photo < 3; ++photo) votes.add(picture, 0, 0, width, height);
    const std::size_t cells = static_cast<std::size_t>(votes.cells());
    std::vector<double> found(3 * cells), cover(3 * cells), fitted(cells), sigma(cells);
    std::vector<std::int32_t> counts(3 * cells), photos(cells);
    votes.layers({found.data(), counts.data(), cover.data()});
    votes.fit(found.data(), {fitted.data(), sigma.data(), photos.data()});
    for (std::size_t cell = 0; cell < cells; ++cell)
        check(std::isnan(fitted[cell]) || (fitted[cell] > -1.0 && fitted[cell] < 1.0), "heights within the relief");
    std::vector<double> east(500), north(500), up(500);
    for (std::size_t k = 0; k < 500; ++k) {
        const double odd[] = {0.0, 1e300, -1e300, std::nan(""), std::numeric_limits<double>::infinity()};
        east[k] = k % 7 ? 0.03 * static_cast<double>(k) - 7.5 : odd[random.below(5)];
        north[k] = k % 11 ? 0.05 * static_cast<double>(k % 200) - 5.0 : odd[random.below(5)];
        up[k] = k % 13 ? 0.0 : odd[random.below(5)];
    }
    const splat::Places places{500, east.data(), north.data(), up.data()};
    std::vector<std::uint8_t> said(500), seen(500), colour(1500), pixels(3 * size, 200), tone(768);
    std::vector<std::uint16_t> cost(500);
    for (std::size_t k = 0; k < 768; ++k) tone[k] = static_cast<std::uint8_t>(k / 3);
    SPLAT_KERNELS(sight_kernels).look(picture, places, nullptr, 0.01, said.data());
    SPLAT_KERNELS(sight_kernels).rate(picture.camera, places, 0.1, said.data(), cost.data(), seen.data());
    for (double cell : {0.01, 1.0, 1e6}) {
        const splat::Photo photo{picture.camera, {}, width, height, pixels.data(), tone.data()};
        splat::sample_photo(photo, places, cell, seen.data(), colour.data());
        for (std::size_t k = 0; k < 500; ++k) check(colour[3 * k] == (seen[k] ? 200 : 0), "the photo's one colour");
    }
}

void check_mosaic(int photos, int width, int height) {
    Random random(static_cast<std::uint64_t>(width * 1000 + height));
    const std::size_t cells = static_cast<std::size_t>(width) * static_cast<std::size_t>(height);
    const std::size_t size = cells * static_cast<std::size_t>(photos);
    std::vector<std::uint8_t> seen(size), colour(3 * size), blended(3 * cells), seen_by(cells);
    std::vector<std::uint16_t> cost(size);
    std::vector<std::int16_t> label(cells);
    for (std::size_t k = 0; k < size; ++k) {
        seen[k] = random.below(3) != 0, cost[k] = static_cast<std::uint16_t>(random.below(splat::kHidden + 1));
        for (std::size_t channel = 0; channel < 3; ++channel)
            colour[3 * k + channel] = static_cast<std::uint8_t>(random.below(256));
    }
    splat::keep_best(photos, width * height, 3, cost.data(), seen.data(), seen_by.data());
    splat::compose_mosaic({photos, width, height, 1, seen.data(), colour.data(), cost.data()},
                          {label.data(), blended.data()});
    for (std::size_t cell = 0; cell < cells; ++cell) {
        check(label[cell] >= -1 && label[cell] < photos, "a photo, or none");
        check((label[cell] < 0) == (seen_by[cell] == 0), "none where none sees");
        if (label[cell] >= 0) check(seen[static_cast<std::size_t>(label[cell]) * cells + cell], "one that sees");
    }
}

}  // namespace

void test_surface() {
    for (int width : {1, 3, 64, 131})
        test_each_isa("surfaces from photos " + std::to_string(width) + " wide", [=] {
            check_votes(width, 5), check_votes(width, 40);
            for (int photos : {0, 1, 5}) check_mosaic(photos, width, 1), check_mosaic(photos, width, 30);
        });
}
