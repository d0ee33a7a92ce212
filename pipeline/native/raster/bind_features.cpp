// Python bindings of the kernels that take activated values and plain features; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <cmath>
#include <limits>
#include <memory>
#include <optional>
#include <tuple>

#include "raster/features_cpu.h"
#include "raster/view.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T>
using Rows = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Optional = std::optional<Rows<T>>;
using In = Rows<const float>;
using Out = Rows<float>;
using Radii = Rows<const int32_t>;

// cam_from_world; its inverse's centre; width, height; fx, fy, cx, cy
using CameraTuple = std::tuple<nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>,
                               std::array<double, 3>, std::array<int, 2>, std::array<double, 4>>;
// near, far, blur_px2, plane_sigmas, compensation_min, radius_clip
using OptionsArray = std::array<double, 6>;

// The data of an array of `rows` rows of `width` values.
template <class T>
T* checked(const Rows<T>& array, size_t rows, size_t width, const char* name) {
    if (!array.ndim() || array.shape(0) != rows || array.size() != rows * width) throw nb::value_error(name);
    return array.data();
}

template <class T>
T* checked(const Optional<T>& array, size_t rows, size_t width, const char* name) {
    return array ? checked(*array, rows, width, name) : nullptr;
}

size_t rows_of(const In& means) {
    if (means.ndim() != 2 || means.shape(0) > size_t(std::numeric_limits<int32_t>::max()))
        throw nb::value_error("rows");
    return means.shape(0);
}

splat::View view_of(const CameraTuple& camera, double near_z, int sh_degree, size_t sh_count) {
    const auto& [pose, centre, size, intrinsics] = camera;
    SplatShot shot{};
    for (int i = 0; i < 12; ++i) shot.cam_from_world[i] = pose(i / 4, i % 4);
    shot.fx = intrinsics[0], shot.fy = intrinsics[1], shot.cx = intrinsics[2], shot.cy = intrinsics[3];
    shot.near_z = near_z;
    shot.width = shot.whole_width = size[0], shot.height = shot.whole_height = size[1];
    shot.sh_degree = sh_degree;
    shot.sh_count = static_cast<int32_t>(sh_count <= splat::kMaxShCount ? sh_count : splat::kMaxShCount + 1);
    splat::View view{};
    if (const char* wrong = splat::find_view(shot, &view)) throw nb::value_error(wrong);
    for (int i = 0; i < 3; ++i) view.centre[i] = static_cast<float>(centre[i]);  // also of a pose that scales
    return view;
}

splat::ProjectOptions options_of(const OptionsArray& options) {
    const auto limited = [&](int i) { return static_cast<float>(options[i]); };
    return {limited(1), limited(2), limited(3), limited(4), limited(5)};
}

splat::ActivatedGaussians gaussians_of(const std::tuple<In, In, In, In>& arrays) {
    const auto& [means, quats, scales, opacities] = arrays;
    const size_t n = rows_of(means);
    return {static_cast<int64_t>(n), checked(means, n, 3, "means"), checked(quats, n, 4, "quats"),
            checked(scales, n, 3, "scales"), checked(opacities, n, 1, "opacities")};
}

void project(const std::tuple<In, In, In, In>& gaussians, const CameraTuple& camera, const OptionsArray& options,
             const std::tuple<Out, Out, Out, Out, Optional<float>, Optional<float>, Rows<int32_t>>& outputs) {
    const splat::ActivatedGaussians in = gaussians_of(gaussians);
    const splat::View view = view_of(camera, options[0], 0, 1);
    const auto& [means2d, depths, covariances, determinants, compensations, slants, radii] = outputs;
    const size_t n = in.count;
    const splat::Projected out = {checked(means2d, n, 2, "means2d"),
                                  checked(depths, n, 1, "depths"),
                                  checked(covariances, n, 3, "covariances"),
                                  checked(determinants, n, 1, "determinants"),
                                  checked(compensations, n, 1, "compensations"),
                                  checked(slants, n, 2, "slants"),
                                  checked(radii, n, 2, "radii")};
    nb::gil_scoped_release release;
    splat::project_activated(view, options_of(options), in, out);
}

void project_backward(const std::tuple<In, In, In, In>& gaussians, const CameraTuple& camera,
                      const OptionsArray& options, const Radii& radii,
                      const std::tuple<Optional<const float>, Optional<const float>, Optional<const float>,
                                       Optional<const float>, Optional<const float>>& gradients,
                      const std::tuple<Out, Out, Out>& outputs) {
    const splat::ActivatedGaussians in = gaussians_of(gaussians);
    const splat::View view = view_of(camera, options[0], 0, 1);
    const size_t n = in.count;
    const auto& [means2d, depths, covariances, compensations, slants] = gradients;
    const auto& [means, quats, scales] = outputs;
    const splat::ProjectedGradients upstream = {
        checked(means2d, n, 2, "means2d"), checked(depths, n, 1, "depths"), checked(covariances, n, 3, "covariances"),
        checked(compensations, n, 1, "compensations"), checked(slants, n, 2, "slants")};
    const splat::ActivatedGradients out = {checked(means, n, 3, "means"), checked(quats, n, 4, "quats"),
                                           checked(scales, n, 3, "scales")};
    const int32_t* seen = checked(radii, n, 2, "radii");
    nb::gil_scoped_release release;
    splat::project_activated_backward(view, options_of(options), in, seen, upstream, out);
}

splat::ShRows sh_rows_of(const In& means, const In& sh, const Radii& radii) {
    const size_t n = rows_of(means);
    if (sh.ndim() != 3 || sh.shape(2) != 3) throw nb::value_error("sh");
    return {static_cast<int64_t>(n), checked(means, n, 3, "means"), checked(sh, n, 3 * sh.shape(1), "sh"),
            checked(radii, n, 2, "radii")};
}

void sh_colours(const In& means, const In& sh, const Radii& radii, const CameraTuple& camera, int degree,
                const Out& colours) {
    const splat::ShRows in = sh_rows_of(means, sh, radii);
    const splat::View view = view_of(camera, 0.0, degree, sh.shape(1));
    float* out = checked(colours, in.count, 3, "colours");
    nb::gil_scoped_release release;
    splat::sh_colours(view, in, out);
}

void sh_colours_backward(const In& means, const In& sh, const Radii& radii, const CameraTuple& camera, int degree,
                         const In& gradients, const Out& by_means, const Out& by_sh) {
    const splat::ShRows in = sh_rows_of(means, sh, radii);
    const splat::View view = view_of(camera, 0.0, degree, sh.shape(1));
    const float* upstream = checked(gradients, in.count, 3, "gradients");
    float* means_out = checked(by_means, in.count, 3, "means");
    float* sh_out = checked(by_sh, in.count, 3 * sh.shape(1), "sh");
    nb::gil_scoped_release release;
    splat::sh_colours_backward(view, in, upstream, means_out, sh_out);
}

// means2d, depths, covariances, determinants, opacities, features, slants, radii
using SplatArrays = std::tuple<In, In, In, In, In, In, Optional<const float>, Radii>;

// A view's blended features and what its backward pass needs.
class FeatureFrame {
  public:
    void forward(const SplatArrays& splats, const std::array<int, 2>& size, double alpha_max,
                 const Optional<const float>& background, const std::tuple<Out, Out>& outputs) {
        const splat::ScreenSplats in = splats_of(splats);
        SplatShot shot{};
        shot.fx = shot.fy = 1.0, shot.sh_count = 1;
        shot.width = shot.whole_width = size[0], shot.height = shot.whole_height = size[1];
        splat::View view{};
        if (const char* wrong = splat::find_view(shot, &view)) throw nb::value_error(wrong);
        const size_t pixels = size_t(view.width) * view.height, channels = std::get<5>(splats).shape(1);
        const auto& [pictures, alpha] = outputs;
        if (pictures.size() != pixels * channels || alpha.size() != pixels) throw nb::value_error("pictures");
        alpha_max_ = static_cast<float>(alpha_max);
        background_ = background;
        const splat::Features features = features_of(splats);
        nb::gil_scoped_release release;
        count_ = -1;
        frame_->forward(view, features, in, {pictures.data(), alpha.data()});
        count_ = in.count, channels_ = channels, pixels_ = pixels;
    }

    void backward(const SplatArrays& splats, const std::tuple<Optional<const float>, Optional<const float>>& gradients,
                  const std::tuple<Out, Out, Out, Out, Optional<float>, Optional<float>>& outputs) {
        const splat::ScreenSplats in = splats_of(splats);
        const size_t n = in.count, channels = std::get<5>(splats).shape(1);
        if (in.count != count_ || channels != channels_) throw nb::value_error("not what forward() rendered");
        const auto& [pictures, alpha] = gradients;
        if ((pictures && pictures->size() != pixels_ * channels) || (alpha && alpha->size() != pixels_))
            throw nb::value_error("pictures");
        const auto& [means2d, covariances, opacities, features, slants, magnitudes] = outputs;
        if (bool(slants) != bool(in.slants)) throw nb::value_error("slants");
        const splat::ScreenGradients out = {
            checked(means2d, n, 2, "means2d"),     checked(covariances, n, 3, "covariances"),
            checked(opacities, n, 1, "opacities"), checked(features, n, channels, "features"),
            checked(slants, n, 2, "slants"),       checked(magnitudes, n, 2, "magnitudes")};
        const splat::Features how = features_of(splats);
        const splat::FeaturePictureGradients upstream = {pictures ? pictures->data() : nullptr,
                                                         alpha ? alpha->data() : nullptr};
        nb::gil_scoped_release release;
        frame_->backward(how, in, upstream, out);
    }

  private:
    static splat::ScreenSplats splats_of(const SplatArrays& arrays) {
        const auto& [means2d, depths, covariances, determinants, opacities, features, slants, radii] = arrays;
        const size_t n = rows_of(means2d);
        if (features.ndim() != 2 || features.shape(1) < 1 || features.shape(1) > kMaxChannels)
            throw nb::value_error("features");
        return {static_cast<int64_t>(n),
                checked(means2d, n, 2, "means2d"),
                checked(depths, n, 1, "depths"),
                checked(covariances, n, 3, "covariances"),
                checked(determinants, n, 1, "determinants"),
                checked(opacities, n, 1, "opacities"),
                checked(features, n, features.shape(1), "features"),
                checked(slants, n, 2, "slants"),
                checked(radii, n, 2, "radii")};
    }

    splat::Features features_of(const SplatArrays& arrays) const {
        const In& features = std::get<5>(arrays);
        const int channels = static_cast<int>(features.shape(1));
        if (background_ && background_->size() != features.shape(1)) throw nb::value_error("background");
        return {channels,
                alpha_max_,
                std::log2(alpha_max_),
                background_ ? background_->data() : nullptr,
                features.data(),
                std::get<6>(arrays).has_value()};
    }

    static constexpr size_t kMaxChannels = 1 << 16;

    std::shared_ptr<splat::FeatureFrame> frame_ = splat::borrow_feature_frame();
    Optional<const float> background_;
    float alpha_max_ = 0.0f;
    int64_t count_ = -1;  // splats in the stored render; -1 if there is none
    size_t channels_ = 0, pixels_ = 0;
};

}  // namespace

void bind_features(nb::module_& m) {
    m.def("project_activated", &project, nb::arg("gaussians").noconvert(), nb::arg("camera").noconvert(), "options"_a,
          nb::arg("outputs").noconvert());
    m.def("project_activated_backward", &project_backward, nb::arg("gaussians").noconvert(),
          nb::arg("camera").noconvert(), "options"_a, nb::arg("radii").noconvert(), nb::arg("gradients").noconvert(),
          nb::arg("outputs").noconvert());
    m.def("sh_colours", &sh_colours, nb::arg("means").noconvert(), nb::arg("sh").noconvert(),
          nb::arg("radii").noconvert(), nb::arg("camera").noconvert(), "degree"_a, nb::arg("colours").noconvert());
    m.def("sh_colours_backward", &sh_colours_backward, nb::arg("means").noconvert(), nb::arg("sh").noconvert(),
          nb::arg("radii").noconvert(), nb::arg("camera").noconvert(), "degree"_a, nb::arg("gradients").noconvert(),
          nb::arg("by_means").noconvert(), nb::arg("by_sh").noconvert());
    nb::class_<FeatureFrame>(m, "FeatureFrame")
        .def(nb::init<>())
        .def("forward", &FeatureFrame::forward, nb::arg("splats").noconvert(), "size"_a, "alpha_max"_a,
             nb::arg("background").noconvert().none(), nb::arg("outputs").noconvert())
        .def("backward", &FeatureFrame::backward, nb::arg("splats").noconvert(), nb::arg("gradients").noconvert(),
             nb::arg("outputs").noconvert());
}
