// Python bindings of the search for nearest descriptors: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/tuple.h>

#include <cstdint>
#include <tuple>

#include "descriptors/nearest.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Descriptors = nb::ndarray<const std::uint8_t, nb::shape<-1, splat::kDescriptor>, nb::c_contig, nb::device::cpu>;
using Bounds = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Products = nb::ndarray<std::int32_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

void check(const Bounds& bounds, const Descriptors& of) {
    const std::int64_t count = static_cast<std::int64_t>(of.shape(0));
    require(bounds.shape(0) >= 1 && bounds.data()[0] >= 0, "no bounds");
    for (std::size_t g = 1; g < bounds.shape(0); ++g)
        require(bounds.data()[g] >= bounds.data()[g - 1], "bounds are not in order");
    require(bounds.data()[bounds.shape(0) - 1] <= count && count <= splat::kNearestMost, "bounds are out of range");
}

void nearest_descriptors(const std::tuple<Descriptors, Bounds>& queries, const std::tuple<Descriptors, Bounds>& values,
                         const std::tuple<Rows, Products, Products>& found) {
    const auto& [wanted, query_bounds] = queries;
    const auto& [others, value_bounds] = values;
    const auto& [rows, best, second] = found;
    check(query_bounds, wanted), check(value_bounds, others);
    require(query_bounds.shape(0) == value_bounds.shape(0), "queries and values differ in groups");
    const std::size_t count = wanted.shape(0);
    require(rows.shape(0) == count && best.shape(0) == count && second.shape(0) == count, "results differ in size");
    const splat::NearestJob job{wanted.data(), static_cast<std::int64_t>(count),
                                others.data(), static_cast<std::int64_t>(others.shape(0)),
                                rows.data(),   best.data(),
                                second.data()};
    const nb::gil_scoped_release released;
    splat::compare_groups(job, query_bounds.data(), value_bounds.data(),
                          static_cast<std::int64_t>(query_bounds.shape(0)) - 1);
}

}  // namespace

void bind_descriptors(nb::module_& m) {
    m.def("nearest_descriptors", &nearest_descriptors, "queries"_a, "values"_a, "found"_a);
}
