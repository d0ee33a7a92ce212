// The CPU rasterizer's driver: scheduling of the kernels, and ownership of memory. Not for kernel files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <new>
#include <stdexcept>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#include "adam/adam_step.h"
#include "raster/raster.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#endif

namespace splat {

// More Gaussian-tile pairs than 32-bit indices allow.
struct TooManyPairs : std::runtime_error {
    TooManyPairs() : std::runtime_error("the Gaussians cover more tiles than 32-bit indices hold") {}
};

// Uninitialized memory that only grows, so that a training loop does not fault in fresh pages at every iteration.
template <class T>
class Buffer {
  public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { std::free(data_); }

    // Room for at least `count` elements; the content is lost if it grows. Throws std::bad_alloc.
    T* reserve(int64_t count) {
        if (count > capacity_) grow(count);
#if defined(__SANITIZE_ADDRESS__)  // to detect accesses beyond the requested size too
        ASAN_UNPOISON_MEMORY_REGION(data_, static_cast<std::size_t>(count) * sizeof(T));
        ASAN_POISON_MEMORY_REGION(data_ + count, static_cast<std::size_t>(capacity_ - count) * sizeof(T));
#endif
        return data_;
    }
    T* data() const { return data_; }

  private:
    static constexpr std::size_t kLine = 64, kHugePage = 2 << 20;  // bytes

    void grow(int64_t count) {
        std::free(data_);
        data_ = nullptr, capacity_ = 0;
        const int64_t wanted = count + count / 4;  // densification grows a scene step by step
        const std::size_t bytes = static_cast<std::size_t>(wanted) * sizeof(T);
        const std::size_t unit = bytes < kHugePage ? kLine : kHugePage, size = (bytes + unit - 1) / unit * unit;
        data_ = static_cast<T*>(std::aligned_alloc(unit, size));
        if (!data_) throw std::bad_alloc();
#if defined(__linux__)  // splats and slots are accessed in random order: with 4 KiB pages most accesses would miss the
                        // TLB
        if (unit == kHugePage) madvise(data_, size, MADV_HUGEPAGE);
#endif
        capacity_ = static_cast<int64_t>(size / sizeof(T));
    }

    T* data_ = nullptr;
    int64_t capacity_ = 0;
};

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

    int64_t pairs() const { return pairs_; }
    int64_t visible() const { return visible_; }

    // Number of pixel-splat pairs blended in the last forward() call. For benchmarks: slow.
    int64_t contributions() const;

  private:
    // Per kCandidatesATask candidates; after the prefix sum, where their shares begin.
    struct TaskCounts {
        int64_t visible, rows, pairs;
    };

    void find_candidates(const Parameters& in, float* radii, uint8_t* visible);
    void project(const Parameters& in, float* radii, uint8_t* visible);
    void find_tiles();
    void sort_by_depth();
    void bin();
    void prefix_tiles(int chunks, int tiles);

    const ProjectKernels* project_ = nullptr;  // of the last forward(), whose layout the other calls use
    const BlendKernels* blend_ = nullptr;
    View view_{};
    FrameData data_{};
    bool magnitudes_ = false;  // of the last blend_backward()
    int64_t candidates_ = 0, visible_ = 0, rows_ = 0, pairs_ = 0;
    const int32_t* order_ = nullptr;  // visible candidates by depth
    Buffer<int64_t> found_counts_;
    Buffer<int32_t> found_rows_, candidate_rows_;
    Buffer<Splat> splats_;
    Buffer<TaskCounts> tasks_;
    Buffer<Touched> touched_;
    Buffer<Span> spans_;
    Buffer<uint32_t> keys_, sort_keys_;  // two halves, of the visible ones
    Buffer<int32_t> sort_order_;         // two halves
    Buffer<int32_t> cursors_;            // (chunks, tiles), and of the sort's buckets
    Buffer<int64_t> tile_begin_;
    Buffer<int32_t> pair_splat_, pair_slot_;
    Buffer<uint8_t> pair_blocks_;
    Buffer<float> slots_, transmittance_;
    Buffer<int32_t> pixel_end_;
};

// Frames are borrowed and returned; a few are kept with their memory.
std::shared_ptr<RasterFrame> borrow_frame();

// Frees the memory of the frames kept.
void free_frames();

}  // namespace splat
