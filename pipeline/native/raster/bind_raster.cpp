// Python bindings of the rasterizer; see _native.pyi.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <limits>
#include <memory>
#include <optional>
#include <tuple>
#include <type_traits>
#include <vector>

#include "raster/features_cpu.h"
#include "raster/raster_cpu.h"
#include "raster/view.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

template <class T, class Shape>
using Array = nb::ndarray<T, Shape, nb::device::cpu, nb::c_contig>;
template <class T>
using Line = Array<T, nb::ndim<1>>;
template <class T>
using Grid = Array<T, nb::ndim<2>>;
template <class T>
using Cube = Array<T, nb::ndim<3>>;
using Pose = Array<const double, nb::shape<4, 4>>;

// means, log_scales, quats, opacity_logits, sh
template <class T>
using ParameterArrays = std::tuple<Grid<T>, Grid<T>, Grid<T>, Line<T>, Cube<T>>;
// cam_from_world; width, height; fx, fy, cx, cy
using CameraTuple = std::tuple<Pose, std::array<int, 2>, std::array<double, 4>>;
// left, top; width and height of the whole image that the camera's window is part of
using WindowArray = std::array<int, 4>;
// sh_degree, antialias, near, depth_origin, background
using OptionsTuple = std::tuple<int, bool, double, double, std::array<double, 3>>;
// depth_sum, depth_square_sum, median_depth
using DepthArrays = std::tuple<Grid<float>, Grid<float>, Grid<float>>;
// colour, alpha; depths; radii, visible
using OutputArrays = std::tuple<Cube<float>, Grid<float>, std::optional<DepthArrays>, Line<float>, Line<uint8_t>>;
// colour, alpha, depth_sum, depth_square_sum
using PictureGradientArrays = std::tuple<std::optional<Cube<const float>>, std::optional<Grid<const float>>,
                                         std::optional<Grid<const float>>, std::optional<Grid<const float>>>;
// for each parameter, the learning rate of each value of a row
using RateArrays = std::array<Line<const float>, 5>;
// centre, unit
using FarTuple = std::array<float, 4>;
// rows that are stepped; the gradients for their centres on the screen
using SeenArrays = std::tuple<Line<int64_t>, Grid<float>>;
// beta1, beta2, epsilon; the step, from 1
using AdamTuple = std::tuple<double, double, double, int64_t>;

template <class T>
T* checked(const Grid<T>& array, size_t rows, size_t columns, const char* name) {
    if (array.shape(0) != rows || array.shape(1) != columns) throw nb::value_error(name);
    return array.data();
}

template <class T>
T* checked(const Line<T>& array, size_t rows, const char* name) {
    if (array.shape(0) != rows) throw nb::value_error(name);
    return array.data();
}

template <class T>
T* checked(const Cube<T>& array, size_t rows, size_t columns, const char* name) {
    if (array.shape(0) != rows || array.shape(1) != columns || array.shape(2) != 3) throw nb::value_error(name);
    return array.data();
}

splat::Parameters parameters_of(const ParameterArrays<const float>& arrays) {
    const auto& [means, log_scales, quats, opacity_logits, sh] = arrays;
    const size_t n = means.shape(0);
    if (n > std::numeric_limits<int32_t>::max()) throw nb::value_error("more Gaussians than 32-bit indices hold");
    return {static_cast<int64_t>(n),
            checked(means, n, 3, "means"),
            checked(log_scales, n, 3, "log_scales"),
            checked(quats, n, 4, "quats"),
            checked(opacity_logits, n, "opacity_logits"),
            checked(sh, n, sh.shape(1), "sh")};
}

splat::View view_of(const CameraTuple& camera, const std::optional<WindowArray>& window, const OptionsTuple& options,
                    size_t sh_count) {
    const auto& [pose, size, intrinsics] = camera;
    const auto& [degree, antialias, near_z, depth_origin, background] = options;
    SplatShot shot{};
    for (int i = 0; i < 12; ++i) shot.cam_from_world[i] = pose(i / 4, i % 4);
    shot.fx = intrinsics[0], shot.fy = intrinsics[1], shot.cx = intrinsics[2], shot.cy = intrinsics[3];
    shot.near_z = near_z, shot.depth_origin = depth_origin;
    for (int c = 0; c < 3; ++c) shot.background[c] = background[c];
    shot.width = size[0], shot.height = size[1];
    const auto [left, top, whole_width, whole_height] = window.value_or(WindowArray{0, 0, size[0], size[1]});
    shot.left = left, shot.top = top, shot.whole_width = whole_width, shot.whole_height = whole_height;
    shot.sh_degree = degree, shot.antialias = antialias;
    shot.sh_count = static_cast<int32_t>(std::min<size_t>(sh_count, splat::kMaxShCount + 1));
    splat::View view{};
    if (const char* wrong = splat::find_view(shot, &view)) throw nb::value_error(wrong);
    return view;
}

splat::AdamRows adam_rows_of(float* values, float* mean, float* square, const Line<const float>& rates, size_t width) {
    return {values, nullptr, mean, square, checked(rates, width, "rates"), static_cast<int>(width)};
}

std::vector<splat::AdamRows> adam_rows(const ParameterArrays<float>& values, const ParameterArrays<float>& means,
                                       const ParameterArrays<float>& squares, const RateArrays& rates, size_t n,
                                       size_t sh_count) {
    const auto grid = [&](auto which, size_t width) {
        constexpr size_t k = decltype(which)::value;
        return adam_rows_of(checked(std::get<k>(values), n, width, "values"),
                            checked(std::get<k>(means), n, width, "means"),
                            checked(std::get<k>(squares), n, width, "squares"), rates[k], width);
    };
    return {grid(std::integral_constant<size_t, 0>{}, 3), grid(std::integral_constant<size_t, 1>{}, 3),
            grid(std::integral_constant<size_t, 2>{}, 4),
            adam_rows_of(checked(std::get<3>(values), n, "values"), checked(std::get<3>(means), n, "means"),
                         checked(std::get<3>(squares), n, "squares"), rates[3], 1),
            adam_rows_of(checked(std::get<4>(values), n, sh_count, "values"),
                         checked(std::get<4>(means), n, sh_count, "means"),
                         checked(std::get<4>(squares), n, sh_count, "squares"), rates[4], 3 * sh_count)};
}

// A render and what its backward pass needs.
class Frame {
  public:
    void forward(const ParameterArrays<const float>& arrays, const CameraTuple& camera, const OptionsTuple& options,
                 const OutputArrays& outputs, const std::optional<WindowArray>& window) {
        const splat::Parameters in = parameters_of(arrays);
        view_ = view_of(camera, window, options, std::get<4>(arrays).shape(1));
        const size_t n = in.count, h = view_.height, w = view_.width;
        const auto& [colour, alpha, depths, radii, visible] = outputs;
        splat::Pictures out{};
        out.colour = checked(colour, h, w, "colour"), out.alpha = checked(alpha, h, w, "alpha");
        if (depths) {
            const auto& [depth_sum, depth_square_sum, median_depth] = *depths;
            out.depth_sum = checked(depth_sum, h, w, "depth_sum");
            out.depth_square_sum = checked(depth_square_sum, h, w, "depth_square_sum");
            out.median_depth = checked(median_depth, h, w, "median_depth");
        }
        float* radii_out = checked(radii, n, "radii");
        uint8_t* visible_out = checked(visible, n, "visible");
        nb::gil_scoped_release release;
        count_ = -1, is_blended_back_ = false;
        frame_->forward(view_, in, out, radii_out, visible_out);
        count_ = in.count;
    }

    void blend_backward(const PictureGradientArrays& gradients, bool magnitudes) {
        require_render();
        const size_t h = view_.height, w = view_.width;
        const auto& [colour, alpha, depth_sum, depth_square_sum] = gradients;
        const splat::PictureGradients pictures = {
            colour ? checked(*colour, h, w, "colour") : nullptr, alpha ? checked(*alpha, h, w, "alpha") : nullptr,
            depth_sum ? checked(*depth_sum, h, w, "depth_sum") : nullptr,
            depth_square_sum ? checked(*depth_square_sum, h, w, "depth_square_sum") : nullptr};
        nb::gil_scoped_release release;
        is_blended_back_ = false;
        frame_->blend_backward(pictures, magnitudes);
        is_blended_back_ = true;
    }

    void project_backward(const ParameterArrays<const float>& arrays, const ParameterArrays<float>& outputs,
                          const Grid<float>& means2d) {
        const splat::Parameters in = rendered(arrays);
        const size_t n = in.count;
        const auto& [means, log_scales, quats, opacity_logits, sh] = outputs;
        const splat::ParameterGradients out = {
            checked(means, n, 3, "means"),        checked(log_scales, n, 3, "log_scales"),
            checked(quats, n, 4, "quats"),        checked(opacity_logits, n, "opacity_logits"),
            checked(sh, n, view_.sh_count, "sh"), checked(means2d, n, 2, "means2d")};
        nb::gil_scoped_release release;
        frame_->project_backward(in, out);
    }

    int64_t step(const ParameterArrays<const float>& arrays, const ParameterArrays<float>& values,
                 const ParameterArrays<float>& means, const ParameterArrays<float>& squares, const RateArrays& rates,
                 const AdamTuple& options, const std::array<float, 2>& limits, const std::optional<FarTuple>& far,
                 const std::optional<Line<const float>>& logit_gain, const std::optional<SeenArrays>& seen) {
        const splat::Parameters in = rendered(arrays);
        const size_t n = std::get<0>(values).shape(0);
        if (n > size_t(in.count)) throw nb::value_error("values");
        splat::FrameStep step{};
        step.count = static_cast<int64_t>(n);
        step.tensors = adam_rows(values, means, squares, rates, n, view_.sh_count);
        const auto [beta1, beta2, epsilon, number] = options;
        step.options = {beta1, beta2, epsilon, number};
        if (!splat::are_adam_options(step.options)) throw nb::value_error("options");
        step.log_scale_min = limits[0], step.log_scale_max = limits[1];
        step.far.unit = std::numeric_limits<float>::infinity();
        if (far) step.far = {{(*far)[0], (*far)[1], (*far)[2]}, (*far)[3]};
        step.logit_gain = logit_gain ? checked(*logit_gain, n, "logit_gain") : nullptr;
        if (seen) {
            const size_t visible = frame_->visible();
            step.seen = checked(std::get<0>(*seen), visible, "rows");
            step.means2d = checked(std::get<1>(*seen), visible, 2, "means2d");
        }
        nb::gil_scoped_release release;
        is_blended_back_ = false;  // the parameters have changed
        return frame_->step(in, step);
    }

    int64_t pairs() const { return frame_->pairs(); }
    int64_t visible() const { return frame_->visible(); }

    int64_t contributing_pairs() const {
        require_render();
        return frame_->contributions();
    }

  private:
    void require_render() const {
        if (count_ < 0) throw nb::value_error("nothing is rendered yet");
    }

    // Results of forward(), and the screen-space gradients of blend_backward().
    splat::Parameters rendered(const ParameterArrays<const float>& arrays) const {
        const splat::Parameters in = parameters_of(arrays);
        if (!is_blended_back_ || in.count != count_ || std::get<4>(arrays).shape(1) != size_t(view_.sh_count))
            throw nb::value_error("not what forward() rendered");
        return in;
    }

    std::shared_ptr<splat::RasterFrame> frame_ = splat::borrow_frame();
    splat::View view_{};
    int64_t count_ = -1;  // Gaussians in the stored render; -1 if there is none
    bool is_blended_back_ = false;
};

}  // namespace

void bind_raster(nb::module_& m) {
    nb::exception<splat::TooManyPairs>(m, "TooManyPairs", PyExc_OverflowError);
    m.def(
        "free_frames",
        [] {
            splat::free_frames();
            splat::free_feature_frames();
        },
        "Gives back the memory that is kept for renders to come.");
    nb::class_<Frame>(m, "Frame")
        .def(nb::init<>())
        .def("forward", &Frame::forward, nb::arg("parameters").noconvert(), nb::arg("camera").noconvert(), "options"_a,
             nb::arg("outputs").noconvert(), "window"_a = nb::none())
        .def("blend_backward", &Frame::blend_backward, nb::arg("gradients").noconvert(), "magnitudes"_a = false)
        .def("project_backward", &Frame::project_backward, nb::arg("parameters").noconvert(),
             nb::arg("outputs").noconvert(), nb::arg("means2d").noconvert())
        .def("step", &Frame::step, nb::arg("parameters").noconvert(), nb::arg("values").noconvert(),
             nb::arg("means").noconvert(), nb::arg("squares").noconvert(), nb::arg("rates").noconvert(), "options"_a,
             "log_scale_limits"_a, "far"_a.none(), nb::arg("logit_gain").noconvert().none(),
             nb::arg("seen").noconvert().none())
        .def_prop_ro("pairs", &Frame::pairs)
        .def_prop_ro("visible", &Frame::visible)
        .def("contributing_pairs", &Frame::contributing_pairs, nb::call_guard<nb::gil_scoped_release>());
}
