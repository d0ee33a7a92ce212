// Blending the features of a chunk's tiles, a group of channels at a time, with the tile's batches of blend.cuh.
//
// A pixel processes a pair as it does there, but for the cap of alpha. Of the last channel, `depth_u` and `depth_v` are
// its changes with u and v.
#pragma once

#include "cuda/blend.cuh"
#include "cuda/features.h"
#include "cuda/four.cuh"

namespace splat {
namespace cuda {

// A pair's channels of a group, four at a time; zeros behind the last.
template <int kWidth>
struct PairFeatures {
    static_assert(kWidth == kInlineChannels || kWidth == kWideChannels, "");
    float4 start, rest;
    const float* row;  // the splat's
    int first, count;

    __device__ __forceinline__ PairFeatures(const FeatureJob& job, const ChannelGroup& group, const float4& start,
                                            const float4& rest)
        : start(start), rest(rest), row(nullptr), first(group.first), count(group.count) {
        if (kWidth != kInlineChannels)
            row = job.splats.features + static_cast<int64_t>(__float_as_uint(start.z)) * job.stride;
    }
    // Channels 4 q to 4 q + 3 of the group.
    __device__ __forceinline__ Four four(int q) const {
        if (kWidth == kInlineChannels) return {{start.z, start.w, rest.x, rest.y}};
        if (4 * q >= count) return {{0.0f, 0.0f, 0.0f, 0.0f}};
        return *reinterpret_cast<const Four*>(row + first + 4 * q);
    }
};

// What the last channel has at a pixel besides its value at the centre.
__device__ __forceinline__ float slant_at(const float4& rest, float u, float v) { return fmaf(rest.z, u, rest.w * v); }

// A pixel on its way from front to back.
template <int kWidth>
struct FeatureCanvas {
    float transmittance = 1.0f, slant = 0.0f;
    float sums[kWidth] = {};
    int32_t end;
    bool alive;
};

template <int kWidth, bool kSlanted>
__device__ __forceinline__ void blend_features(const FeatureJob& job, const ChannelGroup& group,
                                               const Batch<kThreads>& batch, int i, int32_t pair, const Place& at,
                                               FeatureCanvas<kWidth>* canvas) {
    const Whitened splat = {batch.shape[i], batch.start[i]};
    const float u = splat.u(at), v = splat.v(at), log2_alpha = splat.log2_alpha(u, v);
    if (!(canvas->alive && kLog2AlphaMin <= log2_alpha)) return;
    const float before = canvas->transmittance;
    const float weight = fminf(power_of_two(log2_alpha), job.alpha_max) * before, after = before - weight;
    if (!(kTransmittanceMin <= after)) {
        canvas->alive = false, canvas->end = pair;
        return;
    }
    const float4 rest = batch.rest[i];
    const PairFeatures<kWidth> features(job, group, splat.start, rest);
    canvas->transmittance = after;
    SPLAT_UNROLL
    for (int q = 0; q < kWidth / 4; ++q) {
        const Four four = features.four(q);
        SPLAT_UNROLL
        for (int e = 0; e < 4; ++e) canvas->sums[4 * q + e] = fmaf(weight, four.of[e], canvas->sums[4 * q + e]);
    }
    if (kSlanted) canvas->slant = fmaf(weight, slant_at(rest, u, v), canvas->slant);
}

template <int kWidth, bool kSlanted>
__device__ __forceinline__ void put_features(const Job& job, const FeatureJob& features, const ChannelGroup& group,
                                             const Place& at, const FeatureCanvas<kWidth>& canvas) {
    const float left = canvas.transmittance;
    if (group.first == 0) {
        job.at.transmittance[at.kept] = left;
        job.at.pixel_end[at.kept] = canvas.end;
        if (at.inside) features.pictures.alpha[at.pixel] = 1.0f - left;
    }
    if (!at.inside) return;
    float* out = features.pictures.features + at.pixel * features.channels + group.first;
    const float* background = features.background ? features.background + group.first : nullptr;
    SPLAT_UNROLL
    for (int c = 0; c < kWidth; ++c) {
        if (c >= group.count) continue;
        float sum = canvas.sums[c];
        if (kSlanted && group.first + c == features.channels - 1) sum += canvas.slant;
        out[c] = background ? fmaf(left, background[c], sum) : sum;
    }
}

template <int kWidth, bool kSlanted>
__device__ __forceinline__ void blend_feature_tile(const Job& job, const FeatureJob& features,
                                                   const ChannelGroup& group, const TileList& list,
                                                   Batch<kThreads>* batch) {
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    const Place at = place_of(job.view, list);
    FeatureCanvas<kWidth> canvas;
    canvas.alive = at.inside, canvas.end = at.inside ? list.pairs : 0;
    for (int32_t from = 0; from < list.pairs; from += kThreads) {
        if (!__syncthreads_or(canvas.alive)) break;  // also a barrier: the last batch is no longer read
        stage(job, list, from, batch);
        __syncthreads();
        for (int word = 0; word < kWarps && __any_sync(kWholeWarp, canvas.alive); ++word) {
            for (unsigned left = batch->touched[warp][word]; left; left &= left - 1) {
                const int i = word * kWarp + __ffs(static_cast<int>(left)) - 1;
                blend_features<kWidth, kSlanted>(features, group, *batch, i, from + i, at, &canvas);
            }
        }
    }
    put_features<kWidth, kSlanted>(job, features, group, at, canvas);
}

// The images of a chunk's tiles in a group's channels. kSlanted: the last channel may be slanted.
template <int kWidth, bool kSlanted>
__device__ __forceinline__ void blend_feature_tiles(const Job& job, const FeatureJob& features,
                                                    const ChannelGroup& group, int chunk, Batch<kThreads>* batch) {
    const int first = job.at.chunk_begin[chunk], end = job.at.chunk_begin[chunk + 1];
    for (int tile = first + static_cast<int>(blockIdx.x); tile < end; tile += static_cast<int>(gridDim.x))
        blend_feature_tile<kWidth, kSlanted>(job, features, group, list_of(job, first, tile), batch);
}

}  // namespace cuda
}  // namespace splat
