// Memory of a frame, for drivers. Not for kernel files.
#pragma once

#include <cstddef>
#include <cstdint>
#include <cstdlib>
#include <memory>
#include <mutex>
#include <new>
#include <utility>
#include <vector>

#if defined(__linux__)
#include <sys/mman.h>
#endif

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/asan_interface.h>
#endif

namespace splat {

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

// Frames that are borrowed and returned; a few are kept with their memory.
template <class Frame>
class Shelf {
  public:
    std::shared_ptr<Frame> borrow() {
        std::unique_ptr<Frame> frame;
        {
            std::lock_guard<std::mutex> lock(mutex_);
            kept_.reserve(kKept);
            if (!kept_.empty()) {
                frame = std::move(kept_.back());
                kept_.pop_back();
            }
        }
        if (!frame) frame = std::make_unique<Frame>();
        return std::shared_ptr<Frame>(frame.release(), [this](Frame* back) { take_back(back); });
    }

    // Frees the memory of the frames kept.
    void clear() {
        std::lock_guard<std::mutex> lock(mutex_);
        kept_.clear();
    }

  private:
    static constexpr std::size_t kKept = 2;

    void take_back(Frame* frame) {
        std::unique_ptr<Frame> owned(frame);
        std::lock_guard<std::mutex> lock(mutex_);
        if (kept_.size() < kKept) kept_.push_back(std::move(owned));
    }

    std::mutex mutex_;
    std::vector<std::unique_ptr<Frame>> kept_;
};

}  // namespace splat
