// From splats to each tile's list of them in order of depth. For drivers; not for kernel files.
#pragma once

#include <algorithm>
#include <cstdint>
#include <stdexcept>
#include <utility>

#include "base/threads.h"
#include "raster/buffer.h"
#include "raster/raster.h"

namespace splat {

// More Gaussian-tile pairs than 32-bit indices allow.
struct TooManyPairs : std::runtime_error {
    TooManyPairs() : std::runtime_error("the Gaussians cover more tiles than 32-bit indices hold") {}
};

inline int64_t divide_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

// body(task, begin, end) in parallel for begin..end-1, at most `size` of them per task.
template <class Body>
void for_tasks(int64_t count, int64_t size, const Body& body) {
    parallel_for(divide_up(count, size),
                 [&](int64_t task) { body(task, task * size, std::min(count, (task + 1) * size)); });
}

constexpr int64_t kCandidatesATask = 1024;  // in the projection: about 100 µs

// The splats of a frame's candidates, and the lists of pairs per tile made from them.
class TileLists {
  public:
    // Room in `data` for the splats, keys and touched rows of the candidates; project(begin, end) writes them, in
    // parallel.
    template <class Project>
    void place(int64_t candidates, FrameData* data, const Project& project) {
        candidates_ = candidates;
        data->splats = splats_.reserve(candidates);
        data->keys = keys_.reserve(candidates);
        data->touched = touched_.reserve(candidates + 1);
        TaskCounts* tasks = tasks_.reserve(divide_up(candidates, kCandidatesATask));
        for_tasks(candidates, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
            project(begin, end);
            TaskCounts counts{0, 0, 0};
            for (int64_t i = begin; i < end; ++i)
                counts.visible += data->keys[i] != kCulled, counts.rows += data->touched[i].rows;
            tasks[task] = counts;
        });
        visible_ = rows_ = 0;
        for (int64_t task = 0; task < divide_up(candidates, kCandidatesATask); ++task) {
            visible_ += std::exchange(tasks[task].visible, visible_);
            rows_ += std::exchange(tasks[task].rows, rows_);
        }
    }

    // The lists of pairs, from what place() placed. Throws TooManyPairs, std::bad_alloc.
    void make(const View& view, const ProjectKernels& kernels, FrameData* data);

    int64_t pairs() const { return pairs_; }
    int64_t visible() const { return visible_; }
    // Of the tasks of place(), before this one.
    int64_t visible_before(int64_t task) const { return tasks_.data()[task].visible; }

  private:
    // Per kCandidatesATask candidates; after the prefix sum, where their shares begin.
    struct TaskCounts {
        int64_t visible, rows, pairs;
    };

    void find_tiles(const View& view, const ProjectKernels& kernels, FrameData& data);
    void sort_by_depth();
    void bin(const View& view, FrameData& data);
    void prefix_tiles(int chunks, int tiles, FrameData& data);

    int64_t candidates_ = 0, visible_ = 0, rows_ = 0, pairs_ = 0;
    const int32_t* order_ = nullptr;  // visible candidates by depth
    Buffer<Splat> splats_;
    Buffer<TaskCounts> tasks_;
    Buffer<Touched> touched_;
    Buffer<Span> spans_;
    Buffer<uint32_t> keys_, sort_keys_;  // two halves, of the visible ones
    Buffer<int32_t> sort_order_;         // two halves
    Buffer<int32_t> cursors_;            // (chunks, tiles), and of the sort's buckets
    Buffer<int64_t> tile_begin_;
    Buffer<int32_t> pair_splat_, pair_slot_;
};

}  // namespace splat
