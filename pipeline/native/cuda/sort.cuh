// Sorts the pairs of splats and tiles: a pass of a stable radix sort, in three phases (count each block's digits,
// prefix-sum them over the blocks, scatter).
//
// Equal digits keep the order of the keys: a virtual block has kSortBlock consecutive keys, each of its warps a
// consecutive part of these, and a warp takes kWarp at a time.
#pragma once

#include "cuda/frame.h"
#include "cuda/scan.cuh"

namespace splat {
namespace cuda {

static_assert(kDigits == kThreads, "a thread a digit");
constexpr int kScanBlocks = kDigits / kWarps;  // of the phase in the middle

template <class Key, class Value>
struct SortPass {
    const Key* keys_from;  // kCulled ones are left out
    Key* keys_to;
    const Value* values_from;  // null: a key's value is its index
    Value* values_to;
    int64_t count;           // of keys
    const int32_t* counted;  // the same if only known on the device, else null
    int shift;               // of the digit
    uint32_t* table;         // (kDigits, blocks)
    uint32_t* digit_sums;    // (kDigits)
    int32_t* kept;           // number of keys not left out; null if not needed
};

template <class Key, class Value>
__device__ inline int64_t keys_of(const SortPass<Key, Value>& pass) {
    return pass.counted ? *pass.counted : pass.count;
}

__host__ __device__ inline int64_t sort_blocks(int64_t count) { return (count + kSortBlock - 1) / kSortBlock; }

template <class Key>
__device__ inline bool is_kept(Key key) {
    return static_cast<uint32_t>(key) != kCulled;
}

template <class Key>
__device__ inline uint32_t digit_of(Key key, int shift) {
    return static_cast<uint32_t>(key) >> shift & (kDigits - 1);
}

struct DigitCounts {
    uint32_t of[kDigits];
};

template <class Key, class Value>
__device__ void count_digits(const SortPass<Key, Value>& pass) {
    SPLAT_SHARED(DigitCounts, counts);
    const int64_t count = keys_of(pass), blocks = sort_blocks(count);
    for (int64_t block = blockIdx.x; block < blocks; block += gridDim.x) {
        counts.of[threadIdx.x] = 0;
        __syncthreads();
        for (int i = 0; i < kSortItems; ++i) {
            const int64_t at = block * kSortBlock + i * kThreads + threadIdx.x;
            if (at >= count) break;
            const Key key = pass.keys_from[at];
            if (is_kept(key)) atomicAdd(&counts.of[digit_of(key, pass.shift)], 1u);
        }
        __syncthreads();
        pass.table[threadIdx.x * blocks + block] = counts.of[threadIdx.x];
    }
}

// Turns a digit's counts into the offset of each block's first one among those of the digit; one warp per digit.
template <class Key, class Value>
__device__ void scan_digits(const SortPass<Key, Value>& pass) {
    const int64_t blocks = sort_blocks(keys_of(pass));
    for (int digit = blockIdx.x * kWarps + warp_index(); digit < kDigits; digit += gridDim.x * kWarps) {
        const uint32_t sum = scan_array_by_warp(pass.table + digit * blocks, blocks);
        if (lane_index() == 0) pass.digit_sums[digit] = sum;
    }
}

// Lanes with the same digit as this one, among those that have a digit.
__device__ inline unsigned lanes_alike(uint32_t digit, bool has) {
    unsigned alike = __ballot_sync(kWholeWarp, has);
    for (int bit = 0; bit < kDigitBits; ++bit) {
        const bool set = digit >> bit & 1;
        const unsigned with = __ballot_sync(kWholeWarp, set);
        alike &= set ? with : ~with;
    }
    return alike;
}

struct ScatterShared {
    uint16_t warps[kWarps][kDigits];  // a warp's digits counted; then the place in the block of the first of them
    uint32_t shift[kDigits];          // from an index in the block, sorted by this digit, to a global one
    uint32_t staged[kSortBlock];      // the block in order, for coalesced writes
    ScanShared<uint32_t> scan;
};
static_assert(kSortBlock < 1 << 16, "places in the block are 16 bits");

// A thread's keys of a block: `place` in the block in the order of the pass, where `kept` has the item's bit.
template <class Key>
struct SortItems {
    Key keys[kSortItems];
    uint32_t place[kSortItems];
    uint32_t kept;
};
static_assert(kSortItems <= 32, "bits of `kept`");

// Where a thread's first item is; the next ones follow in steps of kWarp.
__device__ inline int64_t first_item(int64_t block) {
    return block * kSortBlock + warp_index() * kSortItems * kWarp + lane_index();
}

// Places among the warp's keys of the same digit; the warp's digits are counted.
template <class Key, class Value>
__device__ inline void rank_items(const SortPass<Key, Value>& pass, int64_t count, int64_t block, uint16_t* counts,
                                  SortItems<Key>* items) {
    const unsigned before_me = (1u << lane_index()) - 1;
    const int64_t first = first_item(block);
    const Key* keys = pass.keys_from + first;
    const int left = static_cast<int>(count - first < kSortBlock ? count - first : kSortBlock);
    items->kept = 0;
    SPLAT_UNROLL
    for (int i = 0; i < kSortItems; ++i) {
        const bool there = i * kWarp < left;
        const Key key = there ? keys[i * kWarp] : Key{0};
        const bool kept = there && is_kept(key);
        const uint32_t digit = digit_of(key, pass.shift);
        const unsigned alike = lanes_alike(digit, kept), before = alike & before_me;
        const uint32_t counted = counts[digit];
        __syncwarp(kWholeWarp);
        if (kept && !before) counts[digit] = static_cast<uint16_t>(counted + __popc(alike));
        __syncwarp(kWholeWarp);
        items->keys[i] = key;
        items->place[i] = counted + static_cast<uint32_t>(__popc(before));
        items->kept |= static_cast<uint32_t>(kept) << i;
    }
}

// From counts to offsets: one thread per digit. Returns the number of keys that the block keeps.
template <class Key, class Value>
__device__ inline uint32_t place_digits(const SortPass<Key, Value>& pass, int64_t block, int64_t blocks,
                                        ScatterShared* shared) {
    const int digit = static_cast<int>(threadIdx.x);
    uint32_t count = 0, kept, all;
    for (int warp = 0; warp < kWarps; ++warp) count += shared->warps[warp][digit];
    uint32_t place = block_exclusive(count, &shared->scan, &kept);
    const uint32_t first = block_exclusive(pass.digit_sums[digit], &shared->scan, &all);
    shared->shift[digit] = first + pass.table[digit * blocks + block] - place;  // may wrap, and so will the sum
    for (int warp = 0; warp < kWarps; ++warp) {
        const uint32_t of_warp = shared->warps[warp][digit];
        shared->warps[warp][digit] = static_cast<uint16_t>(place);
        place += of_warp;
    }
    if (pass.kept && block == 0 && digit == 0) *pass.kept = static_cast<int32_t>(all);
    return kept;
}

template <class Key, class Value>
__device__ void scatter_digits(const SortPass<Key, Value>& pass) {
    SPLAT_SHARED(ScatterShared, shared);
    const int64_t count = keys_of(pass), blocks = sort_blocks(count);
    for (int64_t block = blockIdx.x; block < blocks; block += gridDim.x) {
        for (int warp = 0; warp < kWarps; ++warp) shared.warps[warp][threadIdx.x] = 0;
        __syncthreads();
        uint16_t* of_warp = shared.warps[warp_index()];
        SortItems<Key> items;
        rank_items(pass, count, block, of_warp, &items);
        __syncthreads();
        const uint32_t kept = place_digits(pass, block, blocks, &shared);
        __syncthreads();
        SPLAT_UNROLL
        for (int i = 0; i < kSortItems; ++i) {
            if (!(items.kept >> i & 1)) continue;
            items.place[i] += of_warp[digit_of(items.keys[i], pass.shift)];
            shared.staged[items.place[i]] = items.keys[i];
        }
        __syncthreads();
        uint32_t to[kSortItems];
        SPLAT_UNROLL
        for (int i = 0; i < kSortItems; ++i) {
            const uint32_t place = i * kThreads + threadIdx.x;
            if (place >= kept) continue;
            const Key key = static_cast<Key>(shared.staged[place]);
            to[i] = shared.shift[digit_of(key, pass.shift)] + place;
            pass.keys_to[to[i]] = key;
        }
        __syncthreads();
        const int64_t first = first_item(block);
        const Value* values = pass.values_from ? pass.values_from + first : nullptr;
        SPLAT_UNROLL
        for (int i = 0; i < kSortItems; ++i) {
            if (!(items.kept >> i & 1)) continue;
            const uint32_t place = static_cast<uint32_t>(first) + i * kWarp;
            shared.staged[items.place[i]] = values ? static_cast<uint32_t>(values[i * kWarp]) : place;
        }
        __syncthreads();
        SPLAT_UNROLL
        for (int i = 0; i < kSortItems; ++i) {
            const uint32_t place = i * kThreads + threadIdx.x;
            if (place < kept) pass.values_to[to[i]] = static_cast<Value>(shared.staged[place]);
        }
    }
}

}  // namespace cuda
}  // namespace splat
