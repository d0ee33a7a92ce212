// Affine maps of an image's colours, forward and backward; one thread per pixel.
#include "cuda/api.h"
#include "cuda/frame.h"
#include "cuda/stream.h"
#include "cuda/sums.cuh"
#include "loss/colour.h"

namespace splat {
namespace cuda {
namespace {

constexpr int kPixels = 8;  // per thread, backward: amortizes a block's sums
constexpr int64_t kBlockPixels = kPixels * kThreads;

struct Affine {
    float of[kAffine];
};

struct AffineSums {
    float of[kWarps][kAffine];
};

using DoubleSums = WarpSums<double>;

// out = map of in. The map is in device memory because it is trained.
__global__ void map_colours(const float* map, const float* in, int64_t pixels, float* out) {
    const int64_t pixel = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= pixels) return;
    const float red = in[3 * pixel], green = in[3 * pixel + 1], blue = in[3 * pixel + 2];
#pragma unroll
    for (int i = 0; i < 3; ++i) {
        const float* row = map + 4 * i;
        out[3 * pixel + i] = fmaf(row[0], red, fmaf(row[1], green, fmaf(row[2], blue, row[3])));
    }
}

// dL/d(in) by the linear part's transpose, and the block's contribution to dL/d(map).
__global__ void map_colours_back(const float* map, const float* in, const float* upstream, int64_t pixels,
                                 float* gradient, Affine* parts) {
    SPLAT_SHARED(AffineSums, warps);
    Affine sums{};
    for (int k = 0; k < kPixels; ++k) {
        const int64_t pixel = blockIdx.x * kBlockPixels + k * kThreads + threadIdx.x;
        if (pixel >= pixels) break;
        float colour[3], up[3];
#pragma unroll
        for (int i = 0; i < 3; ++i) colour[i] = in[3 * pixel + i], up[i] = upstream[3 * pixel + i];
#pragma unroll
        for (int i = 0; i < 3; ++i) {
            gradient[3 * pixel + i] = fmaf(map[i], up[0], fmaf(map[4 + i], up[1], map[8 + i] * up[2]));
#pragma unroll
            for (int j = 0; j < 3; ++j) sums.of[4 * i + j] = fmaf(up[i], colour[j], sums.of[4 * i + j]);
            sums.of[4 * i + 3] += up[i];
        }
    }
    const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
#pragma unroll
    for (int i = 0; i < kAffine; ++i) {
        const float sum = sum_of_warp(sums.of[i]);
        if (lane == 0) warps.of[warp][i] = sum;
    }
    __syncthreads();
    if (threadIdx.x >= kAffine) return;
    float total = 0.0f;
    for (int other = 0; other < kWarps; ++other) total += warps.of[other][threadIdx.x];
    parts[blockIdx.x].of[threadIdx.x] = total;
}

// Sums the blocks' parts in a fixed order. One block.
__global__ void add_maps(const Affine* parts, int blocks, float* map_gradient) {
    SPLAT_SHARED(DoubleSums, sums);
    for (int k = 0; k < kAffine; ++k) {
        double sum = 0.0;
        for (int i = static_cast<int>(threadIdx.x); i < blocks; i += kThreads)
            sum += static_cast<double>(parts[i].of[k]);
        sum = sum_of_block(sum, &sums);
        if (threadIdx.x == 0) map_gradient[k] = static_cast<float>(sum);
    }
}

}  // namespace
}  // namespace cuda
}  // namespace splat

extern "C" {

int64_t splat_affine_bytes(int64_t pixels) {
    using namespace splat::cuda;
    Carver carver(nullptr);
    carver.take<Affine>(divide_up(pixels, kBlockPixels));
    return carver.bytes();
}

int32_t splat_affine_colour(const float* map, const float* in, int64_t pixels, float* out, const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (pixels < 0) return SPLAT_BAD_ARGUMENT;
    if (pixels == 0) return SPLAT_OK;
    SPLAT_LAUNCH(map_colours, divide_up(pixels, kThreads), stream, map, in, pixels, out);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_affine_colour_backward(const float* map, const float* in, const float* upstream, int64_t pixels,
                                     float* gradient, float* map_gradient, void* memory, int64_t bytes,
                                     const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (pixels <= 0) return SPLAT_BAD_ARGUMENT;
    if (bytes < splat_affine_bytes(pixels)) return SPLAT_TOO_LITTLE;
    const int blocks = static_cast<int>(divide_up(pixels, kBlockPixels));
    Affine* parts = Carver(memory).take<Affine>(blocks);
    SPLAT_LAUNCH(map_colours_back, blocks, stream, map, in, upstream, pixels, gradient, parts);
    SPLAT_LAUNCH(add_maps, 1, stream, parts, blocks, map_gradient);
    return static_cast<int32_t>(cudaGetLastError());
}

}  // extern "C"
