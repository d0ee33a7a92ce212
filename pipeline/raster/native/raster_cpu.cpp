#include "raster_cpu.h"

#include <algorithm>
#include <limits>
#include <mutex>
#include <utility>
#include <vector>

#include "threads.h"

namespace splat {
namespace {

constexpr int64_t kGaussiansATask = 1024;  // of the projection: some 100 µs
constexpr int64_t kSplatsAChunk = 4096;    // of the binning, at least: each chunk has a counter a tile
constexpr int64_t kKeysAChunk = 8192;      // of the sort, at least: each chunk has 2048 counters
constexpr int kAhead = 8;                  // splats fetched in advance
constexpr int64_t kMaxPairs = std::numeric_limits<int32_t>::max();
constexpr std::size_t kKeptFrames = 2;

int64_t divide_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

int tile_count(const View& view) { return view.tiles_x * view.tiles_y; }

// body(task, begin, end) in parallel for Gaussians begin..end-1.
template <class Body>
void for_tasks(int64_t count, const Body& body) {
    parallel_for(divide_up(count, kGaussiansATask), [&](int64_t task) {
        body(task, task * kGaussiansATask, std::min(count, (task + 1) * kGaussiansATask));
    });
}

}  // namespace

void RasterFrame::forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible) {
    view_ = view;
    project_ = &SPLAT_KERNELS(project_kernels), blend_ = &SPLAT_KERNELS(blend_kernels);
    const int tiles = tile_count(view);
    data_.transmittance = transmittance_.reserve(int64_t{tiles} * kTilePixels);
    data_.pixel_end = pixel_end_.reserve(int64_t{tiles} * kTilePixels);
    project(in, radii, visible);
    find_tiles(in.count);
    sort_by_depth();
    bin();
    data_.pair_blocks = pair_blocks_.reserve(pairs_ * blend_->mask_bytes);
    parallel_for(tiles, [&](int64_t tile) { blend_->blend_tile(view_, data_, static_cast<int>(tile), out); });
}

void RasterFrame::backward(const Parameters& in, const PictureGradients& gradients, const ParameterGradients& out) {
    data_.slot_floats = gradients.depth_sum || gradients.depth_square_sum ? kDepthSlotFloats : kSlotFloats;
    data_.slots = slots_.reserve(pairs_ * data_.slot_floats);
    parallel_for(tile_count(view_), [&](int64_t tile) {
        blend_->blend_tile_backward(view_, data_, static_cast<int>(tile), gradients, out.magnitudes);
    });
    for_tasks(in.count, [&](int64_t, int64_t begin, int64_t end) {
        project_->project_backward(view_, in, begin, end, data_, out);
    });
}

int64_t RasterFrame::contributions() const {
    int64_t count = 0;
    for (int tile = 0; tile < tile_count(view_); ++tile) count += blend_->count_contributions(view_, data_, tile);
    return count;
}

void RasterFrame::project(const Parameters& in, float* radii, uint8_t* visible) {
    data_.splats = splats_.reserve(in.count);
    data_.keys = keys_.reserve(in.count);
    data_.touched = touched_.reserve(in.count + 1);
    TaskCounts* tasks = tasks_.reserve(divide_up(in.count, kGaussiansATask));
    for_tasks(in.count, [&](int64_t task, int64_t begin, int64_t end) {
        project_->project(view_, in, begin, end, data_, radii, visible);
        TaskCounts counts{0, 0, 0};
        for (int64_t i = begin; i < end; ++i)
            counts.visible += data_.keys[i] != kCulled, counts.rows += data_.touched[i].rows;
        tasks[task] = counts;
    });
    visible_ = rows_ = 0;
    for (int64_t task = 0; task < divide_up(in.count, kGaussiansATask); ++task) {
        visible_ += std::exchange(tasks[task].visible, visible_);
        rows_ += std::exchange(tasks[task].rows, rows_);
    }
}

// Each splat's spans and slots, and the visible Gaussians in a row for the sort.
void RasterFrame::find_tiles(int64_t count) {
    if (rows_ > kMaxPairs) throw TooManyPairs();
    TaskCounts* tasks = tasks_.data();
    data_.spans = spans_.reserve(rows_);
    uint32_t* keys = sort_keys_.reserve(2 * visible_);
    int32_t* order = sort_order_.reserve(2 * visible_);
    for_tasks(count, [&](int64_t task, int64_t begin, int64_t end) {
        tasks[task].pairs = project_->find_spans(view_, begin, end, data_, tasks[task].rows);
        int64_t at = tasks[task].visible;
        for (int64_t i = begin; i < end; ++i)
            if (data_.keys[i] != kCulled) keys[at] = data_.keys[i], order[at++] = static_cast<int32_t>(i);
    });
    pairs_ = 0;
    for (int64_t task = 0; task < divide_up(count, kGaussiansATask); ++task)
        pairs_ += std::exchange(tasks[task].pairs, pairs_);
    if (pairs_ > kMaxPairs) throw TooManyPairs();
    for_tasks(count, [&](int64_t task, int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) data_.touched[i].slots += static_cast<int32_t>(tasks[task].pairs);
    });
    data_.touched[count].slots = static_cast<int32_t>(pairs_);
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

// Lists of pairs, tile by tile in order of depth: a counting sort by tile of the splats in order of depth, in chunks as
// above.
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

// From each chunk's count a tile to where its first pair of the tile goes.
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

// Never destroyed: a frame may come back while the process ends.
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

}  // namespace splat
