// The CPU rasterizer's driver: scheduling of the kernels, and ownership of memory. Not for kernel files.
#pragma once

#include <cstdint>
#include <memory>
#include <vector>

#include "adam/adam_step.h"
#include "raster/buffer.h"
#include "raster/raster.h"
#include "raster/tile_lists.h"

namespace splat {

// Positions farther than `unit` from `centre` are stepped farther, as step_lengths.py says.
struct FarSteps {
    float centre[3];
    float unit;  // infinite: none is
};

// The optimizer step fused with the end of a backward pass.
struct FrameStep {
    std::vector<AdamRows> tensors;  // means, log_scales, quats, opacity_logits, sh, without gradients
    int64_t count;                  // rows, those of the rendered Gaussians first: the others are left unchanged
    AdamOptions options;
    float log_scale_min, log_scale_max;  // clamps the stepped rows afterwards
    FarSteps far;                        // lengthens the steps of far rows
    const float* logit_gain;             // (count,): d(rendered logit) / d(stepped logit); null: 1
    int64_t* seen;                       // (visible()): the stepped rows, ascending; null if not needed
    float* means2d;                      // (visible(), 2): their gradients, as in ParameterGradients
};

// A view's rasterization, with the data for its backward pass. One render at a time.
class RasterFrame {
  public:
    // Renders; every pointer in `out` is written. Throws TooManyPairs, std::bad_alloc.
    void forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible);

    // From the images of the last forward() call to screen-space gradients.
    void blend_backward(const PictureGradients& gradients, bool magnitudes);

    // From there to the parameters, which must be those of the forward() call; writes every row. Can be repeated.
    void project_backward(const Parameters& in, const ParameterGradients& out);

    // The same, fused with a step of Adam of the visible rows; nothing else is changed. Returns the number of rows
    // skipped for their gradients.
    int64_t step(const Parameters& in, const FrameStep& step);

    int64_t pairs() const { return lists_.pairs(); }
    int64_t visible() const { return lists_.visible(); }

    // Number of pixel-splat pairs blended in the last forward() call. For benchmarks: slow.
    int64_t contributions() const;

  private:
    void find_candidates(const Parameters& in, float* radii, uint8_t* visible);

    const ProjectKernels* project_ = nullptr;  // of the last forward(), whose layout the other calls use
    const BlendKernels* blend_ = nullptr;
    View view_{};
    FrameData data_{};
    bool magnitudes_ = false;  // of the last blend_backward()
    int64_t candidates_ = 0;
    TileLists lists_;
    Buffer<int64_t> found_counts_;
    Buffer<int32_t> found_rows_, candidate_rows_;
    Buffer<uint8_t> pair_blocks_;
    Buffer<float> slots_, transmittance_;
    Buffer<int32_t> pixel_end_;
};

// Frames are borrowed and returned; a few are kept with their memory.
std::shared_ptr<RasterFrame> borrow_frame();

// Frees the memory of the frames kept.
void free_frames();

}  // namespace splat
