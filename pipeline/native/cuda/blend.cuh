// Blending the tiles of a chunk: one block per tile, one warp per sub-block of 8 x 4 pixels, one lane per pixel.
//
// A pixel processes a pair exactly as in raster_blend.cpp, step by step. A tile's pairs are staged in shared memory in
// batches, each with the sub-blocks that its ellipse touches: a warp visits only these.
#pragma once

#include "cuda/frame.h"

namespace splat {
namespace cuda {

constexpr int kSubWidth = 8, kSubHeight = 4;  // pixels
constexpr int kBands = kTile / kSubHeight;    // rows of sub-blocks, of two each
static_assert(kSubWidth * kSubHeight == kWarp && 2 * kSubWidth == kTile && 2 * kBands == kWarps, "a warp a sub-block");

constexpr int kBlendBlocks = 4;  // per multiprocessor: 64 registers per thread, without spilling

// Sub-blocks are found with a slightly larger ellipse: if rounding here and in log2_alpha disagrees on a border pixel,
// the pixel has to be visited.
constexpr float kReachSlack = 1e-4f, kSlackPx = 1.0f / 32.0f;

__device__ __forceinline__ float power_of_two(float x) {
#if SPLAT_ON_CPU
    return exp2f(x);
#else  // exp2f first guards against denormals, which no alpha here is: the smallest that counts is 1/255
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#endif
}

__device__ __forceinline__ float inverse(float x) {
#if SPLAT_ON_CPU
    return 1.0f / x;
#else  // within one unit of the last place, at a tenth of a division's cost
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#endif
}

__device__ __forceinline__ float root(float x) {
#if SPLAT_ON_CPU
    return sqrtf(x);
#else
    float y;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#endif
}

// A tile and its list.
struct TileList {
    int tile, left, top;  // pixels
    int32_t pairs;
    const uint32_t* slots;  // of the pairs, from near to far
};

__device__ __forceinline__ TileList list_of(const Job& job, int first_tile, int tile) {
    const int64_t begin = job.at.tile_begin[tile];
    return {tile, tile % job.view.tiles_x * kTile, tile / job.view.tiles_x * kTile,
            static_cast<int32_t>(job.at.tile_begin[tile + 1] - begin),
            job.at.pair_values[0] + (begin - job.at.tile_begin[first_tile])};
}

// A thread's pixel.
struct Place {
    float x, y;     // in the tile
    int64_t pixel;  // in the picture, meaningful where inside
    int64_t kept;   // in what a frame keeps of each tile's pixels
    bool inside;
};

__device__ __forceinline__ Place place_of(const View& view, const TileList& list) {
    const int thread = static_cast<int>(threadIdx.x), warp = thread / kWarp, lane = thread % kWarp;
    const int column = warp % 2 * kSubWidth + lane % kSubWidth, row = warp / 2 * kSubHeight + lane / kSubWidth;
    const int x = list.left + column, y = list.top + row;
    return {static_cast<float>(column), static_cast<float>(row), static_cast<int64_t>(y) * view.width + x,
            static_cast<int64_t>(list.tile) * kTilePixels + thread, x < view.width && y < view.height};
}

// A batch of pairs as seen by the pixels of a tile. Structure of arrays: each field is read by a whole warp at once,
// and written by neighbouring threads to neighbouring addresses.
template <int kBatch>
struct Batch {
    static constexpr int kWords = kBatch / kWarp;
    float4 shape[kBatch];              // a, b, c, log2_opacity
    float4 start[kBatch];              // u and v at the tile's first pixel; red, green
    float4 rest[kBatch];               // blue, depth, depth_u, depth_v
    unsigned touched[kWarps][kWords];  // by sub-block, a bit a pair
};

// A splat's shape as its pixels see it.
struct Whitened {
    float4 shape;
    float4 start;

    __device__ __forceinline__ float u(const Place& at) const {
        return fmaf(shape.x, at.x, fmaf(shape.y, at.y, start.x));
    }
    __device__ __forceinline__ float v(const Place& at) const { return fmaf(shape.z, at.y, start.y); }
    __device__ __forceinline__ float log2_alpha(float u, float v) const { return fmaf(-u, u, fmaf(-v, v, shape.w)); }
};

// Depth at which the pixel's ray peaks in the Gaussian.
__device__ __forceinline__ float depth_at(const float4& rest, float u, float v) {
    return fmaf(rest.z, u, fmaf(rest.w, v, rest.y));
}

// The ellipse of a record as seen from a tile's first pixel.
struct Ellipse {
    float x, y;  // centre
    float c, slope, inv_a, reach, half_y, rows_dy;

    // The same as expand, but with fast operations: each is off by a few units in the last place, which is small
    // compared with the slack, while exact ones would be a large part of the work per pair.
    __device__ __forceinline__ Ellipse(const Record& s, const TileList& list) {
        const float tight = fmaxf(s.log2_opacity - kLog2AlphaMin, 0.0f);
        x = s.x - static_cast<float>(list.left) - 0.5f, y = s.y - static_cast<float>(list.top) - 0.5f;
        c = s.c, inv_a = inverse(s.a), slope = -s.b * inv_a;
        rows_dy = -s.b * inverse(s.c) * root(tight * inverse(fmaf(s.b, s.b, s.c * s.c)));
        reach = fmaf(tight, kReachSlack, tight) + kReachSlack;
        half_y = root(reach) * inverse(s.c);
    }

    // Which of a band's two sub-blocks have a pixel centre between the leftmost and the rightmost point that the
    // ellipse has in its rows: 1 the left one, 2 the right one. As find_span does for a row of tiles.
    __device__ __forceinline__ unsigned sub_blocks(int band) const {
        const float row = static_cast<float>(band * kSubHeight);
        const float dy_first = fmaxf(row - y, -half_y), dy_last = fminf(row + (kSubHeight - 1) - y, half_y);
        const float dy_right = fminf(fmaxf(rows_dy, dy_first), dy_last);
        const float dy_left = fminf(fmaxf(-rows_dy, dy_first), dy_last);
        const float last = floorf(x + fmaf(slope, dy_right, half_chord(dy_right)) + kSlackPx);
        const float first = ceilf(x + fmaf(slope, dy_left, -half_chord(dy_left)) - kSlackPx);
        if (!(dy_first <= dy_last && first <= last)) return 0;
        return (first < kSubWidth && last >= 0.0f ? 1u : 0u) | (first < kTile && last >= kSubWidth ? 2u : 0u);
    }

    __device__ __forceinline__ float half_chord(float dy) const {
        const float v = c * dy;
        return inv_a * root(fmaxf(fmaf(-v, v, reach), 0.0f));
    }
};

template <int kBatch>
__device__ __forceinline__ void stage_start(const Record& s, const TileList& list, int i, Batch<kBatch>* batch) {
    const float dx = static_cast<float>(list.left) + 0.5f - s.x, dy = static_cast<float>(list.top) + 0.5f - s.y;
    batch->start[i] = make_float4(fmaf(s.a, dx, s.b * dy), s.c * dy, s.red, s.green);
}

// Pairs from..from+kThreads-1 of a tile, one by each thread.
__device__ __forceinline__ void stage(const Job& job, const TileList& list, int32_t from, Batch<kThreads>* batch) {
    const int thread = static_cast<int>(threadIdx.x), warp = thread / kWarp, lane = thread % kWarp;
    unsigned touched = 0;
    if (from + thread < list.pairs) {
        const Record s = job.at.records[job.at.owners[list.slots[from + thread]]];
        batch->shape[thread] = make_float4(s.a, s.b, s.c, s.log2_opacity);
        stage_start(s, list, thread, batch);
        batch->rest[thread] = make_float4(s.blue, s.depth, s.depth_u, s.depth_v);
        const Ellipse ellipse(s, list);
#pragma unroll 2  // unrolling all four takes more registers than four blocks allow
        for (int band = 0; band < kBands; ++band) touched |= ellipse.sub_blocks(band) << (2 * band);
    }
#pragma unroll
    for (int sub = 0; sub < kWarps; ++sub) {
        const unsigned pairs = __ballot_sync(kWholeWarp, touched >> sub & 1);
        if (lane == sub) batch->touched[sub][warp] = pairs;
    }
}

// A pixel on its way from front to back.
struct Canvas {
    float transmittance = 1.0f, red = 0.0f, green = 0.0f, blue = 0.0f;
    float depth = 0.0f, depth_square = 0.0f, median = 0.0f;
    int32_t end;
    bool alive;
};

template <bool kDepth>
__device__ __forceinline__ void blend(const Batch<kThreads>& batch, int i, int32_t pair, const Place& at,
                                      float depth_origin, Canvas* canvas) {
    const Whitened splat = {batch.shape[i], batch.start[i]};
    const float u = splat.u(at), v = splat.v(at), log2_alpha = splat.log2_alpha(u, v);
    if (!(canvas->alive && kLog2AlphaMin <= log2_alpha)) return;
    const float before = canvas->transmittance;
    const float weight = fminf(power_of_two(log2_alpha), kAlphaMax) * before, after = before - weight;
    if (!(kTransmittanceMin <= after)) {
        canvas->alive = false, canvas->end = pair;
        return;
    }
    const float4 rest = batch.rest[i];
    canvas->transmittance = after;
    canvas->red = fmaf(weight, splat.start.z, canvas->red);
    canvas->green = fmaf(weight, splat.start.w, canvas->green);
    canvas->blue = fmaf(weight, rest.x, canvas->blue);
    if (!kDepth) return;
    const float depth = depth_at(rest, u, v), from_origin = depth - depth_origin;
    canvas->depth = fmaf(weight, depth, canvas->depth);
    canvas->depth_square = fmaf(weight, from_origin * from_origin, canvas->depth_square);
    if (kMedianTransmittance < before && after <= kMedianTransmittance)
        canvas->median = fminf(fmaxf(depth, (1.0f - kMedianShiftMax) * rest.y), (1.0f + kMedianShiftMax) * rest.y);
}

template <bool kDepth>
__device__ __forceinline__ void put_pixel(const Job& job, const Place& at, const Canvas& canvas) {
    const float left = canvas.transmittance;
    job.at.transmittance[at.kept] = left;
    job.at.pixel_end[at.kept] = canvas.end;
    if (!at.inside) return;
    const Pictures& out = job.pictures;
    out.colour[3 * at.pixel] = fmaf(left, job.view.background[0], canvas.red);
    out.colour[3 * at.pixel + 1] = fmaf(left, job.view.background[1], canvas.green);
    out.colour[3 * at.pixel + 2] = fmaf(left, job.view.background[2], canvas.blue);
    out.alpha[at.pixel] = 1.0f - left;
    if (!kDepth) return;
    out.depth_sum[at.pixel] = canvas.depth;
    out.depth_square_sum[at.pixel] = canvas.depth_square;
    out.median_depth[at.pixel] = canvas.median;
}

template <bool kDepth>
__device__ __forceinline__ void blend_tile(const Job& job, const TileList& list, Batch<kThreads>* batch) {
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    const Place at = place_of(job.view, list);
    Canvas canvas;
    canvas.alive = at.inside, canvas.end = at.inside ? list.pairs : 0;
    for (int32_t from = 0; from < list.pairs; from += kThreads) {
        if (!__syncthreads_or(canvas.alive)) break;  // also a barrier: the last batch is no longer read
        stage(job, list, from, batch);
        __syncthreads();
        for (int word = 0; word < kWarps && __any_sync(kWholeWarp, canvas.alive); ++word) {
            for (unsigned left = batch->touched[warp][word]; left; left &= left - 1) {
                const int i = word * kWarp + __ffs(static_cast<int>(left)) - 1;
                blend<kDepth>(*batch, i, from + i, at, job.view.depth_origin, &canvas);
            }
        }
    }
    put_pixel<kDepth>(job, at, canvas);
}

// The images of a chunk's tiles; kDepth if depths are rendered.
template <bool kDepth>
__device__ void blend_tiles(const Job& job, int chunk) {
    SPLAT_SHARED(Batch<kThreads>, batch);
    const int first = job.at.chunk_begin[chunk], end = job.at.chunk_begin[chunk + 1];
    for (int tile = first + static_cast<int>(blockIdx.x); tile < end; tile += static_cast<int>(gridDim.x))
        blend_tile<kDepth>(job, list_of(job, first, tile), &batch);
}

}  // namespace cuda
}  // namespace splat
