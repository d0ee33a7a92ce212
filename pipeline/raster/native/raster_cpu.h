// The CPU rasterizer's driver: who computes what when, and who owns the memory. Not for kernel files.
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

#include "adam_step.h"
#include "raster.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#endif

namespace splat {

// More pixel-tile pairs than 32-bit indices hold.
struct TooManyPairs : std::runtime_error {
    TooManyPairs() : std::runtime_error("the Gaussians cover more tiles than 32-bit indices hold") {}
};

// Uninitialised memory that only grows, so that a training loop does not fault in fresh pages at every iteration.
template <class T>
class Buffer {
  public:
    Buffer() = default;
    Buffer(const Buffer&) = delete;
    Buffer& operator=(const Buffer&) = delete;
    ~Buffer() { std::free(data_); }

    // At least `count` elements; what was in it is lost where it grows. Throws std::bad_alloc.
    T* reserve(int64_t count) {
        if (count > capacity_) grow(count);
#if defined(__SANITIZE_ADDRESS__)  // sees a step beyond what was asked for, too
        ASAN_UNPOISON_MEMORY_REGION(data_, static_cast<std::size_t>(count) * sizeof(T));
        ASAN_POISON_MEMORY_REGION(data_ + count, static_cast<std::size_t>(capacity_ - count) * sizeof(T));
#endif
        return data_;
    }
    T* data() const { return data_; }

  private:
    static constexpr std::size_t kLine = 64, kHugePage = 2 << 20;  // bytes, of the cache and of memory

    void grow(int64_t count) {
        std::free(data_);
        data_ = nullptr, capacity_ = 0;
        const int64_t wanted = count + count / 4;  // densification grows a scene step by step
        const std::size_t bytes = static_cast<std::size_t>(wanted) * sizeof(T);
        const std::size_t unit = bytes < kHugePage ? kLine : kHugePage, size = (bytes + unit - 1) / unit * unit;
        data_ = static_cast<T*>(std::aligned_alloc(unit, size));
        if (!data_) throw std::bad_alloc();
#if defined(__linux__)  // splats and slots are visited in all orders: with pages of 4 KiB the CPU looks up most of them
        if (unit == kHugePage) madvise(data_, size, MADV_HUGEPAGE);
#endif
        capacity_ = static_cast<int64_t>(size / sizeof(T));
    }

    T* data_ = nullptr;
    int64_t capacity_ = 0;
};

// The step of the optimiser that a backward pass ends with.
struct FrameStep {
    std::vector<AdamRows> tensors;  // means, log_scales, quats, opacity_logits, sh, without gradients
    int64_t count;                  // of their rows, the rendered Gaussians' first: the others are left as they are
    AdamOptions options;
    float log_scale_min, log_scale_max;  // of the rows that take part, afterwards
    const float* logit_gain;             // (count,): of the rendered logits by those that are stepped; null: the same
    int64_t* seen;                       // (visible()): the rows that take part, ascending; null: not wanted
    float* means2d;                      // (visible(), 2): theirs, as of ParameterGradients
};

// A view's rasterization, with what its backward pass needs. One render at a time.
class RasterFrame {
  public:
    // Renders; every pointer in `out` is written. Throws TooManyPairs, std::bad_alloc.
    void forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible);

    // From the pictures of the last forward() call to the screen.
    void blend_backward(const PictureGradients& gradients, bool magnitudes);

    // From there to the parameters, which must be those of the forward() call: every row is written. Can be repeated.
    void project_backward(const Parameters& in, const ParameterGradients& out);

    // The same, and at once a step of Adam of the visible rows; nothing else is touched. Returns how many were left out
    // for their gradients.
    int64_t step(const Parameters& in, const FrameStep& step);

    int64_t pairs() const { return pairs_; }
    int64_t visible() const { return visible_; }

    // Pairs of a pixel and a splat blended into it, of the last forward() call. For benchmarks: slow.
    int64_t contributions() const;

  private:
    // Of kCandidatesATask candidates; where their shares begin once they have been summed.
    struct TaskCounts {
        int64_t visible, rows, pairs;
    };

    void find_candidates(const Parameters& in, float* radii, uint8_t* visible);
    void project(const Parameters& in, float* radii, uint8_t* visible);
    void find_tiles();
    void sort_by_depth();
    void bin();
    void prefix_tiles(int chunks, int tiles);

    const ProjectKernels* project_ = nullptr;  // of the last forward(), which lays out what the others read
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

// Frames are handed out and taken back, a few of them kept with their memory.
std::shared_ptr<RasterFrame> borrow_frame();

// Gives back the memory of those that are kept.
void free_frames();

}  // namespace splat
