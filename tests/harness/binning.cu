// The sort and the plan by themselves, and where a frame's lists lie, for tests/slow/harness/test_cuda_sort.py.
#include "cuda/api.h"
#include "cuda/bin.cuh"

namespace splat {
namespace cuda {
namespace {

template <class Key, class Value>
__global__ void count_kernel(SortPass<Key, Value> pass) {
    count_digits(pass);
}
template <class Key, class Value>
__global__ void scan_kernel(SortPass<Key, Value> pass) {
    scan_digits(pass);
}
template <class Key, class Value>
__global__ void scatter_kernel(SortPass<Key, Value> pass) {
    scatter_digits(pass);
}

__global__ void plan_alone(Job job) { plan_phase(job); }

// Keys and values in two halves each; `kept` is read between the passes as the device reads it.
template <class Key, class Value>
int32_t sort(Key* keys, Value* values, int64_t count, int blocks, uint32_t* table, uint32_t* sums, int32_t* kept) {
    Key* other_keys = keys + count;
    Value* other_values = values + count;
    const bool may_drop = sizeof(Key) == sizeof(kCulled);
    for (int shift = 0; shift < static_cast<int>(8 * sizeof(Key)); shift += kDigitBits) {
        const bool odd = shift / kDigitBits % 2;
        const SortPass<Key, Value> pass = {odd ? other_keys : keys,
                                           odd ? keys : other_keys,
                                           shift == 0 ? nullptr : (odd ? other_values : values),
                                           odd ? values : other_values,
                                           count,
                                           shift == 0 || !may_drop ? nullptr : kept,
                                           shift,
                                           table,
                                           sums,
                                           shift == 0 ? kept : nullptr};
        SPLAT_LAUNCH((count_kernel<Key, Value>), blocks, nullptr, pass);
        SPLAT_LAUNCH((scan_kernel<Key, Value>), blocks, nullptr, pass);
        SPLAT_LAUNCH((scatter_kernel<Key, Value>), blocks, nullptr, pass);
    }
    return cudaGetLastError();
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat::cuda;

extern "C" {

SPLAT_API int32_t sort_depths(uint32_t* keys, int32_t* values, int64_t count, int32_t blocks, uint32_t* table,
                              uint32_t* sums, int32_t* kept) {
    return sort(keys, values, count, blocks, table, sums, kept);
}

SPLAT_API int32_t sort_tiles(uint16_t* keys, uint32_t* values, int64_t count, int32_t blocks, uint32_t* table,
                             uint32_t* sums, int32_t* kept) {
    return sort(keys, values, count, blocks, table, sums, kept);
}

// `facts`: pairs, visible and chunks.
SPLAT_API int32_t plan(int32_t* tile_counts, int32_t tiles, int64_t capacity, int64_t* tile_begin, int32_t* chunk_begin,
                       int64_t* facts) {
    Job job{};
    Header header{};
    job.tiles = tiles, job.capacity = capacity;
    job.at.header = &header;
    job.at.tile_counts = tile_counts, job.at.tile_begin = tile_begin, job.at.chunk_begin = chunk_begin;
    SPLAT_LAUNCH(plan_alone, 1, nullptr, job);
    facts[0] = header.facts.pairs, facts[1] = header.facts.visible, facts[2] = header.facts.chunks;
    return cudaGetLastError();
}

// Where in a frame's memory: records, order, offsets, tile_begin, chunk_begin, the sorted pairs and owners.
SPLAT_API void places(int64_t count, int64_t tiles, int64_t capacity, int64_t* out) {
    FrameMemory at;
    lay_out(nullptr, count, tiles, capacity, &at);
    const void* pieces[] = {at.records,     at.order[0],       at.offsets, at.tile_begin,
                            at.chunk_begin, at.pair_values[0], at.owners};
    for (const void* piece : pieces) *out++ = static_cast<int64_t>(reinterpret_cast<uintptr_t>(piece));
}
}
