#include "raster/features_cpu.h"

#include "base/threads.h"

namespace splat {
namespace {

constexpr int64_t kRowsATask = 1024;

// Memory of one task.
class Scratch {
  public:
    explicit Scratch(int channels) { buffer_.reserve(feature_scratch_floats(channels)); }
    float* data() const { return buffer_.data(); }

  private:
    Buffer<float> buffer_;
};

}  // namespace

void project_activated(const View& view, const ProjectOptions& options, const ActivatedGaussians& in,
                       const Projected& out) {
    const FeatureKernels& kernels = SPLAT_KERNELS(feature_kernels);
    for_tasks(in.count, kRowsATask,
              [&](int64_t, int64_t begin, int64_t end) { kernels.project(view, options, in, begin, end, out); });
}

void project_activated_backward(const View& view, const ProjectOptions& options, const ActivatedGaussians& in,
                                const int32_t* radii, const ProjectedGradients& gradients,
                                const ActivatedGradients& out) {
    const FeatureKernels& kernels = SPLAT_KERNELS(feature_kernels);
    for_tasks(in.count, kRowsATask, [&](int64_t, int64_t begin, int64_t end) {
        kernels.project_backward(view, options, in, begin, end, radii, gradients, out);
    });
}

void sh_colours(const View& view, const ShRows& in, float* out) {
    const FeatureKernels& kernels = SPLAT_KERNELS(feature_kernels);
    for_tasks(in.count, kRowsATask,
              [&](int64_t, int64_t begin, int64_t end) { kernels.colours(view, in, begin, end, out); });
}

void sh_colours_backward(const View& view, const ShRows& in, const float* gradients, float* means, float* sh) {
    const FeatureKernels& kernels = SPLAT_KERNELS(feature_kernels);
    for_tasks(in.count, kRowsATask, [&](int64_t, int64_t begin, int64_t end) {
        kernels.colours_backward(view, in, begin, end, gradients, means, sh);
    });
}

void FeatureFrame::forward(const View& view, const Features& features, const ScreenSplats& in,
                           const FeaturePictures& out) {
    view_ = view;
    kernels_ = &SPLAT_KERNELS(feature_kernels), blend_ = &SPLAT_KERNELS(feature_blend_kernels);
    const int tiles = view.tiles_x * view.tiles_y;
    data_.transmittance = transmittance_.reserve(int64_t{tiles} * kTilePixels);
    data_.pixel_end = pixel_end_.reserve(int64_t{tiles} * kTilePixels);
    lists_.place(in.count, &data_,
                 [&](int64_t begin, int64_t end) { kernels_->place(view_, features, in, begin, end, data_); });
    lists_.make(view_, SPLAT_KERNELS(project_kernels), &data_);
    data_.pair_blocks = pair_blocks_.reserve(lists_.pairs() * blend_->mask_bytes);
    parallel_for(tiles, [&](int64_t tile) {
        const Scratch scratch(features.channels);
        blend_->blend_tile(view_, data_, features, static_cast<int>(tile), out, scratch.data());
    });
}

void FeatureFrame::backward(const Features& features, const ScreenSplats& in, const FeaturePictureGradients& gradients,
                            const ScreenGradients& out) {
    data_.slot_floats = feature_slot_floats(features.channels, features.slanted);
    data_.slots = slots_.reserve(lists_.pairs() * data_.slot_floats);
    const bool magnitudes = out.magnitudes;
    parallel_for(view_.tiles_x * view_.tiles_y, [&](int64_t tile) {
        const Scratch scratch(features.channels);
        blend_->blend_tile_backward(view_, data_, features, static_cast<int>(tile), gradients, magnitudes,
                                    scratch.data());
    });
    for_tasks(in.count, kRowsATask,
              [&](int64_t, int64_t begin, int64_t end) { kernels_->finish(features, in, begin, end, data_, out); });
}

namespace {

Shelf<FeatureFrame>& shelf =
    *new Shelf<FeatureFrame>;  // never destroyed: a frame may be returned while the process ends

}  // namespace

std::shared_ptr<FeatureFrame> borrow_feature_frame() { return shelf.borrow(); }

void free_feature_frames() { shelf.clear(); }

}  // namespace splat
