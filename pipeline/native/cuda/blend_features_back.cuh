// Blending the features of a chunk's tiles, backward: as blend_back.cuh, a group of channels at a time.
//
// A warp sums the pair's moments along the rows of pixels and then over them, as there, and its channels over all
// lanes.
#pragma once

#include "cuda/blend_back.cuh"
#include "cuda/blend_features.cuh"

namespace splat {
namespace cuda {

// The values of a pair's gradient, and their places in its slot: the moments s, su, sv, suu, suv, svv; both magnitudes;
// the last channel's, slant_u and slant_v; then the group's channels.
template <int kGroupWidth, bool kHasMoments, bool kHasSlant, bool kHasMagnitudes>
struct FeatureFields {
    static constexpr int kWidth = kGroupWidth;
    static constexpr bool kMoments = kHasMoments, kSlanted = kHasSlant, kMagnitudes = kHasMagnitudes;
    static constexpr int kSizes = 6, kSlants = kSizes + (kMagnitudes ? 2 : 0);
    static constexpr int kChannels = kMoments ? kSlants + (kSlanted ? 3 : 0) : 0, kValues = kChannels + kWidth;
    // What is summed along a row of pixels: g, gu, guu; of a slant h and hu; both magnitudes.
    static constexpr int kRowSizes = 3 + (kSlanted ? 2 : 0), kRowValues = kRowSizes + (kMagnitudes ? 2 : 0);
    static_assert(kRowValues <= kSubWidth, "a lane of a row each");
    static constexpr int kThreadsASlot = kValues <= 16 ? 16 : kWarp;
    static_assert(kValues <= kThreadsASlot, "a thread a value");

    // The value that is a row's value times a power of v, negative for none.
    static __device__ __forceinline__ int value_at(int row_value, int power) {
        if (row_value < 0 || power < 0) return -1;
        if (row_value == 0) return power == 0 ? 0 : 3 * power - 1;
        if (row_value == 1) return power < 2 ? 1 + 3 * power : -1;
        if (kSlanted && row_value == 3 && power == 1) return kSlants + 2;
        if (power != 0) return -1;
        if (row_value == 2) return 3;
        return row_value < kRowSizes ? kSlants + row_value - 3 : kSizes + row_value - kRowSizes;
    }

    // Where a moment is summed, in the splat's kSumFloats.
    static __device__ __forceinline__ int sum_of(int value) {
        return value < kSlants ? value : kLastAt + value - kSlants;
    }
};

constexpr int kFeatureBatch = kWarp;  // pairs

template <int kValues>
struct FeatureBackBatch {
    Batch<kFeatureBatch> pairs;
    uint32_t slots[kFeatureBatch];
    unsigned summed[kWarps];  // by warp, a bit a pair: `sums` has something
    float sums[kFeatureBatch][kWarps][kValues];
    int32_t last[kWarps];
};

// A pixel on its way back.
template <int kWidth>
struct FeatureBackCanvas {
    float transmittance;  // behind the pair
    float behind;         // Σ w (f . dL/dF) of the pairs behind, less T dL/dT of what is left behind all of them
    float by[kWidth];     // dL/d(the group's channels)
    float by_last;        // dL/d(the last channel)
    const float* planes;  // dL/d(channels) of this pixel, `pixels` apart; null for zero
    int32_t end;
};

template <class Of>
__device__ __forceinline__ FeatureBackCanvas<Of::kWidth> start_features_back(const Job& job, const FeatureJob& features,
                                                                             const ChannelGroup& group,
                                                                             const Place& at) {
    FeatureBackCanvas<Of::kWidth> canvas = {};
    canvas.transmittance = job.at.transmittance[at.kept], canvas.end = job.at.pixel_end[at.kept];
    if (!at.inside) return canvas;
    if (features.by.features) {
        canvas.planes = features.by.features + at.pixel;
        SPLAT_UNROLL
        for (int c = 0; c < Of::kWidth; ++c)
            if (c < group.count) canvas.by[c] = canvas.planes[(group.first + c) * features.pixels];
        if (Of::kMoments && Of::kSlanted) canvas.by_last = canvas.planes[(features.channels - 1) * features.pixels];
    }
    if (!Of::kMoments) return canvas;
    float by_left = features.by.alpha ? -features.by.alpha[at.pixel] : 0.0f;
    if (canvas.planes && features.background)
        for (int c = 0; c < features.channels; ++c)
            by_left = fmaf(canvas.planes[c * features.pixels], features.background[c], by_left);
    canvas.behind = by_left * canvas.transmittance;
    return canvas;
}

// f . dL/dF of a pair at a pixel: of the group, of all channels behind it, and of the slant.
template <class Of>
__device__ __forceinline__ float value_of_pair(const FeatureJob& job, const PairFeatures<Of::kWidth>& features,
                                               float slant, const FeatureBackCanvas<Of::kWidth>& canvas) {
    float value = 0.0f;
    SPLAT_UNROLL
    for (int q = 0; q < Of::kWidth / 4; ++q) {
        const Four four = features.four(q);
        SPLAT_UNROLL
        for (int e = 0; e < 4; ++e) value = fmaf(four.of[e], canvas.by[4 * q + e], value);
    }
    if (Of::kWidth == kWideChannels && canvas.planes) {
        for (int c = kWideChannels; c < job.channels; ++c)
            value = fmaf(features.row[c], canvas.planes[c * job.pixels], value);
    }
    return Of::kSlanted ? fmaf(slant, canvas.by_last, value) : value;
}

// What a pixel adds to its row's values of a pair's gradient (see FeatureFields), and its weight; all zeros where the
// pixel did not meet the pair.
template <class Of>
__device__ __forceinline__ float blend_features_back(const FeatureJob& job, const ChannelGroup& group,
                                                     const Whitened& splat, const float4& rest, float u, float v,
                                                     float log2_alpha, bool met, FeatureBackCanvas<Of::kWidth>* canvas,
                                                     float (&values)[Of::kRowValues]) {
    const float alpha = met ? fminf(power_of_two(log2_alpha), job.alpha_max) : 0.0f;
    const float inv_rest = met ? inverse(1.0f - alpha) : 1.0f;
    const float before = canvas->transmittance * inv_rest, weight = alpha * before;
    canvas->transmittance = before;
    if (!Of::kMoments) return weight;
    const PairFeatures<Of::kWidth> features(job, group, splat.start, rest);
    const float value = value_of_pair<Of>(job, features, slant_at(rest, u, v), *canvas);
    const float light = weight * value, share = alpha * inv_rest;
    // dL/d(ln alpha) = light - behind alpha / (1 - alpha), and no gradient where clamped.
    const float g = log2_alpha <= job.log2_alpha_max ? fmaf(-share, canvas->behind, light) : 0.0f;
    canvas->behind = fmaf(weight, value, canvas->behind);
    const float gu = g * u;
    values[0] = g, values[1] = gu, values[2] = gu * u;
    if (Of::kSlanted) {
        const float h = weight * canvas->by_last;
        values[3] = h, values[4] = h * u;
    }
    if (Of::kMagnitudes) {
        values[Of::kRowSizes] = fabsf(gu);
        values[Of::kRowSizes + 1] = fabsf(fmaf(splat.shape.y, gu, splat.shape.z * (g * v)));
    }
    return weight;
}

// The pairs of a batch, from far to near, as far as this warp's pixels processed them: `looked`, counted from the
// first.
template <class Of, int kRoom>
__device__ __forceinline__ void walk_features_back(const FeatureJob& job, const ChannelGroup& group, const Place& at,
                                                   int32_t from, int32_t looked, FeatureBackCanvas<Of::kWidth>* canvas,
                                                   FeatureBackBatch<kRoom>* batch) {
    const int warp = static_cast<int>(threadIdx.x) / kWarp, lane = static_cast<int>(threadIdx.x) % kWarp;
    const int own = Of::value_at(summed_by<Of::kRowValues, kSubWidth / 2, 0>(lane),
                                 summed_by<kPowers, kWarp / 2, kSubWidth / 2>(lane));
    const int own_channel = summed_by<Of::kWidth, kWarp / 2, 0>(lane);
    unsigned left = batch->pairs.touched[warp][0], summed = 0;
    if (looked < kWarp) left = looked > 0 ? left & ((1u << looked) - 1) : 0;
    while (left) {
        const int i = kWarp - 1 - __clz(static_cast<int>(left));
        left ^= 1u << i;
        const Whitened splat = {batch->pairs.shape[i], batch->pairs.start[i]};
        const float u = splat.u(at), v = splat.v(at), log2_alpha = splat.log2_alpha(u, v);
        const bool met = kLog2AlphaMin <= log2_alpha && from + i < canvas->end;
        if (!__any_sync(kWholeWarp, met)) continue;
        float values[Of::kRowValues], channels[Of::kWidth];
        const float weight =
            blend_features_back<Of>(job, group, splat, batch->pairs.rest[i], u, v, log2_alpha, met, canvas, values);
        if (Of::kMoments) {
            const float of_row = sum_halving<Of::kRowValues, kSubWidth / 2, 0>(values, lane), by_v = of_row * v;
            float powers[kPowers] = {of_row, by_v, by_v * v};
            const float sum = sum_halving<kPowers, kWarp / 2, kSubWidth / 2>(powers, lane);
            if (own >= 0) batch->sums[i][warp][own] = sum;
        }
        SPLAT_UNROLL
        for (int c = 0; c < Of::kWidth; ++c) channels[c] = weight * canvas->by[c];
        const float of_channel = sum_halving<Of::kWidth, kWarp / 2, 0>(channels, lane);
        if (own_channel >= 0) batch->sums[i][warp][Of::kChannels + own_channel] = of_channel;
        summed |= 1u << i;
    }
    if (lane == 0) batch->summed[warp] = summed;
}

// From the warps' sums to the slots of the batch's first `pairs`.
template <class Of, int kRoom>
__device__ __forceinline__ void put_feature_slots(const FeatureJob& job, const FeatureBackBatch<kRoom>& batch,
                                                  int pairs) {
    const int thread = static_cast<int>(threadIdx.x), value = thread % Of::kThreadsASlot;
    if (value >= Of::kValues) return;
#pragma unroll 1
    for (int i = thread / Of::kThreadsASlot; i < pairs; i += kThreads / Of::kThreadsASlot) {
        float sum = 0.0f;
#pragma unroll
        for (int warp = 0; warp < kWarps; ++warp)
            if (batch.summed[warp] >> i & 1) sum += batch.sums[i][warp][value];
        job.slots[static_cast<int64_t>(batch.slots[i]) * Of::kValues + value] = sum;
    }
}

// Slots of the pairs from `last` on, which no pixel processed.
template <class Of>
__device__ __forceinline__ void clear_feature_slots(const FeatureJob& job, const TileList& list, int32_t last) {
    const int thread = static_cast<int>(threadIdx.x), value = thread % Of::kThreadsASlot;
    if (value >= Of::kValues) return;
#pragma unroll 1
    for (int64_t pair = last + thread / Of::kThreadsASlot; pair < list.pairs; pair += kThreads / Of::kThreadsASlot)
        job.slots[static_cast<int64_t>(list.slots[pair]) * Of::kValues + value] = 0.0f;
}

template <class Of, int kRoom>
__device__ __forceinline__ void blend_feature_tile_back(const Job& job, const FeatureJob& features,
                                                        const ChannelGroup& group, const TileList& list,
                                                        FeatureBackBatch<kRoom>* batch) {
    static_assert(Of::kValues <= kRoom, "");
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    const Place at = place_of(job.view, list);
    FeatureBackCanvas<Of::kWidth> canvas = start_features_back<Of>(job, features, group, at);
    const int32_t last_here = most_in_warp(canvas.end);
    __syncthreads();  // the tile before is done with `last`
    if (threadIdx.x % kWarp == 0) batch->last[warp] = last_here;
    __syncthreads();
    int32_t last = 0;
#pragma unroll
    for (int w = 0; w < kWarps; ++w) last = last > batch->last[w] ? last : batch->last[w];
    clear_feature_slots<Of>(features, list, last);
    for (int32_t to = last; to > 0; to -= kFeatureBatch) {
        const int32_t from = to > kFeatureBatch ? to - kFeatureBatch : 0;
        stage_back(job, list, from, to, &batch->pairs, batch->slots);
        __syncthreads();
        walk_features_back<Of>(features, group, at, from, last_here - from, &canvas, batch);
        __syncthreads();
        put_feature_slots<Of>(features, *batch, to - from);
        __syncthreads();
    }
}

// Writes every slot of a chunk.
template <class Of, int kRoom>
__device__ __forceinline__ void blend_feature_tiles_back(const Job& job, const FeatureJob& features,
                                                         const ChannelGroup& group, int chunk,
                                                         FeatureBackBatch<kRoom>* batch) {
    const int first = job.at.chunk_begin[chunk], end = job.at.chunk_begin[chunk + 1];
    for (int tile = first + static_cast<int>(blockIdx.x); tile < end; tile += static_cast<int>(gridDim.x))
        blend_feature_tile_back<Of>(job, features, group, list_of(job, first, tile), batch);
}

// Adds the slots of a chunk to the splats' sums and to the gradients of their features, one after another.
template <class Of>
__device__ __forceinline__ void sum_feature_slots(const Job& job, const FeatureJob& features, const ChannelGroup& group,
                                                  int chunk) {
    constexpr int kRanks = kThreads / Of::kThreadsASlot;
    const Header& header = *job.at.header;
    const int value = static_cast<int>(threadIdx.x) % Of::kThreadsASlot, channel = value - Of::kChannels;
    if (value >= Of::kValues || channel >= group.count) return;
    const int64_t step = static_cast<int64_t>(gridDim.x) * kRanks;
    for (int64_t rank = static_cast<int64_t>(blockIdx.x) * kRanks + threadIdx.x / Of::kThreadsASlot;
         rank < header.visible; rank += step) {
        const int64_t begin = job.at.offsets[rank];
        const int64_t end = rank + 1 < header.visible ? job.at.offsets[rank + 1] : header.chunk_pairs;
        if (begin >= end) continue;
        const int64_t splat = job.at.order[0][rank];
        float* total = channel < 0 ? features.sums + splat * kSumFloats + Of::sum_of(value)
                                   : features.out.features + splat * features.channels + group.first + channel;
        float sum = *total;
        for (int64_t slot = begin; slot < end; slot += kSumAhead) {
            float values[kSumAhead];
#pragma unroll
            for (int i = 0; i < kSumAhead; ++i)
                values[i] = slot + i < end ? features.slots[(slot + i) * Of::kValues + value] : 0.0f;
#pragma unroll
            for (int i = 0; i < kSumAhead; ++i) sum += values[i];
        }
        *total = sum;
    }
}

}  // namespace cuda
}  // namespace splat
