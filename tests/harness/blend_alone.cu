// The blending of the CUDA backend by itself: the lists that it walks are the test's.
#include "cuda/blend_back.cuh"

using splat::PictureGradients;
using splat::Pictures;
using splat::cuda::Job;
using splat::cuda::kThreads;

namespace {

// A view's pairs in chunks, as the phases before leave them. Those of all chunks in a row, by tile; slots count from 0
// in each chunk.
struct Case {
    int32_t width, height, count, chunks;
    int32_t magnitudes, blocks;
    float depth_origin, background[3];
    splat::cuda::Record* records;
    int32_t* order;        // (count)
    int32_t* chunk_begin;  // (chunks + 1)
    int64_t* tile_begin;   // (tiles + 1)
    uint32_t *slots_of, *owners;
    uint32_t* offsets;  // (chunks, count)
    float* transmittance;
    int32_t* pixel_end;
    float *slots, *sums;
    Pictures pictures;
    PictureGradients gradients;
};

struct ChunkJob {
    Job job;
    splat::cuda::Header header;
};

void prepare(const Case& given, int chunk, ChunkJob* to) {
    *to = {};
    Job& job = to->job;
    const int64_t first = given.tile_begin[given.chunk_begin[chunk]];
    to->header.facts.chunks = given.chunks, to->header.visible = given.count;
    to->header.chunk_pairs = given.tile_begin[given.chunk_begin[chunk + 1]] - first;
    job.view.width = given.width, job.view.height = given.height;
    job.view.tiles_x = (given.width + splat::kTile - 1) / splat::kTile;
    job.view.tiles_y = (given.height + splat::kTile - 1) / splat::kTile;
    job.view.depth_origin = given.depth_origin;
    for (int c = 0; c < 3; ++c) job.view.background[c] = given.background[c];
    job.at.header = &to->header, job.at.records = given.records, job.at.order[0] = given.order;
    job.at.offsets = given.offsets + static_cast<int64_t>(chunk) * given.count;
    job.at.tile_begin = given.tile_begin, job.at.chunk_begin = given.chunk_begin;
    job.at.transmittance = given.transmittance, job.at.pixel_end = given.pixel_end;
    job.at.pair_values[0] = given.slots_of + first, job.at.owners = given.owners + first;
    job.back = {given.slots, given.sums};
    job.pictures = given.pictures, job.gradients = given.gradients;
}

template <bool kDepth>
__global__ void forward(Job job, int chunk) {
    splat::cuda::blend_tiles<kDepth>(job, chunk);
}

template <bool kDepth, bool kMagnitudes>
__global__ void backward(Job job, int chunk) {
    splat::cuda::blend_tiles_back<kDepth, kMagnitudes>(job, chunk);
}

template <bool kDepth>
__global__ void sum(Job job, int chunk) {
    splat::cuda::sum_slots<kDepth>(job, chunk);
}

// Of all pixels in reach of a pair, and of those in a sub-block that is said not to be touched; of sub-blocks said to
// be touched, and of those that are.
struct Counts {
    unsigned met, missed, touched, needed;
};

__global__ void count_sub_blocks(Job job, int tiles, Counts* counts) {
    using namespace splat::cuda;
    using Shared = Batch<kThreads>;
    SPLAT_SHARED(Shared, batch);
    const int warp = static_cast<int>(threadIdx.x) / kWarp;
    for (int tile = static_cast<int>(blockIdx.x); tile < tiles; tile += static_cast<int>(gridDim.x)) {
        const TileList list = list_of(job, 0, tile);
        const Place at = place_of(job.view, list);
        for (int32_t from = 0; from < list.pairs; from += kThreads) {
            __syncthreads();
            stage(job, list, from, &batch);
            __syncthreads();
            for (int i = 0; i < kThreads; ++i) {
                const bool is_pair = from + i < list.pairs;
                const Whitened splat = {batch.shape[i], batch.start[i]};
                const bool met = is_pair && splat::kLog2AlphaMin <= splat.log2_alpha(splat.u(at), splat.v(at));
                const bool touched = batch.touched[warp][i / kWarp] >> (i % kWarp) & 1;
                const bool needed = __any_sync(kWholeWarp, met);
                atomicAdd(&counts->met, met ? 1u : 0u);
                atomicAdd(&counts->missed, met && !touched ? 1u : 0u);
                if (threadIdx.x % kWarp != 0) continue;
                atomicAdd(&counts->touched, touched ? 1u : 0u);
                atomicAdd(&counts->needed, needed ? 1u : 0u);
            }
        }
    }
}

}  // namespace

extern "C" {

SPLAT_API int run_forward(const Case* given) {
    for (int chunk = 0; chunk < given->chunks; ++chunk) {
        ChunkJob it;
        prepare(*given, chunk, &it);
        if (given->pictures.depth_sum)
            SPLAT_LAUNCH(forward<true>, given->blocks, nullptr, it.job, chunk);
        else
            SPLAT_LAUNCH(forward<false>, given->blocks, nullptr, it.job, chunk);
        if (const int code = cudaGetLastError()) return code;
    }
    return 0;
}

SPLAT_API int run_backward(const Case* given) {
    const bool depth = given->gradients.depth_sum || given->gradients.depth_square_sum;
    for (int chunk = 0; chunk < given->chunks; ++chunk) {
        ChunkJob it;
        prepare(*given, chunk, &it);
        const int64_t floats = it.header.chunk_pairs * (depth ? splat::kDepthSlotFloats : splat::kSlotFloats);
        memset(given->slots, 0xff, static_cast<size_t>(floats) * sizeof(float));  // NaN where nobody writes
        if (depth && given->magnitudes)
            SPLAT_LAUNCH((backward<true, true>), given->blocks, nullptr, it.job, chunk);
        else if (depth)
            SPLAT_LAUNCH((backward<true, false>), given->blocks, nullptr, it.job, chunk);
        else if (given->magnitudes)
            SPLAT_LAUNCH((backward<false, true>), given->blocks, nullptr, it.job, chunk);
        else
            SPLAT_LAUNCH((backward<false, false>), given->blocks, nullptr, it.job, chunk);
        if (depth)
            SPLAT_LAUNCH(sum<true>, given->blocks, nullptr, it.job, chunk);
        else
            SPLAT_LAUNCH(sum<false>, given->blocks, nullptr, it.job, chunk);
        if (const int code = cudaGetLastError()) return code;
    }
    return 0;
}

SPLAT_API int run_count(const Case* given, Counts* counts) {
    ChunkJob it;
    prepare(*given, 0, &it);
    *counts = {};
    const int tiles = it.job.view.tiles_x * it.job.view.tiles_y;
    SPLAT_LAUNCH(count_sub_blocks, given->blocks, nullptr, it.job, tiles, counts);
    return cudaGetLastError();
}

}  // extern "C"
