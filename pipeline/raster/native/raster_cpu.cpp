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
constexpr int64_t kMaxPairs = std::numeric_limits<int32_t>::max();
constexpr std::size_t kKeptFrames = 2;

int64_t divide_up(int64_t a, int64_t b) { return (a + b - 1) / b; }

int tile_count(const View& view) { return view.tiles_x * view.tiles_y; }

}  // namespace

void RasterFrame::forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible) {
    view_ = view;
    const int tiles = tile_count(view);
    data_.splats = splats_.reserve(in.count);
    data_.keys = keys_.reserve(in.count);
    data_.transmittance = transmittance_.reserve(int64_t{tiles} * kTilePixels);
    data_.pixel_end = pixel_end_.reserve(int64_t{tiles} * kTilePixels);
    const ProjectKernels& project = SPLAT_KERNELS(project_kernels);
    parallel_for(divide_up(in.count, kGaussiansATask), [&](int64_t task) {
        const int64_t begin = task * kGaussiansATask, end = std::min(in.count, begin + kGaussiansATask);
        project.project(view_, in, begin, end, data_, radii, visible);
    });
    sort_by_depth(in.count);
    bin(in.count);
    const BlendKernels& blend = SPLAT_KERNELS(blend_kernels);
    parallel_for(tiles, [&](int64_t tile) { blend.blend_tile(view_, data_, static_cast<int>(tile), out); });
}

void RasterFrame::backward(const Parameters& in, const PictureGradients& gradients, const ParameterGradients& out) {
    data_.slots = slots_.reserve(pairs_ * kSlotFloats);
    const BlendKernels& blend = SPLAT_KERNELS(blend_kernels);
    parallel_for(tile_count(view_),
                 [&](int64_t tile) { blend.blend_tile_backward(view_, data_, static_cast<int>(tile), gradients); });
    const ProjectKernels& project = SPLAT_KERNELS(project_kernels);
    parallel_for(divide_up(in.count, kGaussiansATask), [&](int64_t task) {
        const int64_t begin = task * kGaussiansATask, end = std::min(in.count, begin + kGaussiansATask);
        project.project_backward(view_, in, begin, end, data_, out);
    });
}

// A stable radix sort: of splats at one depth, the one with the lower index is in front.
void RasterFrame::sort_by_depth(int64_t count) {
    constexpr int kBits = 11, kDigits = 3, kBuckets = 1 << kBits;
    uint32_t* keys = sort_keys_.reserve(2 * count);
    int32_t* order = sort_order_.reserve(2 * count);
    std::vector<int64_t> histograms(kDigits * kBuckets);
    int64_t n = 0;
    for (int64_t i = 0; i < count; ++i) {
        const uint32_t key = data_.keys[i];
        if (key == kCulled) continue;
        keys[n] = key, order[n++] = static_cast<int32_t>(i);
        for (int d = 0; d < kDigits; ++d) ++histograms[d * kBuckets + (key >> (d * kBits) & (kBuckets - 1))];
    }
    visible_ = n;
    uint32_t* other_keys = keys + count;
    int32_t* other_order = order + count;
    for (int d = 0; d < kDigits; ++d) {
        int64_t* at = histograms.data() + d * kBuckets;
        int64_t sum = 0;
        for (int b = 0; b < kBuckets; ++b) sum += std::exchange(at[b], sum);
        for (int64_t k = 0; k < n; ++k) {
            const int64_t to = at[keys[k] >> (d * kBits) & (kBuckets - 1)]++;
            other_keys[to] = keys[k], other_order[to] = order[k];
        }
        std::swap(keys, other_keys), std::swap(order, other_order);
    }
    if (order != sort_order_.data()) std::copy(order, order + n, sort_order_.data());
}

// Lists of pairs, tile by tile in order of depth: a counting sort by tile of the splats in order of depth. Chunks of
// splats are counted and placed in parallel; each has its own cursors, so that the order is that of one chunk.
void RasterFrame::bin(int64_t count) {
    const ProjectKernels& kernels = SPLAT_KERNELS(project_kernels);
    const int tiles = tile_count(view_);
    const int32_t* order = sort_order_.data();
    int64_t* row_begin = row_begin_.reserve(visible_ + 1);
    row_begin[0] = 0;
    for (int64_t k = 0; k < visible_; ++k) {
        const Splat& splat = data_.splats[order[k]];
        row_begin[k + 1] = row_begin[k] + std::max(0, splat.last_row - splat.first_row + 1);
    }
    Span* spans = spans_.reserve(row_begin[visible_]);
    int64_t* slot_begin = data_.slot_begin = slot_begin_.reserve(count + 1);
    std::fill(slot_begin, slot_begin + count + 1, 0);
    const int chunks = static_cast<int>(std::clamp<int64_t>(visible_ / kSplatsAChunk, 1, 2 * thread_count()));
    int64_t* cursors = cursors_.reserve(int64_t{chunks} * tiles);
    const auto for_splats = [&](auto&& body) {
        parallel_for(chunks, [&](int64_t chunk) {
            for (int64_t k = visible_ * chunk / chunks; k < visible_ * (chunk + 1) / chunks; ++k)
                body(data_.splats[order[k]], order[k], spans + row_begin[k], cursors + chunk * tiles);
        });
    };
    std::fill(cursors, cursors + int64_t{chunks} * tiles, 0);
    for_splats([&](const Splat& splat, int32_t i, Span* span, int64_t* counts) {
        slot_begin[i + 1] = kernels.find_spans(view_, splat, span);
        for (int row = splat.first_row; row <= splat.last_row; ++row, ++span)
            for (int tile = span->first; tile < span->last; ++tile) ++counts[row * view_.tiles_x + tile];
    });
    for (int64_t i = 0; i < count; ++i) slot_begin[i + 1] += slot_begin[i];
    pairs_ = slot_begin[count];
    if (pairs_ > kMaxPairs) throw TooManyPairs();
    prefix_tiles(chunks, tiles);
    int32_t* pair_splat = data_.pair_splat = pair_splat_.reserve(pairs_);
    int32_t* pair_slot = data_.pair_slot = pair_slot_.reserve(pairs_);
    for_splats([&](const Splat& splat, int32_t i, const Span* span, int64_t* at) {
        int32_t slot = static_cast<int32_t>(slot_begin[i]);
        for (int row = splat.first_row; row <= splat.last_row; ++row, ++span)
            for (int tile = span->first; tile < span->last; ++tile) {
                const int64_t pair = at[row * view_.tiles_x + tile]++;
                pair_splat[pair] = i, pair_slot[pair] = slot++;
            }
    });
}

// From each chunk's count a tile to where its first pair of the tile goes.
void RasterFrame::prefix_tiles(int chunks, int tiles) {
    int64_t* tile_begin = data_.tile_begin = tile_begin_.reserve(tiles + 1);
    int64_t* cursors = cursors_.data();
    int64_t sum = 0;
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
