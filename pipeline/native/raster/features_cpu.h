// The driver of the kernels in features.h. Not for kernel files.
#pragma once

#include <cstdint>
#include <memory>

#include "raster/buffer.h"
#include "raster/features.h"
#include "raster/tile_lists.h"

namespace splat {

void project_activated(const View& view, const ProjectOptions& options, const ActivatedGaussians& in,
                       const Projected& out);
void project_activated_backward(const View& view, const ProjectOptions& options, const ActivatedGaussians& in,
                                const int32_t* radii, const ProjectedGradients& gradients,
                                const ActivatedGradients& out);

// Colours (n, 3) of spherical harmonics, and the gradients by means and coefficients.
void sh_colours(const View& view, const ShRows& in, float* out);
void sh_colours_backward(const View& view, const ShRows& in, const float* gradients, float* means, float* sh);

// One view's blended features, with the data for its backward pass.
class FeatureFrame {
  public:
    // Throws TooManyPairs, std::bad_alloc.
    void forward(const View& view, const Features& features, const ScreenSplats& in, const FeaturePictures& out);

    // The features and splats must be those of the forward() call. Can be repeated.
    void backward(const Features& features, const ScreenSplats& in, const FeaturePictureGradients& gradients,
                  const ScreenGradients& out);

  private:
    const FeatureKernels* kernels_ = nullptr;  // of the last forward(), whose layout backward() uses
    const FeatureBlendKernels* blend_ = nullptr;
    View view_{};
    FrameData data_{};
    TileLists lists_;
    Buffer<uint8_t> pair_blocks_;
    Buffer<float> slots_, transmittance_;
    Buffer<int32_t> pixel_end_;
};

// Frames are borrowed and returned; a few are kept with their memory.
std::shared_ptr<FeatureFrame> borrow_feature_frame();

// Frees the memory of the frames kept.
void free_feature_frames();

}  // namespace splat
