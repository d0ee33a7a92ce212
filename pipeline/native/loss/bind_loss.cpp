// Python bindings of the loss and of the affine map of colours: argument checks; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>

#include <array>
#include <cstdint>
#include <optional>

#include "loss/affine_colour.h"
#include "loss/colour.h"
#include "loss/loss_math.h"
#include "loss/photo_loss.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using MutableImage = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rectangle = std::array<int, 4>;  // left, top, right, bottom

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
}
