// Python bindings of the sky behind a render: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <climits>
#include <cstdint>
#include <optional>
#include <tuple>

#include "sky/sky_behind.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using MutableImage = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Plane = nb::ndarray<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using MutablePlane = nb::ndarray<float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
// alpha, nodes; elsewhere, around, mask; step, background
using SkyTuple =
    std::tuple<Plane, Image, std::optional<Image>, std::optional<Mask>, std::optional<Mask>, int, std::array<float, 3>>;

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

template <class A, class B>
bool same_size(const A& a, const B& b) {
    return a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1);
}

splat::SkyJob job_of(const SkyTuple& sky) {
    const auto& [alpha, nodes, elsewhere, around, mask, step, background] = sky;
    for (std::size_t side : {alpha.shape(0), alpha.shape(1), nodes.shape(0), nodes.shape(1)})
        require(side >= 1 && side <= INT_MAX / 8, "a picture or the nodes are empty or too large");
    require(!elsewhere || same_size(*elsewhere, nodes), "nodes and those elsewhere differ in number");
    require(!around || same_size(*around, alpha), "picture and surroundings differ in size");
    require(!mask || same_size(*mask, alpha), "picture and mask differ in size");
    splat::SkyJob job{};
    job.width = static_cast<int>(alpha.shape(1)), job.height = static_cast<int>(alpha.shape(0));
    job.rows = static_cast<int>(nodes.shape(0)), job.columns = static_cast<int>(nodes.shape(1)), job.step = step;
    for (int k = 0; k < 3; ++k) job.background[k] = background[static_cast<std::size_t>(k)];
    job.alpha = alpha.data(), job.nodes = nodes.data();
    job.elsewhere = elsewhere ? elsewhere->data() : nullptr;
    job.around = around ? around->data() : nullptr;
    job.mask = mask ? mask->data() : nullptr;
    require(splat::is_sound(job), "the nodes do not reach the last pixel, or what is around is missing");
    return job;
}

void lay_over(const SkyTuple& sky, const Image& colour, const MutableImage& out) {
    splat::SkyJob job = job_of(sky);
    require(same_size(colour, std::get<0>(sky)) && same_size(out, colour), "pictures differ in size");
    job.colour = colour.data();
    nb::gil_scoped_release release;
    splat::lay_over(job, out.data());
}

void lay_over_backward(const SkyTuple& sky, const Image& upstream, const MutablePlane& by_alpha,
                       const std::optional<MutableImage>& by_nodes) {
    const splat::SkyJob job = job_of(sky);
    require(same_size(upstream, std::get<0>(sky)) && same_size(by_alpha, upstream), "pictures differ in size");
    require(!by_nodes || (job.mask && same_size(*by_nodes, std::get<1>(sky))), "no mask, or as many nodes");
    nb::gil_scoped_release release;
    splat::lay_over_backward(job, upstream.data(), by_alpha.data(), by_nodes ? by_nodes->data() : nullptr);
}

}  // namespace

void bind_sky(nb::module_& m) {
    m.def("lay_over", &lay_over, "sky"_a, "colour"_a.noconvert(), "out"_a.noconvert(),
          "A render with something else behind it than its background, to `out`.");
    m.def("lay_over_backward", &lay_over_backward, "sky"_a, "upstream"_a.noconvert(), "by_alpha"_a.noconvert(),
          "by_nodes"_a.noconvert().none(), "Gradients by the opacity and the nodes, from the one by the result.");
}
