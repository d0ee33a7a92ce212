// Python bindings of the optimiser: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

#include "adam/adam.h"
#include "adam/adam_step.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Rows = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstRows = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Rates = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using RowMask = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

std::int64_t adam_step(const std::vector<Rows>& values, const std::vector<ConstRows>& gradients,
                       const std::vector<Rows>& means, const std::vector<Rows>& squares,
                       const std::vector<Rates>& rates, const std::optional<RowMask>& visible,
                       const splat::AdamOptions& options) {
    const std::size_t count = values.size();
    require(count <= splat::kAdamTensors, "too many tensors");
    require(gradients.size() == count && means.size() == count && squares.size() == count && rates.size() == count,
            "not as many gradients, moments and rates as tensors");
    require(options.step >= 1, "steps count from 1");
    const std::size_t rows = count && values[0].ndim() ? values[0].shape(0) : 0;
    require(!visible || visible->shape(0) == rows, "visible has another number of rows");
    if (!rows) return 0;
    std::vector<splat::AdamRows> tensors;
    for (std::size_t t = 0; t < count; ++t) {
        const std::size_t size = values[t].size(), width = rates[t].shape(0);
        require(width >= 1 && width <= splat::kAdamWidth, "a row has 1 to 64 values");
        require(size == rows * width, "rows or rates differ between tensors");
        require(gradients[t].size() == size && means[t].size() == size && squares[t].size() == size,
                "a gradient or moment differs in size from its tensor");
        tensors.push_back({values[t].data(), gradients[t].data(), means[t].data(), squares[t].data(), rates[t].data(),
                           static_cast<int>(width)});
    }
    nb::gil_scoped_release release;
    return splat::adam_step(tensors, static_cast<std::int64_t>(rows), visible ? visible->data() : nullptr, options);
}

}  // namespace

void bind_adam(nb::module_& m) {
    m.def(
        "adam_step",
        [](const std::vector<Rows>& values, const std::vector<ConstRows>& gradients, const std::vector<Rows>& means,
           const std::vector<Rows>& squares, const std::vector<Rates>& rates, const std::optional<RowMask>& visible,
           std::tuple<double, double, double, std::int64_t> options) {
            const auto [beta1, beta2, epsilon, step] = options;
            return adam_step(values, gradients, means, squares, rates, visible, {beta1, beta2, epsilon, step});
        },
        "values"_a.noconvert(), "gradients"_a.noconvert(), "means"_a.noconvert(), "squares"_a.noconvert(),
        "rates"_a.noconvert(), "visible"_a.noconvert().none(), "options"_a,
        "One Adam step in place; options: (beta1, beta2, epsilon, step). Returns the rows left out for their "
        "gradients.");
}
