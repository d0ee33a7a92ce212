// Python bindings of PatchMatch: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <climits>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <tuple>
#include <vector>

#include "patch_match/patch_match.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Bytes = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const float, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;
using Vector = nb::ndarray<const float, nb::shape<3>, nb::c_contig, nb::device::cpu>;
using Planes = nb::ndarray<float, nb::shape<3, -1, -1>, nb::c_contig, nb::device::cpu>;
using Costs = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Picture = std::tuple<Bytes, Bytes>;                // grey values, and the mask of valid ones
using Other = std::tuple<Bytes, Bytes, Matrix, Vector>;  // the same, rotation and translation

constexpr std::size_t kLeastSide = 4;
constexpr std::size_t kMostPixels = INT_MAX / 4;

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

template <class A, class B>
bool same_size(const A& a, const B& b) {
    return a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1);
}

void check(const Bytes& grey, const Bytes& counts) {
    const bool is_large = grey.shape(0) >= kLeastSide && grey.shape(1) >= kLeastSide;
    require(is_large && grey.shape(0) <= kMostPixels / grey.shape(1), "a photo is too small or too large");
    require(same_size(grey, counts), "a photo and its mask differ in size");
}

// Four grey values per pixel: its own, right, below, below right; border values are repeated.
std::vector<std::uint32_t> corners_of(const Bytes& grey) {
    const std::size_t height = grey.shape(0), width = grey.shape(1);
    std::vector<std::uint32_t> corners(height * width);
    for (std::size_t y = 0; y < height; ++y) {
        const std::uint8_t* row = grey.data() + y * width;
        const std::uint8_t* below = y + 1 < height ? row + width : row;
        for (std::size_t x = 0; x < width; ++x) {
            const std::size_t next = x + 1 < width ? x + 1 : x;
            const std::uint32_t upper = row[x] | std::uint32_t{row[next]} << 8;
            corners[y * width + x] = upper | std::uint32_t{below[x]} << 16 | std::uint32_t{below[next]} << 24;
        }
    }
    return corners;
}

void patch_match(const Picture& photo, const std::vector<Other>& others, std::tuple<float, float> range, int iterations,
                 int begun, std::uint32_t seed, const Planes& planes, const Costs& costs) {
    const auto& [grey, counts] = photo;
    const auto [least, most] = range;
    check(grey, counts);
    require(!others.empty() && others.size() <= splat::kPatchMostViews, "no other photo, or too many");
    require(std::isfinite(most) && least > 0.0f && most >= least, "the range of inverse depths is empty");
    require(iterations >= 0 && iterations <= 64, "too many iterations");
    require(begun >= 0 && begun <= 64, "begun too far on");
    require(planes.shape(1) == grey.shape(0) && planes.shape(2) == grey.shape(1) && same_size(costs, grey),
            "planes, costs and the photo differ in size");
    std::vector<std::vector<std::uint32_t>> corners;
    std::vector<splat::PatchView> views;
    for (const auto& [theirs, mask, turn, shift] : others) {
        check(theirs, mask);
        corners.push_back(corners_of(theirs));
        splat::PatchView view{};
        view.width = static_cast<int>(theirs.shape(1)), view.height = static_cast<int>(theirs.shape(0));
        view.corners = corners.back().data(), view.counts = mask.data();
        for (int k = 0; k < 9; ++k) view.turn[k] = turn.data()[k];
        for (int k = 0; k < 3; ++k) view.shift[k] = shift.data()[k];
        views.push_back(view);
    }
    splat::PatchJob job{};
    job.width = static_cast<int>(grey.shape(1)), job.height = static_cast<int>(grey.shape(0));
    job.grey = grey.data(), job.counts = counts.data();
    job.views = views.data(), job.view_count = static_cast<int>(views.size());
    job.least = least, job.most = most, job.seed = seed, job.begun = begun;
    job.planes = planes.data(), job.costs = costs.data();
    const nb::gil_scoped_release released;
    splat::patch_match(job, iterations);
}

}  // namespace

void bind_patch_match(nb::module_& m) {
    m.def("patch_match", &patch_match, "photo"_a, "others"_a, "inverse_range"_a, "iterations"_a, "begun"_a, "seed"_a,
          "planes"_a.noconvert(), "costs"_a.noconvert());
}
