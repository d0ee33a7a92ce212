// Python bindings of the loss, the steps between it and the rasterizer, and the optimiser: argument checks.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <cstdint>
#include <optional>
#include <tuple>
#include <vector>

#include "adam.h"
#include "adam_step.h"
#include "affine_colour.h"
#include "colour.h"
#include "loss_math.h"
#include "photo_loss.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using MutableImage = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rectangle = std::array<int, 4>;  // left, top, right, bottom
using Rows = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstRows = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Rates = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using RowMask = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

double photo_loss(const Image& render, const Image& photo, const std::optional<Mask>& mask, double ssim_weight,
                  const MutableImage& gradient, const std::optional<Rectangle>& inner) {
    const std::size_t height = render.shape(0), width = render.shape(1);
    require(photo.shape(0) == height && photo.shape(1) == width, "render and photo differ in size");
    require(gradient.shape(0) == height && gradient.shape(1) == width, "render and gradient differ in size");
    require(!mask || (mask->shape(0) == height && mask->shape(1) == width), "render and mask differ in size");
    require(height >= splat::kLossMinSide && width >= splat::kLossMinSide, "the loss needs 6 pixels a side");
    require(height <= INT32_MAX / 4 && width <= INT32_MAX / 4, "the image is too large");
    const auto [left, top, right, bottom] =
        inner.value_or(Rectangle{0, 0, static_cast<int>(width), static_cast<int>(height)});
    require(0 <= left && left < right && right <= static_cast<int>(width), "no columns of the image count");
    require(0 <= top && top < bottom && bottom <= static_cast<int>(height), "no rows of the image count");
    const splat::LossImages images{render.data(),
                                   photo.data(),
                                   mask ? mask->data() : nullptr,
                                   gradient.data(),
                                   static_cast<int>(height),
                                   static_cast<int>(width),
                                   {left, top, right, bottom}};
    nb::gil_scoped_release release;
    return splat::photo_loss(images, ssim_weight);
}

using Affine = nb::ndarray<const float, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;
using MutableAffine = nb::ndarray<float, nb::shape<3, 4>, nb::c_contig, nb::device::cpu>;

void affine_colour(const Affine& map, const Image& in, const MutableImage& out) {
    require(in.shape(0) == out.shape(0) && in.shape(1) == out.shape(1), "pictures differ in size");
    nb::gil_scoped_release release;
    splat::affine_colour(map.data(), in.data(), static_cast<std::int64_t>(in.size() / 3), out.data());
}

void affine_colour_backward(const Affine& map, const Image& in, const Image& upstream, const MutableImage& gradient,
                            const MutableAffine& map_gradient) {
    require(in.shape(0) == upstream.shape(0) && in.shape(1) == upstream.shape(1), "pictures differ in size");
    require(in.shape(0) == gradient.shape(0) && in.shape(1) == gradient.shape(1), "pictures differ in size");
    double sums[splat::kAffine];
    {
        nb::gil_scoped_release release;
        splat::affine_colour_backward(map.data(), in.data(), upstream.data(), static_cast<std::int64_t>(in.size() / 3),
                                      gradient.data(), sums);
    }
    for (int k = 0; k < splat::kAffine; ++k) map_gradient.data()[k] = static_cast<float>(sums[k]);
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

void bind_loss(nb::module_& m) {
    m.def("photo_loss", &photo_loss, "render"_a.noconvert(), "photo"_a.noconvert(), "mask"_a.noconvert().none(),
          "ssim_weight"_a, "gradient"_a.noconvert(), "inner"_a = nb::none(),
          "(1 - w) L1 + w (1 - SSIM) of two (h, w, 3) images; its gradient by the render goes to `gradient`.");
    m.def("affine_colour", &affine_colour, "affine"_a.noconvert(), "picture"_a.noconvert(), "out"_a.noconvert(),
          "The colours of an (h, w, 3) picture through a (3, 4) affine map, to `out`.");
    m.def("affine_colour_backward", &affine_colour_backward, "affine"_a.noconvert(), "picture"_a.noconvert(),
          "upstream"_a.noconvert(), "gradient"_a.noconvert(), "by_affine"_a.noconvert(),
          "Gradients by the picture and by the map, from the one by the result.");
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
