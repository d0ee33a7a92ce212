// Blending the tiles of a chunk, backward: each pixel from its last contributor to its first, as raster_blend.cpp does.
//
// A warp processes one pair at a time, one lane per pixel. The warp's contributions to the pair's gradient are summed
// by shuffles, first along the rows of pixels, where v is constant, so that its powers need no separate sums; the
// contributions of the tile's warps are summed in shared memory, in order, and written to the pair's slot: without
// atomic operations, so always bit-identical.
#pragma once

#include "cuda/blend.cuh"

namespace splat {
namespace cuda {

constexpr int kColourValues = 9;  // a pair's gradients without those of depth and without magnitudes

// The values of a pair's gradient, and their places in its slot.
template <bool kDepth, bool kMagnitudes>
struct Fields {
    static constexpr int kValues = kColourValues + (kDepth ? 3 : 0) + (kMagnitudes ? 2 : 0);
    static constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats;
    // Of the first; after them those of depth, which SplatGradient has apart.
    static constexpr int kSizes = kColourValues + (kDepth ? 1 : 0), kSlants = kSizes + (kMagnitudes ? 2 : 0);
    // What is summed along a row of pixels: g, gu, guu and the colour's; of depth h and hu, of magnitudes both. All
    // together are more than a row has lanes.
    static constexpr bool kSizesApart = kDepth && kMagnitudes;
    static constexpr int kRowValues = 6 + (kDepth ? 2 : 0) + (kMagnitudes && !kDepth ? 2 : 0);
    static_assert(kRowValues <= kSubWidth, "a lane of a row each");

    // The value that is a row's value times a power of v, negative for none.
    static __device__ __forceinline__ int value_at(int row_value, int power) {
        if (row_value == 0) return power == 0 ? 0 : 3 * power - 1;
        if (row_value == 1) return power < 2 ? 1 + 3 * power : -1;
        if (kDepth && row_value == 6 && power == 1) return kSlants + 1;
        if (row_value < 0 || power != 0) return -1;
        if (row_value == 2) return 3;
        if (row_value < 6) return row_value + 3;
        return kDepth ? (row_value == 6 ? kColourValues : kSlants) : kSizes + row_value - 6;
    }

    // More pairs per batch need fewer barriers, but shared memory should leave room for other blocks.
    static constexpr int kBatch = kValues > kColourValues ? kWarp : 2 * kWarp;

    // The value of a slot's field, negative where it is zero.
    static __device__ __forceinline__ int value_of(int field) {
        if (field < kColourValues) return field;
        if (field == 9) return kDepth ? kColourValues : -1;
        if (field < kSlotFloats) return kMagnitudes ? kSizes + field - 10 : -1;
        return kDepth && field < kSlotFloats + 2 ? kSlants + field - kSlotFloats : -1;
    }
};

// Sums each of kCount values over lanes kOffset apart, then half of that, and so on down to kEnd. At each level a lane
// passes one half of its values to the opposite lane and keeps the other half. Each sum ends up in one of these lanes
// (see summed_by).
template <int kCount, int kOffset, int kEnd, int kSize>
__device__ __forceinline__ float sum_halving(float (&values)[kSize], int lane) {
    if constexpr (kOffset == kEnd) {
        static_assert(kCount == 1, "a sum a lane");
        return values[0];
    } else {
        constexpr int kKept = (kCount + 1) / 2;
        const bool upper = lane & kOffset;
#pragma unroll
        for (int i = 0; i < kKept; ++i) {
            float kept = values[i], given = values[i];
            if (i + kKept < kCount) {  // else both lanes keep it
                kept = upper ? values[i + kKept] : values[i];
                given = upper ? values[i] : values[i + kKept];
            }
            values[i] = kept + __shfl_xor_sync(kWholeWarp, given, kOffset);
        }
        return sum_halving<kKept, kOffset / 2, kEnd>(values, lane);
    }
}

// The value whose sum a lane ends up with, negative if another lane has it as well.
template <int kCount, int kOffset, int kEnd>
__device__ __forceinline__ int summed_by(int lane) {
    if constexpr (kOffset == kEnd) {
        return 0;
    } else {
        constexpr int kKept = (kCount + 1) / 2;
        const int place = summed_by<kKept, kOffset / 2, kEnd>(lane);
        const int value = lane & kOffset ? place + kKept : place;
        return place < 0 || value >= kCount ? -1 : value;
    }
}

template <bool kDepth, bool kMagnitudes>
struct BackBatch {
    using Of = Fields<kDepth, kMagnitudes>;
    Batch<Of::kBatch> pairs;
    uint32_t slots[Of::kBatch];
    unsigned summed[Batch<Of::kBatch>::kWords][kWarps];  // by warp, a bit a pair: `sums` has something
    float sums[Of::kBatch][kWarps][Of::kValues];
    int32_t last[kWarps];
};

// A pixel on its way back.
struct BackCanvas {
    float transmittance;  // behind the pair
    // Σ w (c . dL/dC + z dL/dD + (z - origin)² dL/dS) of the pairs behind, less T dL/dT of what is left behind all of
    // them.
    float behind;
    float red, green, blue, depth, depth_square;  // dL/d(pictures)
    int32_t end;
};

template <bool kDepth>
__device__ __forceinline__ BackCanvas start_back(const Job& job, const Place& at) {
    BackCanvas canvas = {job.at.transmittance[at.kept], 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, job.at.pixel_end[at.kept]};
    if (!at.inside) return canvas;
    const PictureGradients& in = job.gradients;
    if (in.colour) {
        canvas.red = in.colour[3 * at.pixel], canvas.green = in.colour[3 * at.pixel + 1];
        canvas.blue = in.colour[3 * at.pixel + 2];
    }
    if (kDepth && in.depth_sum) canvas.depth = in.depth_sum[at.pixel];
    if (kDepth && in.depth_square_sum) canvas.depth_square = in.depth_square_sum[at.pixel];
    const float* background = job.view.background;
    const float by_left = canvas.red * background[0] + canvas.green * background[1] + canvas.blue * background[2];
    canvas.behind = (by_left - (in.alpha ? in.alpha[at.pixel] : 0.0f)) * canvas.transmittance;
    return canvas;
}

__device__ __forceinline__ int32_t most_in_warp(int32_t value) {
#pragma unroll
    for (int offset = kWarp / 2; offset; offset /= 2) {
        const int32_t other = __shfl_xor_sync(kWholeWarp, value, offset);
        value = value > other ? value : other;
    }
    return value;
}

// Pairs from..to-1 of a tile, each by four threads, one per band of the tile.
template <int kBatch>
__device__ __forceinline__ void stage_back(const Job& job, const TileList& list, int32_t from, int32_t to,
                                           Batch<kBatch>* batch, uint32_t* slots) {
    constexpr int kGroups = kBatch / kWarp;
    const int warp = static_cast<int>(threadIdx.x) / kWarp, lane = static_cast<int>(threadIdx.x) % kWarp;
    const int band = warp / kGroups, group = warp % kGroups, i = group * kWarp + lane;
    if (band >= kBands) return;
    unsigned touched = 0;
    if (from + i < to) {
        const uint32_t slot = list.slots[from + i];
        const Record s = job.at.records[job.at.owners[slot]];
        touched = Ellipse(s, list).sub_blocks(band);
        if (band == 0) batch->shape[i] = make_float4(s.a, s.b, s.c, s.log2_opacity);
        if (band == 1) stage_start(s, list, i, batch);
        if (band == 2) batch->rest[i] = make_float4(s.blue, s.depth, s.depth_u, s.depth_v);
        if (band == 3) slots[i] = slot;
    }
    const unsigned left = __ballot_sync(kWholeWarp, touched & 1), right = __ballot_sync(kWholeWarp, touched & 2);
    if (lane == 0) batch->touched[2 * band][group] = left, batch->touched[2 * band + 1][group] = right;
}

// What a pixel adds to its row's values of a pair's gradient (see Fields), and to the magnitudes where those are apart;
// all zeros where the pixel did not meet it.
template <bool kDepth, bool kMagnitudes, int kRowValues>
__device__ __forceinline__ void blend_back(const Whitened& splat, const float4& rest, float u, float v,
                                           float log2_alpha, bool met, float depth_origin, BackCanvas* canvas,
                                           float (&values)[kRowValues], float (&sizes)[2]) {
    const float alpha = met ? fminf(power_of_two(log2_alpha), kAlphaMax) : 0.0f;
    const float inv_rest = met ? inverse(1.0f - alpha) : 1.0f;
    const float before = canvas->transmittance * inv_rest, weight = alpha * before;
    float value = fmaf(splat.start.z, canvas->red, fmaf(splat.start.w, canvas->green, rest.x * canvas->blue));
    values[3] = weight * canvas->red, values[4] = weight * canvas->green, values[5] = weight * canvas->blue;
    if (kDepth) {
        const float depth = depth_at(rest, u, v), from_origin = depth - depth_origin;
        value = fmaf(depth, canvas->depth, value);
        value = fmaf(from_origin * from_origin, canvas->depth_square, value);
        const float g = weight * fmaf(from_origin + from_origin, canvas->depth_square, canvas->depth);
        values[6] = g, values[7] = g * u;
    }
    const float light = weight * value, share = alpha * inv_rest;
    // dL/d(ln alpha) = light - behind alpha / (1 - alpha), and no gradient where clamped.
    const float g = log2_alpha <= kLog2AlphaMax ? fmaf(-share, canvas->behind, light) : 0.0f;
    canvas->transmittance = before, canvas->behind = fmaf(weight, value, canvas->behind);
    const float gu = g * u;
    values[0] = g, values[1] = gu, values[2] = gu * u;
    if (kMagnitudes) {
        float* to = kDepth ? sizes : values + 6;
        to[0] = fabsf(gu), to[1] = fabsf(fmaf(splat.shape.y, gu, splat.shape.z * (g * v)));
    }
}

constexpr int kPowers = 3;  // of v: 0, 1 and 2

// The pairs of a batch, from far to near, as far as this warp's pixels processed them: `looked`, counted from the
// first.
template <bool kDepth, bool kMagnitudes>
__device__ __forceinline__ void walk_back(const Place& at, int32_t from, int32_t looked, float depth_origin,
                                          BackCanvas* canvas, BackBatch<kDepth, kMagnitudes>* batch) {
    using Of = Fields<kDepth, kMagnitudes>;
    const int warp = static_cast<int>(threadIdx.x) / kWarp, lane = static_cast<int>(threadIdx.x) % kWarp;
    const int own = Of::value_at(summed_by<Of::kRowValues, kSubWidth / 2, 0>(lane),
                                 summed_by<kPowers, kWarp / 2, kSubWidth / 2>(lane));
    const int own_size = Of::kSizesApart ? summed_by<2, kWarp / 2, 0>(lane) : -1;
#pragma unroll 1  // not unrolled, as below: registers for four blocks are worth more
    for (int word = Of::kBatch / kWarp - 1; word >= 0; --word) {
        unsigned left = batch->pairs.touched[warp][word], summed = 0;
        const int32_t here = looked - word * kWarp;
        if (here < kWarp) left = here > 0 ? left & ((1u << here) - 1) : 0;
        while (left) {
            const int bit = kWarp - 1 - __clz(static_cast<int>(left)), i = word * kWarp + bit;
            left ^= 1u << bit;
            const Whitened splat = {batch->pairs.shape[i], batch->pairs.start[i]};
            const float u = splat.u(at), v = splat.v(at), log2_alpha = splat.log2_alpha(u, v);
            const bool met = kLog2AlphaMin <= log2_alpha && from + i < canvas->end;
            if (!__any_sync(kWholeWarp, met)) continue;
            float values[Of::kRowValues], sizes[2];
            blend_back<kDepth, kMagnitudes>(splat, batch->pairs.rest[i], u, v, log2_alpha, met, depth_origin, canvas,
                                            values, sizes);
            const float of_row = sum_halving<Of::kRowValues, kSubWidth / 2, 0>(values, lane), by_v = of_row * v;
            float powers[kPowers] = {of_row, by_v, by_v * v};
            const float sum = sum_halving<kPowers, kWarp / 2, kSubWidth / 2>(powers, lane);
            if (own >= 0) batch->sums[i][warp][own] = sum;
            if (Of::kSizesApart) {
                const float size = sum_halving<2, kWarp / 2, 0>(sizes, lane);
                if (own_size >= 0) batch->sums[i][warp][Of::kSizes + own_size] = size;
            }
            summed |= 1u << bit;
        }
        if (lane == 0) batch->summed[word][warp] = summed;
    }
}

constexpr int kSlotThreads = 16;  // a slot's, one a field: slots lie in a row
constexpr int kSlotsAtOnce = kThreads / kSlotThreads;
static_assert(kSlotThreads >= kDepthSlotFloats && kSlotThreads >= kSlotFloats, "a thread a field");

// From the warps' sums to the slots of the batch's first `pairs`.
template <bool kDepth, bool kMagnitudes>
__device__ __forceinline__ void put_slots(const Job& job, const BackBatch<kDepth, kMagnitudes>& batch, int pairs) {
    using Of = Fields<kDepth, kMagnitudes>;
    const int thread = static_cast<int>(threadIdx.x), field = thread % kSlotThreads;
    if (field >= Of::kFloats) return;
    const int value = Of::value_of(field);
#pragma unroll 1
    for (int i = thread / kSlotThreads; i < pairs; i += kSlotsAtOnce) {
        const unsigned (&words)[kWarps] = batch.summed[i / kWarp];
        float sum = 0.0f;
        if (value >= 0) {
#pragma unroll
            for (int warp = 0; warp < kWarps; ++warp)
                if (words[warp] >> (i % kWarp) & 1) sum += batch.sums[i][warp][value];
        }
        job.back.slots[static_cast<int64_t>(batch.slots[i]) * Of::kFloats + field] = sum;
    }
}

// Slots of the pairs from `last` on, which no pixel processed.
template <int kFloats>
__device__ __forceinline__ void clear_slots(const Job& job, const TileList& list, int32_t last) {
    const int thread = static_cast<int>(threadIdx.x), field = thread % kSlotThreads;
    if (field >= kFloats) return;
#pragma unroll 1
    for (int64_t pair = last + thread / kSlotThreads; pair < list.pairs; pair += kSlotsAtOnce)
        job.back.slots[static_cast<int64_t>(list.slots[pair]) * kFloats + field] = 0.0f;
}

template <bool kDepth, bool kMagnitudes>
__device__ __forceinline__ void blend_tile_back(const Job& job, const TileList& list,
                                                BackBatch<kDepth, kMagnitudes>* batch) {
    using Of = Fields<kDepth, kMagnitudes>;
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    const Place at = place_of(job.view, list);
    BackCanvas canvas = start_back<kDepth>(job, at);
    const int32_t last_here = most_in_warp(canvas.end);
    __syncthreads();  // the tile before is done with `last`
    if (threadIdx.x % kWarp == 0) batch->last[warp] = last_here;
    __syncthreads();
    int32_t last = 0;
#pragma unroll
    for (int w = 0; w < kWarps; ++w) last = last > batch->last[w] ? last : batch->last[w];
    clear_slots<Of::kFloats>(job, list, last);
    for (int32_t to = last; to > 0; to -= Of::kBatch) {
        const int32_t from = to > Of::kBatch ? to - Of::kBatch : 0;
        stage_back(job, list, from, to, &batch->pairs, batch->slots);
        __syncthreads();
        walk_back(at, from, last_here - from, job.view.depth_origin, &canvas, batch);
        __syncthreads();
        put_slots(job, *batch, to - from);
        __syncthreads();
    }
}

// Writes every slot of a chunk. kDepth if depths have a gradient, kMagnitudes if those are needed; else zero.
template <bool kDepth, bool kMagnitudes>
__device__ void blend_tiles_back(const Job& job, int chunk) {
    using Shared = BackBatch<kDepth, kMagnitudes>;
    SPLAT_SHARED(Shared, batch);
    const int first = job.at.chunk_begin[chunk], end = job.at.chunk_begin[chunk + 1];
    for (int tile = first + static_cast<int>(blockIdx.x); tile < end; tile += static_cast<int>(gridDim.x))
        blend_tile_back(job, list_of(job, first, tile), &batch);
}

constexpr int kSumAhead = 8;  // slots in flight at a time: a Gaussian that covers the screen has thousands

// Adds the slots of a chunk to the Gaussians' sums, one after another.
template <bool kDepth>
__device__ void sum_slots(const Job& job, int chunk) {
    constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats, kRanks = kSlotsAtOnce;
    const Header& header = *job.at.header;
    const int field = static_cast<int>(threadIdx.x) % kSlotThreads;
    const int64_t step = static_cast<int64_t>(gridDim.x) * kRanks;
    for (int64_t rank = static_cast<int64_t>(blockIdx.x) * kRanks + threadIdx.x / kSlotThreads; rank < header.visible;
         rank += step) {
        const int64_t begin = job.at.offsets[rank];
        const int64_t end = rank + 1 < header.visible ? job.at.offsets[rank + 1] : header.chunk_pairs;
        if (field >= kFloats || begin >= end) continue;
        float* total = job.back.sums + static_cast<int64_t>(job.at.order[0][rank]) * kFloats + field;
        float sum = *total;
        for (int64_t slot = begin; slot < end; slot += kSumAhead) {
            float values[kSumAhead];
#pragma unroll
            for (int i = 0; i < kSumAhead; ++i)
                values[i] = slot + i < end ? job.back.slots[(slot + i) * kFloats + field] : 0.0f;
#pragma unroll
            for (int i = 0; i < kSumAhead; ++i) sum += values[i];
        }
        *total = sum;
    }
}

}  // namespace cuda
}  // namespace splat
