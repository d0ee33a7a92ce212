#include "raster/raster_cpu.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <mutex>
#include <utility>
#include <vector>

#include "adam/adam_tables.h"
#include "base/threads.h"
#include "raster/view.h"

namespace splat {
namespace {

constexpr int64_t kGaussiansATask = 8192;   // in the search for candidates: about 20 µs
constexpr int64_t kCandidatesATask = 1024;  // in the projection: about 100 µs
constexpr int64_t kSplatsAChunk = 4096;     // in binning, at least: each chunk has one counter per tile
constexpr int64_t kKeysAChunk = 8192;       // in the sort, at least: each chunk has 2048 counters
constexpr int kAhead = 8;                   // splats fetched in advance
constexpr int64_t kMaxPairs = std::numeric_limits<int32_t>::max();
constexpr std::size_t kKeptFrames = 2;

int64_t divide_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

int tile_count(const View& view) { return view.tiles_x * view.tiles_y; }

// body(task, begin, end) in parallel for begin..end-1, at most `size` of them per task.
template <class Body>
void for_tasks(int64_t count, int64_t size, const Body& body) {
    parallel_for(divide_up(count, size),
                 [&](int64_t task) { body(task, task * size, std::min(count, (task + 1) * size)); });
}

// The gradients of a few candidates, row by row.
struct BackRows {
    float means[3 * kBackRows], log_scales[3 * kBackRows], quats[4 * kBackRows], opacity_logits[kBackRows];
    float sh[3 * kMaxShCount * kBackRows], means2d[2 * kBackRows];

    ParameterGradients gradients() { return {means, log_scales, quats, opacity_logits, sh, means2d}; }
};

// body(gradients, widths) of each of them and its floats a row.
template <class Body>
void for_gradients(const ParameterGradients& all, int sh_row, const Body& body) {
    body(all.means, 3), body(all.log_scales, 3), body(all.quats, 4), body(all.opacity_logits, 1);
    body(all.sh, sh_row), body(all.means2d, 2);
}

void zero_rows(const ParameterGradients& out, int sh_row, int64_t begin, int64_t end) {
    for_gradients(out, sh_row, [&](float* to, int width) { std::fill(to + begin * width, to + end * width, 0.0f); });
}

void copy_row(const ParameterGradients& from, int64_t from_row, int sh_row, int64_t row, const ParameterGradients& to) {
    const auto copy = [&](float* out, const float* in, int width) {
        std::copy_n(in + from_row * width, width, out + row * width);
    };
    copy(to.means, from.means, 3), copy(to.log_scales, from.log_scales, 3), copy(to.quats, from.quats, 4);
    copy(to.opacity_logits, from.opacity_logits, 1), copy(to.sh, from.sh, sh_row), copy(to.means2d, from.means2d, 2);
}

// Between gradients and their step: applies the gain of the rendered logits, and writes the values for density control
// from index `at` on. Returns the next index.
int64_t end_gradients(const FrameStep& step, const int32_t* rows, int count, int64_t at, BackRows* back) {
    for (int i = 0; i < count; ++i) {
        if (rows[i] < 0) continue;
        if (step.logit_gain) back->opacity_logits[i] *= step.logit_gain[rows[i]];
        if (!step.seen) continue;
        step.seen[at] = rows[i];
        std::copy_n(back->means2d + 2 * i, 2, step.means2d + 2 * at++);
    }
    return at;
}

void hold_scales(const FrameStep& step, const int32_t* rows, int count) {
    float* const values = step.tensors[1].values;
    for (int i = 0; i < count; ++i)
        for (int axis = 0; axis < 3 && rows[i] >= 0; ++axis) {
            float& value = values[3 * int64_t{rows[i]} + axis];  // a NaN stays one
            value = value < step.log_scale_min ? step.log_scale_min : value;
            value = value > step.log_scale_max ? step.log_scale_max : value;
        }
}

// Lengthens the steps of those of some rows that were far from the camera before; the same operations, in the same
// order, as in step_lengths.py.
void lengthen_steps(const FrameStep& step, const int32_t* rows, int count, const float* before) {
    constexpr float kNoDistance = 1e-30f;
    for (int i = 0; i < count; ++i, before += 3) {
        if (rows[i] < 0) continue;
        float ray[3];
        for (int axis = 0; axis < 3; ++axis) ray[axis] = before[axis] - step.far.centre[axis];
        const float distance = std::sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
        if (!(distance > step.far.unit)) continue;
        float* const value = step.tensors[0].values + 3 * int64_t{rows[i]};
        const float factor = distance / step.far.unit;
        float moved[3];
        for (int axis = 0; axis < 3; ++axis) {
            moved[axis] = (value[axis] - before[axis]) * factor;
            ray[axis] /= std::max(distance, kNoDistance);
        }
        const float along = (moved[0] * ray[0] + moved[1] * ray[1] + moved[2] * ray[2]) * (factor - 1.0f);
        for (int axis = 0; axis < 3; ++axis) value[axis] = before[axis] + moved[axis] + along * ray[axis];
    }
}

// Prefetches rows that are stepped soon: a CPU cannot predict where they are.
void fetch_moments(const AdamJob& job, const int32_t* rows, int count) {
    constexpr int kLineFloats = 16;
    for (int t = 0; t < job.tensor_count; ++t) {
        const AdamTensor& tensor = job.tensors[t];
        for (int i = 0; i < count; ++i)
            for (int f = 0; f < tensor.width; f += kLineFloats) {
                __builtin_prefetch(tensor.mean + int64_t{rows[i]} * tensor.width + f, 1);
                __builtin_prefetch(tensor.square + int64_t{rows[i]} * tensor.width + f, 1);
            }
    }
}

}  // namespace

void RasterFrame::forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible) {
    view_ = view;
    project_ = &SPLAT_KERNELS(project_kernels), blend_ = &SPLAT_KERNELS(blend_kernels);
    const int tiles = tile_count(view);
    data_.transmittance = transmittance_.reserve(int64_t{tiles} * kTilePixels);
    data_.pixel_end = pixel_end_.reserve(int64_t{tiles} * kTilePixels);
    find_candidates(in, radii, visible);
    project(in, radii, visible);
    find_tiles();
    sort_by_depth();
    bin();
    data_.pair_blocks = pair_blocks_.reserve(pairs_ * blend_->mask_bytes);
    parallel_for(tiles, [&](int64_t tile) { blend_->blend_tile(view_, data_, static_cast<int>(tile), out); });
}

void RasterFrame::blend_backward(const PictureGradients& gradients, bool magnitudes) {
    magnitudes_ = magnitudes;
    data_.slot_floats = gradients.depth_sum || gradients.depth_square_sum ? kDepthSlotFloats : kSlotFloats;
    data_.slots = slots_.reserve(pairs_ * data_.slot_floats);
    parallel_for(tile_count(view_), [&](int64_t tile) {
        blend_->blend_tile_backward(view_, data_, static_cast<int>(tile), gradients, magnitudes);
    });
}

void RasterFrame::project_backward(const Parameters& in, const ParameterGradients& out) {
    const int sh_row = 3 * view_.sh_count;
    if (candidates_ == 0) zero_rows(out, sh_row, 0, in.count);
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        BackRows back;
        const ParameterGradients made = back.gradients();
        int64_t next = task == 0 ? 0 : data_.rows[begin];  // row to be written
        for (int64_t first = begin; first < end; first += kBackRows) {
            const int64_t last = std::min(end, first + kBackRows);
            project_->project_backward(view_, in, first, last, data_, magnitudes_, made);
            for (int64_t i = first; i < last; ++i) {
                const int64_t row = data_.rows[i];
                zero_rows(out, sh_row, next, row);
                copy_row(made, i - first, sh_row, row, out);
                next = row + 1;
            }
        }
        zero_rows(out, sh_row, next, end == candidates_ ? in.count : data_.rows[end]);
    });
}

int64_t RasterFrame::step(const Parameters& in, const FrameStep& step) {
    const AdamTables adam(step.tensors, step.count, nullptr, step.options);
    const AdamKernels& kernels = SPLAT_KERNELS(adam_kernels);
    std::vector<int64_t> skipped(static_cast<std::size_t>(divide_up(candidates_, kCandidatesATask)));
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        BackRows back;
        const float* gradients[] = {back.means, back.log_scales, back.quats, back.opacity_logits, back.sh};
        int64_t at = tasks_.data()[task].visible;
        for (int64_t first = begin; first < end && data_.rows[first] < step.count; first += kBackRows) {
            int count = static_cast<int>(std::min(end - first, int64_t{kBackRows}));
            while (data_.rows[first + count - 1] >= step.count) --count;
            fetch_moments(adam.job(), data_.rows + first, count);
            project_->project_backward(view_, in, first, first + count, data_, magnitudes_, back.gradients());
            int32_t rows[kBackRows];
            for (int i = 0; i < count; ++i) rows[i] = data_.keys[first + i] == kCulled ? -1 : data_.rows[first + i];
            at = end_gradients(step, rows, count, at, &back);
            float before[3 * kBackRows];
            for (int i = 0; i < count; ++i)
                std::copy_n(step.tensors[0].values + 3 * int64_t{data_.rows[first + i]}, 3, before + 3 * i);
            skipped[static_cast<std::size_t>(task)] += kernels.some(adam.job(), rows, count, gradients);
            lengthen_steps(step, rows, count, before);
            hold_scales(step, rows, count);
        }
    });
    int64_t total = 0;
    for (int64_t part : skipped) total += part;
    return total;
}

int64_t RasterFrame::contributions() const {
    int64_t count = 0;
    for (int tile = 0; tile < tile_count(view_); ++tile) count += blend_->count_contributions(view_, data_, tile);
    return count;
}

// The rows of Gaussians that may be visible, ascending; radii and visible are first cleared for all.
void RasterFrame::find_candidates(const Parameters& in, float* radii, uint8_t* visible) {
    const int64_t tasks = divide_up(in.count, kGaussiansATask);
    int64_t* counts = found_counts_.reserve(tasks);
    int32_t* found = found_rows_.reserve(in.count);
    for_tasks(in.count, kGaussiansATask, [&](int64_t task, int64_t begin, int64_t end) {
        counts[task] = project_->find_candidates(view_, in, begin, end, found + begin);
        std::fill(radii + begin, radii + end, 0.0f), std::fill(visible + begin, visible + end, uint8_t{0});
    });
    candidates_ = 0;
    for (int64_t task = 0; task < tasks; ++task) candidates_ += counts[task];
    int32_t* rows = candidate_rows_.reserve(candidates_);
    data_.rows = rows;
    for (int64_t task = 0; task < tasks; ++task) rows = std::copy_n(found + task * kGaussiansATask, counts[task], rows);
}

void RasterFrame::project(const Parameters& in, float* radii, uint8_t* visible) {
    data_.splats = splats_.reserve(candidates_);
    data_.keys = keys_.reserve(candidates_);
    data_.touched = touched_.reserve(candidates_ + 1);
    TaskCounts* tasks = tasks_.reserve(divide_up(candidates_, kCandidatesATask));
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        project_->project(view_, in, begin, end, data_, radii, visible);
        TaskCounts counts{0, 0, 0};
        for (int64_t i = begin; i < end; ++i)
            counts.visible += data_.keys[i] != kCulled, counts.rows += data_.touched[i].rows;
        tasks[task] = counts;
    });
    visible_ = rows_ = 0;
    for (int64_t task = 0; task < divide_up(candidates_, kCandidatesATask); ++task) {
        visible_ += std::exchange(tasks[task].visible, visible_);
        rows_ += std::exchange(tasks[task].rows, rows_);
    }
}

// Each splat's spans and slots, and the visible candidates compacted for the sort.
void RasterFrame::find_tiles() {
    if (rows_ > kMaxPairs) throw TooManyPairs();
    TaskCounts* tasks = tasks_.data();
    data_.spans = spans_.reserve(rows_);
    uint32_t* keys = sort_keys_.reserve(2 * visible_);
    int32_t* order = sort_order_.reserve(2 * visible_);
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        tasks[task].pairs = project_->find_spans(view_, begin, end, data_, tasks[task].rows);
        int64_t at = tasks[task].visible;
        for (int64_t i = begin; i < end; ++i)
            if (data_.keys[i] != kCulled) keys[at] = data_.keys[i], order[at++] = static_cast<int32_t>(i);
    });
    pairs_ = 0;
    for (int64_t task = 0; task < divide_up(candidates_, kCandidatesATask); ++task)
        pairs_ += std::exchange(tasks[task].pairs, pairs_);
    if (pairs_ > kMaxPairs) throw TooManyPairs();
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) data_.touched[i].slots += static_cast<int32_t>(tasks[task].pairs);
    });
    data_.touched[candidates_].slots = static_cast<int32_t>(pairs_);
}

// A stable radix sort: of splats at one depth, the one with the lower index is in front. Chunks are counted and placed
// in parallel, each from cursors of its own, so that the order is that of one chunk.
void RasterFrame::sort_by_depth() {
    constexpr int kBits = 11, kDigits = 3, kBuckets = 1 << kBits;
    const int chunks = static_cast<int>(std::clamp<int64_t>(visible_ / kKeysAChunk, 1, thread_count()));
    int32_t* cursors = cursors_.reserve(int64_t{chunks} * kBuckets);
    uint32_t *keys = sort_keys_.data(), *other_keys = keys + visible_;
    int32_t *order = sort_order_.data(), *other_order = order + visible_;
    for (int shift = 0; shift < kBits * kDigits; shift += kBits) {
        const auto for_keys = [&](auto&& body) {
            parallel_for(chunks, [&](int64_t chunk) {
                int32_t* at = cursors + chunk * kBuckets;
                for (int64_t k = visible_ * chunk / chunks; k < visible_ * (chunk + 1) / chunks; ++k)
                    body(k, at[keys[k] >> shift & (kBuckets - 1)]);
            });
        };
        std::fill(cursors, cursors + int64_t{chunks} * kBuckets, 0);
        for_keys([](int64_t, int32_t& cursor) { ++cursor; });
        int32_t sum = 0;
        for (int bucket = 0; bucket < kBuckets; ++bucket)
            for (int chunk = 0; chunk < chunks; ++chunk)
                sum += std::exchange(cursors[int64_t{chunk} * kBuckets + bucket], sum);
        for_keys([&](int64_t k, int32_t& cursor) {
            const int32_t to = cursor++;
            other_keys[to] = keys[k], other_order[to] = order[k];
        });
        std::swap(keys, other_keys), std::swap(order, other_order);
    }
    order_ = order;
}

// Lists of pairs per tile in order of depth: a counting sort by tile of the depth-ordered splats, in chunks as above.
void RasterFrame::bin() {
    const int tiles = tile_count(view_);
    const int chunks = static_cast<int>(std::clamp<int64_t>(visible_ / kSplatsAChunk, 1, 2 * thread_count()));
    int32_t* cursors = cursors_.reserve(int64_t{chunks} * tiles);
    const auto for_tiles = [&](auto&& body) {
        parallel_for(chunks, [&](int64_t chunk) {
            int32_t* at = cursors + chunk * tiles;
            const int64_t end = visible_ * (chunk + 1) / chunks;
            for (int64_t k = visible_ * chunk / chunks; k < end; ++k) {
                if (k + 2 * kAhead < end) __builtin_prefetch(data_.touched + order_[k + 2 * kAhead]);
                if (k + kAhead < end) __builtin_prefetch(data_.spans + data_.touched[order_[k + kAhead]].spans);
                const Touched touched = data_.touched[order_[k]];
                const Span* span = data_.spans + touched.spans;
                int32_t slot = touched.slots;
                int32_t* row = at + touched.first_row * view_.tiles_x;
                for (int r = 0; r < touched.rows; ++r, ++span, row += view_.tiles_x)
                    for (int tile = span->first; tile < span->last; ++tile) body(row[tile], order_[k], slot++);
            }
        });
    };
    std::fill(cursors, cursors + int64_t{chunks} * tiles, 0);
    for_tiles([](int32_t& cursor, int32_t, int32_t) { ++cursor; });
    prefix_tiles(chunks, tiles);
    int32_t* pair_splat = data_.pair_splat = pair_splat_.reserve(pairs_);
    int32_t* pair_slot = data_.pair_slot = pair_slot_.reserve(pairs_);
    for_tiles([&](int32_t& cursor, int32_t i, int32_t slot) {
        const int32_t pair = cursor++;
        pair_splat[pair] = i, pair_slot[pair] = slot;
    });
}

// From each chunk's count per tile to the index of its first pair of the tile.
void RasterFrame::prefix_tiles(int chunks, int tiles) {
    int64_t* tile_begin = data_.tile_begin = tile_begin_.reserve(tiles + 1);
    int32_t* cursors = cursors_.data();
    int32_t sum = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        tile_begin[tile] = sum;
        for (int chunk = 0; chunk < chunks; ++chunk) sum += std::exchange(cursors[int64_t{chunk} * tiles + tile], sum);
    }
    tile_begin[tiles] = sum;
}

namespace {

// Never destroyed: a frame may be returned while the process ends.
std::mutex& shelf_mutex = *new std::mutex;
std::vector<std::unique_ptr<RasterFrame>>& shelf = *new std::vector<std::unique_ptr<RasterFrame>>;

void take_back(RasterFrame* frame) {
    std::unique_ptr<RasterFrame> owned(frame);
    std::lock_guard<std::mutex> lock(shelf_mutex);
    if (shelf.size() < kKeptFrames) shelf.push_back(std::move(owned));
}

}  // namespace

std::shared_ptr<RasterFrame> borrow_frame() {
    std::unique_ptr<RasterFrame> frame;
    {
        std::lock_guard<std::mutex> lock(shelf_mutex);
        shelf.reserve(kKeptFrames);
        if (!shelf.empty()) {
            frame = std::move(shelf.back());
            shelf.pop_back();
        }
    }
    if (!frame) frame = std::make_unique<RasterFrame>();
    return std::shared_ptr<RasterFrame>(frame.release(), take_back);
}

void free_frames() {
    std::lock_guard<std::mutex> lock(shelf_mutex);
    shelf.clear();
}

}  // namespace splat
