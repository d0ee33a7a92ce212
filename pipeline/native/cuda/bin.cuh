// Binning splats into tiles: the chunk plan of the view, and a chunk's pairs in order of depth.
#pragma once

#include "cuda/frame.h"
#include "cuda/grid.cuh"
#include "cuda/project.cuh"
#include "cuda/scan.cuh"
#include "cuda/sort.cuh"

namespace splat {
namespace cuda {

// Maximum that a thread counts or writes by itself; a splat with more is processed by the whole warp.
constexpr int kOwnRows = 4;
constexpr uint32_t kOwnPairs = 16;

constexpr int kTilePasses = 16 / kDigitBits;
static_assert(kTilePasses % 2 == 0, "what is sorted ends where it began");

// End of the chunk that starts at tile `first`: as many tiles as its pairs allow. No single tile has more than
// `capacity` pairs, which is at least the number of Gaussians.
__device__ inline int chunk_end(const Job& job, int first) {
    const int64_t* pairs = job.at.tile_begin;
    const int64_t limit = pairs[first] + job.capacity;
    int end = job.tiles - first < kChunkTiles ? job.tiles : first + static_cast<int>(kChunkTiles);
    if (pairs[end] <= limit) return end;
    int fits = first + 1;  // and `end` does not
    while (end - fits > 1) {
        const int middle = fits + (end - fits) / 2;
        if (pairs[middle] <= limit)
            fits = middle;
        else
            end = middle;
    }
    return fits;
}

__device__ inline void plan_chunks(const Job& job) {
    int64_t chunks = 0;
    for (int tile = 0; tile < job.tiles; tile = chunk_end(job, tile)) job.at.chunk_begin[chunks++] = tile;
    job.at.chunk_begin[chunks] = job.tiles;
    Header* header = job.at.header;
    header->facts.pairs = job.at.tile_begin[job.tiles];
    header->facts.visible = header->visible;
    header->facts.chunks = chunks;
}

struct PlanShared {
    ScanShared<int32_t> counts;
    ScanShared<int64_t> pairs;
};

// From differences to each tile's number of pairs, to their offsets, to chunks; by one block.
__device__ inline void plan_phase(const Job& job) {
    SPLAT_SHARED(PlanShared, shared);
    int32_t carried_count = 0;
    int64_t carried_pairs = 0;
    for (int first = 0; first < job.tiles; first += kThreads * kScanItems) {
        const int begin = first + static_cast<int>(threadIdx.x) * kScanItems;
        int32_t counts[kScanItems], sum = 0, change;
        SPLAT_UNROLL
        for (int i = 0; i < kScanItems; ++i) {
            if (begin + i < job.tiles) sum += job.at.tile_counts[begin + i];
            counts[i] = sum;
        }
        const int32_t before = carried_count + block_exclusive(sum, &shared.counts, &change);
        int64_t pairs = 0, all;
        SPLAT_UNROLL
        for (int i = 0; i < kScanItems; ++i)
            if (begin + i < job.tiles) pairs += counts[i] += before;
        int64_t at = carried_pairs + block_exclusive(pairs, &shared.pairs, &all);
        SPLAT_UNROLL
        for (int i = 0; i < kScanItems; ++i) {
            if (begin + i >= job.tiles) continue;
            job.at.tile_counts[begin + i] = counts[i];
            job.at.tile_begin[begin + i] = at;
            at += counts[i];
        }
        carried_count += change, carried_pairs += all;
    }
    if (threadIdx.x == 0) job.at.tile_begin[job.tiles] = carried_pairs;
    __syncthreads();
    if (threadIdx.x == 0) plan_chunks(job);
}

// Tiles begin..end-1 of the view.
struct TileRun {
    int begin, end;
};

__device__ inline TileRun tiles_of(const Job& job, int chunk) {
    return {job.at.chunk_begin[chunk], job.at.chunk_begin[chunk + 1]};
}

// A Gaussian, and its tile rows within a chunk.
struct RowRun {
    int gaussian, first, count;
};

__device__ inline RowRun rows_of(const Job& job, int64_t rank, const TileRun& tiles) {
    if (rank >= job.at.header->visible) return {0, 0, 0};
    const int gaussian = job.at.order[0][rank];
    const uint32_t packed = job.at.rows[gaussian];
    const int top = static_cast<int>(packed >> 16), bottom = top + static_cast<int>(packed & 0xffff);
    const int first = max(top, tiles.begin / job.view.tiles_x);
    const int end = min(bottom, (tiles.end - 1) / job.view.tiles_x + 1);
    return {gaussian, first, max(end - first, 0)};
}

// The tiles of the chunk that a splat touches in a tile row; begin == end for none.
__device__ inline TileRun touched(const View& view, const Splat& splat, int row, const TileRun& tiles) {
    const Span span = lane::find_span(view, splat, row, lane::half_height(splat));
    const int left = row * view.tiles_x;
    const int begin = max(left + span.first, tiles.begin), end = min(left + span.last, tiles.end);
    return {begin, max(begin, end)};
}

// Over every `step`th row, starting at `first`.
__device__ inline uint32_t count_rows(const Job& job, const RowRun& rows, int first, int step, const TileRun& tiles) {
    if (first >= rows.count) return 0;
    const Splat splat = expand(job.at.records[rows.gaussian]);
    uint32_t count = 0;
    for (int row = first; row < rows.count; row += step) {
        const TileRun run = touched(job.view, splat, rows.first + row, tiles);
        count += static_cast<uint32_t>(run.end - run.begin);
    }
    return count;
}

__device__ inline RowRun rows_of_lane(const RowRun& rows, int lane) {
    return {__shfl_sync(kWholeWarp, rows.gaussian, lane), __shfl_sync(kWholeWarp, rows.first, lane),
            __shfl_sync(kWholeWarp, rows.count, lane)};
}

// Number of pairs per rank in the chunk, prefix-summed within each virtual block.
__device__ inline void count_pairs(const Job& job, int chunk) {
    SPLAT_SHARED(ScanShared<uint32_t>, shared);
    const TileRun tiles = tiles_of(job, chunk);
    const int64_t visible = job.at.header->visible;
    for (int64_t block = blockIdx.x; block * kScanBlock < visible; block += gridDim.x) {
        const int64_t rank = block * kScanBlock + threadIdx.x;
        const RowRun rows = rows_of(job, rank, tiles);
        const bool is_large = rows.count > kOwnRows;
        uint32_t count = is_large ? 0 : count_rows(job, rows, 0, 1, tiles), total;
        for (unsigned large = __ballot_sync(kWholeWarp, is_large); large; large &= large - 1) {
            const int lane = __ffs(static_cast<int>(large)) - 1;
            const uint32_t share = count_rows(job, rows_of_lane(rows, lane), lane_index(), kWarp, tiles);
            const uint32_t sum = __shfl_sync(kWholeWarp, warp_inclusive(share), kWarp - 1);
            if (lane_index() == lane) count = sum;
        }
        const uint32_t before = block_exclusive(count, &shared, &total);
        if (rank < visible) job.at.offsets[rank] = before;
        if (threadIdx.x == 0) job.at.block_sums[block] = total;
    }
}

// From the blocks' sums to their offsets; by one block.
__device__ inline void scan_pairs(const Job& job) {
    SPLAT_SHARED(ScanShared<uint32_t>, shared);
    const int64_t blocks = (job.at.header->visible + kScanBlock - 1) / kScanBlock;
    const uint32_t pairs = scan_array(job.at.block_sums, blocks, &shared);
    if (threadIdx.x != 0) return;
    job.at.block_sums[blocks] = pairs;
    job.at.header->chunk_pairs = pairs;
    job.at.header->sorted = static_cast<int32_t>(pairs);
}

__device__ inline void put_pair(const Job& job, uint32_t slot, int tile, int gaussian, const TileRun& tiles) {
    job.at.pair_keys[0][slot] = static_cast<uint16_t>(tile - tiles.begin);
    job.at.owners[slot] = static_cast<uint32_t>(gaussian);
}

// A splat's pairs from `slot` on, by one thread.
__device__ inline void emit_rows(const Job& job, const RowRun& rows, uint32_t slot, const TileRun& tiles) {
    const Splat splat = expand(job.at.records[rows.gaussian]);
    for (int row = rows.first; row < rows.first + rows.count; ++row) {
        const TileRun run = touched(job.view, splat, row, tiles);
        for (int tile = run.begin; tile < run.end; ++tile) put_pair(job, slot++, tile, rows.gaussian, tiles);
    }
}

// The first lane whose running sum is more than `at`.
__device__ inline int lane_at(uint32_t running, uint32_t at) {
    int lane = 0;
    for (int step = kWarp / 2; step > 0; step /= 2)
        if (__shfl_sync(kWholeWarp, running, lane + step - 1) <= at) lane += step;
    return lane;
}

// The same by a warp: a lane finds the tiles of a row, and then the lanes write neighbouring pairs.
__device__ inline void emit_rows_by_warp(const Job& job, const RowRun& rows, uint32_t slot, const TileRun& tiles) {
    const Splat splat = expand(job.at.records[rows.gaussian]);
    for (int first = 0; first < rows.count; first += kWarp) {
        const int row = first + lane_index();
        TileRun run = {0, 0};
        if (row < rows.count) run = touched(job.view, splat, rows.first + row, tiles);
        const uint32_t running = warp_inclusive(static_cast<uint32_t>(run.end - run.begin));
        const uint32_t pairs = __shfl_sync(kWholeWarp, running, kWarp - 1);
        for (uint32_t begin = 0; begin < pairs; begin += kWarp) {
            const uint32_t pair = begin + static_cast<uint32_t>(lane_index());
            const int lane = lane_at(running, pair);
            const uint32_t behind = __shfl_sync(kWholeWarp, running, lane);
            const int end = __shfl_sync(kWholeWarp, run.end, lane);
            if (pair < pairs) put_pair(job, slot + pair, end - static_cast<int>(behind - pair), rows.gaussian, tiles);
        }
        slot += pairs;
    }
}

struct EmitShared {
    uint32_t begin[kScanBlock + 1];
};

// The pairs in order of depth, a Gaussian's in order of its tiles; offsets become those in the chunk.
__device__ inline void emit_pairs(const Job& job, int chunk) {
    SPLAT_SHARED(EmitShared, shared);
    const TileRun tiles = tiles_of(job, chunk);
    const int64_t visible = job.at.header->visible;
    for (int64_t block = blockIdx.x; block * kScanBlock < visible; block += gridDim.x) {
        const int64_t rank = block * kScanBlock + threadIdx.x;
        const uint32_t end_of_block = job.at.block_sums[block + 1];
        const uint32_t begin = rank < visible ? job.at.block_sums[block] + job.at.offsets[rank] : end_of_block;
        shared.begin[threadIdx.x] = begin;
        if (threadIdx.x == 0) shared.begin[kScanBlock] = end_of_block;
        __syncthreads();
        const uint32_t count = shared.begin[threadIdx.x + 1] - begin;
        if (rank < visible) job.at.offsets[rank] = begin;
        const RowRun rows = rows_of(job, rank, tiles);
        const bool is_large = rows.count > kOwnRows || count > kOwnPairs;
        if (count && !is_large) emit_rows(job, rows, begin, tiles);
        for (unsigned large = __ballot_sync(kWholeWarp, count && is_large); large; large &= large - 1) {
            const int lane = __ffs(static_cast<int>(large)) - 1;
            const uint32_t slot = __shfl_sync(kWholeWarp, begin, lane);
            emit_rows_by_warp(job, rows_of_lane(rows, lane), slot, tiles);
        }
        __syncthreads();
    }
}

using TilePass = SortPass<uint16_t, uint32_t>;

// A pass of the sort by tile, from one half of the memory to the other or back; the first takes places for values. (Not
// by an index: for that, a kernel would copy its argument.)
__host__ __device__ inline TilePass tile_pass(const FrameMemory& at, int pass) {
    const bool odd = pass % 2;
    uint16_t *keys = at.pair_keys[0], *other_keys = at.pair_keys[1];
    uint32_t *values = at.pair_values[0], *other_values = at.pair_values[1];
    return {odd ? other_keys : keys,
            odd ? keys : other_keys,
            odd ? other_values : (pass ? values : nullptr),
            odd ? values : other_values,
            0,
            &at.header->sorted,
            pass * kDigitBits,
            at.digit_table,
            at.digit_sums,
            nullptr};
}

__device__ inline bool is_chunk(const Job& job, int chunk) { return chunk < job.at.header->facts.chunks; }

// All of a chunk's lists, by blocks that wait for each other.
__device__ SPLAT_ONCE inline void bin_chunk(const Job& job, int chunk) {
    count_pairs(job, chunk);
    sync_grid();
    if (blockIdx.x == 0) scan_pairs(job);
    sync_grid();
    emit_pairs(job, chunk);
    for (int pass = 0; pass < kTilePasses; ++pass) {
        sync_grid();
        count_digits(tile_pass(job.at, pass));
        sync_grid();
        scan_digits(tile_pass(job.at, pass));
        sync_grid();
        scatter_digits(tile_pass(job.at, pass));
    }
    sync_grid();
}

}  // namespace cuda
}  // namespace splat
