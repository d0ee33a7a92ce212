#include "raster/tile_lists.h"

#include <algorithm>
#include <limits>
#include <utility>

namespace splat {
namespace {

constexpr int64_t kSplatsAChunk = 4096;  // in binning, at least: each chunk has one counter per tile
constexpr int64_t kKeysAChunk = 8192;    // in the sort, at least: each chunk has 2048 counters
constexpr int kAhead = 8;                // splats fetched in advance
constexpr int64_t kMaxPairs = std::numeric_limits<int32_t>::max();

}  // namespace

void TileLists::make(const View& view, const ProjectKernels& kernels, FrameData* data) {
    find_tiles(view, kernels, *data);
    sort_by_depth();
    bin(view, *data);
}

// Each splat's spans and slots, and the visible candidates compacted for the sort.
void TileLists::find_tiles(const View& view, const ProjectKernels& kernels, FrameData& data) {
    if (rows_ > kMaxPairs) throw TooManyPairs();
    TaskCounts* tasks = tasks_.data();
    data.spans = spans_.reserve(rows_);
    uint32_t* keys = sort_keys_.reserve(2 * visible_);
    int32_t* order = sort_order_.reserve(2 * visible_);
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        tasks[task].pairs = kernels.find_spans(view, begin, end, data, tasks[task].rows);
        int64_t at = tasks[task].visible;
        for (int64_t i = begin; i < end; ++i)
            if (data.keys[i] != kCulled) keys[at] = data.keys[i], order[at++] = static_cast<int32_t>(i);
    });
    pairs_ = 0;
    for (int64_t task = 0; task < divide_up(candidates_, kCandidatesATask); ++task)
        pairs_ += std::exchange(tasks[task].pairs, pairs_);
    if (pairs_ > kMaxPairs) throw TooManyPairs();
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        for (int64_t i = begin; i < end; ++i) data.touched[i].slots += static_cast<int32_t>(tasks[task].pairs);
    });
    data.touched[candidates_].slots = static_cast<int32_t>(pairs_);
}

// A stable radix sort: of splats at one depth, the one with the lower index is in front. Chunks are counted and placed
// in parallel, each from cursors of its own, so that the order is that of one chunk.
void TileLists::sort_by_depth() {
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
void TileLists::bin(const View& view, FrameData& data) {
    const int tiles = view.tiles_x * view.tiles_y;
    const int chunks = static_cast<int>(std::clamp<int64_t>(visible_ / kSplatsAChunk, 1, 2 * thread_count()));
    int32_t* cursors = cursors_.reserve(int64_t{chunks} * tiles);
    const auto for_tiles = [&](auto&& body) {
        parallel_for(chunks, [&](int64_t chunk) {
            int32_t* at = cursors + chunk * tiles;
            const int64_t end = visible_ * (chunk + 1) / chunks;
            for (int64_t k = visible_ * chunk / chunks; k < end; ++k) {
                if (k + 2 * kAhead < end) __builtin_prefetch(data.touched + order_[k + 2 * kAhead]);
                if (k + kAhead < end) __builtin_prefetch(data.spans + data.touched[order_[k + kAhead]].spans);
                const Touched touched = data.touched[order_[k]];
                const Span* span = data.spans + touched.spans;
                int32_t slot = touched.slots;
                int32_t* row = at + touched.first_row * view.tiles_x;
                for (int r = 0; r < touched.rows; ++r, ++span, row += view.tiles_x)
                    for (int tile = span->first; tile < span->last; ++tile) body(row[tile], order_[k], slot++);
            }
        });
    };
    std::fill(cursors, cursors + int64_t{chunks} * tiles, 0);
    for_tiles([](int32_t& cursor, int32_t, int32_t) { ++cursor; });
    prefix_tiles(chunks, tiles, data);
    int32_t* pair_splat = data.pair_splat = pair_splat_.reserve(pairs_);
    int32_t* pair_slot = data.pair_slot = pair_slot_.reserve(pairs_);
    for_tiles([&](int32_t& cursor, int32_t i, int32_t slot) {
        const int32_t pair = cursor++;
        pair_splat[pair] = i, pair_slot[pair] = slot;
    });
}

// From each chunk's count per tile to the index of its first pair of the tile.
void TileLists::prefix_tiles(int chunks, int tiles, FrameData& data) {
    int64_t* tile_begin = data.tile_begin = tile_begin_.reserve(tiles + 1);
    int32_t* cursors = cursors_.data();
    int32_t sum = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        tile_begin[tile] = sum;
        for (int chunk = 0; chunk < chunks; ++chunk) sum += std::exchange(cursors[int64_t{chunk} * tiles + tile], sum);
    }
    tile_begin[tiles] = sum;
}

}  // namespace splat
