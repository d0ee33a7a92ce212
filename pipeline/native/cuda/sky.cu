// Compositing a render over the sky, which is interpolated bilinearly from nodes some pixels apart.
#include "cuda/api.h"
#include "cuda/stream.h"
#include "cuda/sums.cuh"

namespace splat {
namespace cuda {
namespace {

constexpr int kMostStep = 8;  // maximum node spacing, pixels: each of a node's (2 step - 1)^2 pixels has a thread
static_assert((2 * kMostStep - 1) * (2 * kMostStep - 1) <= kThreads, "a block a node");

struct Colour {
    float of[3];
};

__device__ inline Colour at_node(const float* nodes, const SplatSky& sky, int row, int column) {
    const int i = row < sky.rows ? row : sky.rows - 1, j = column < sky.columns ? column : sky.columns - 1;
    const float* node = nodes + (static_cast<int64_t>(i) * sky.columns + j) * 3;
    return {{node[0], node[1], node[2]}};
}

// The colour behind a pixel, minus the render's background.
__device__ inline Colour added(const SplatSky& sky, int64_t pixel) {
    const int row = static_cast<int>(pixel / sky.width), column = static_cast<int>(pixel % sky.width);
    const float* nodes = sky.elsewhere && !sky.around[pixel] ? sky.elsewhere : sky.nodes;
    const int i = row / sky.step, j = column / sky.step;
    const float down = static_cast<float>(row % sky.step) / static_cast<float>(sky.step);
    const float right = static_cast<float>(column % sky.step) / static_cast<float>(sky.step);
    const Colour a = at_node(nodes, sky, i, j), b = at_node(nodes, sky, i, j + 1);
    const Colour c = at_node(nodes, sky, i + 1, j), d = at_node(nodes, sky, i + 1, j + 1);
    Colour out;
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const float upper = a.of[k] + right * (b.of[k] - a.of[k]), lower = c.of[k] + right * (d.of[k] - c.of[k]);
        out.of[k] = upper + down * (lower - upper) - sky.background[k];
    }
    return out;
}

__global__ void lay_over(const SplatSky sky, float* out) {
    const int64_t pixel = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= static_cast<int64_t>(sky.width) * sky.height) return;
    const Colour behind = added(sky, pixel);
    const float through = 1.0f - sky.alpha[pixel];
#pragma unroll
    for (int k = 0; k < 3; ++k) out[3 * pixel + k] = sky.colour[3 * pixel + k] + through * behind.of[k];
}

__global__ void lay_over_back(const SplatSky sky, const float* upstream, float* alpha_gradient) {
    const int64_t pixel = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (pixel >= static_cast<int64_t>(sky.width) * sky.height) return;
    const Colour behind = added(sky, pixel);
    float sum = 0.0f;
#pragma unroll
    for (int k = 0; k < 3; ++k) sum += upstream[3 * pixel + k] * behind.of[k];
    alpha_gradient[pixel] = -sum;
}

struct NodeShared {
    WarpSums<float> sums;
};

// A node's gradient from the pixels that it contributes to, where the sky is certain. One block per node.
__global__ void add_nodes(const SplatSky sky, const float* upstream, float* node_gradient) {
    SPLAT_SHARED(NodeShared, shared);
    const int side = 2 * sky.step - 1, t = static_cast<int>(threadIdx.x);
    const int down = t / side - (sky.step - 1), right = t % side - (sky.step - 1);
    const int row = static_cast<int>(blockIdx.x) / sky.columns * sky.step + down;
    const int column = static_cast<int>(blockIdx.x) % sky.columns * sky.step + right;
    const int64_t pixel = static_cast<int64_t>(row) * sky.width + column;
    const bool is_pixel = t < side * side && row >= 0 && row < sky.height && column >= 0 && column < sky.width;
    const bool counts = is_pixel && sky.mask[pixel];
    float* gradient = node_gradient + static_cast<int64_t>(blockIdx.x) * 3;
    if (!__syncthreads_or(counts)) {
        if (t < 3) gradient[t] = 0.0f;
        return;
    }
    float weight = 0.0f;
    if (counts) {
        const float step = static_cast<float>(sky.step);
        weight = (1.0f - fabsf(static_cast<float>(down)) / step) * (1.0f - fabsf(static_cast<float>(right)) / step);
        weight *= 1.0f - sky.alpha[pixel];
    }
    for (int k = 0; k < 3; ++k) {
        const float sum = sum_of_block(counts ? weight * upstream[3 * pixel + k] : 0.0f, &shared.sums);
        if (t == 0) gradient[k] = sum;
    }
}

bool is_sound(const SplatSky& sky) {
    const bool reaches = sky.step >= 1 && sky.step <= kMostStep && sky.rows >= 1 && sky.columns >= 1 &&
                         (sky.rows - 1) * sky.step >= sky.height - 1 && (sky.columns - 1) * sky.step >= sky.width - 1;
    return sky.width >= 1 && sky.height >= 1 && reaches && (!sky.elsewhere || sky.around);
}

}  // namespace
}  // namespace cuda
}  // namespace splat

extern "C" {

int32_t splat_sky(const SplatSky* sky, float* out, const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (!is_sound(*sky)) return SPLAT_BAD_ARGUMENT;
    const int64_t pixels = static_cast<int64_t>(sky->width) * sky->height;
    SPLAT_LAUNCH(lay_over, divide_up(pixels, kThreads), stream, *sky, out);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_sky_backward(const SplatSky* sky, const float* upstream, float* alpha_gradient, float* node_gradient,
                           const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (!is_sound(*sky) || (node_gradient && !sky->mask)) return SPLAT_BAD_ARGUMENT;
    const int64_t pixels = static_cast<int64_t>(sky->width) * sky->height;
    SPLAT_LAUNCH(lay_over_back, divide_up(pixels, kThreads), stream, *sky, upstream, alpha_gradient);
    if (node_gradient)
        SPLAT_LAUNCH(add_nodes, static_cast<int64_t>(sky->rows) * sky->columns, stream, *sky, upstream, node_gradient);
    return static_cast<int32_t>(cudaGetLastError());
}

}  // extern "C"
