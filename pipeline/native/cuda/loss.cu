// The photometric loss and its gradient, by the formulas of loss_math.h: a kernel from the pictures to the gradient's
// three maps and the sums, one block that adds the sums up, and a kernel from the maps to the gradient.
//
// Each block processes a tile of the image. Each blur goes down the columns first, from global memory with the sums of
// a thread's rows in registers, then along the rows through shared memory. RGB stays interleaved: a row's taps are 3
// floats apart.
#include "cuda/api.h"
#include "cuda/frame.h"
#include "cuda/stream.h"
#include "cuda/sums.cuh"
#include "loss/loss_math.h"

namespace splat {
namespace cuda {
namespace {

constexpr int kRadius = kLossRadius, kTaps = kLossTaps, kChannels = 3;
constexpr int kTileRows = 16, kTileCols = 32;                   // pixels
constexpr int kRowFloats = kTileCols * kChannels;               // of the tile
constexpr int kReach = (kTileCols + 2 * kRadius) * kChannels;   // floats of a row that the tile's windows see
constexpr int kColumnThreads = 128;                             // a thread a column, in as many groups as there are
constexpr int kRows = kTileRows / (kThreads / kColumnThreads);  // of a thread
constexpr int kValues = kTileRows * kRowFloats;
static_assert(kReach <= kColumnThreads && kTileRows % (kThreads / kColumnThreads) == 0, "all columns have a thread");

// A tile's contribution.
struct LossPart {
    float l1, dissimilarity;
    int counting;
};

struct LossScales {
    float l1, ssim;  // (1 - w) and w, over 3 counting pixels
};

struct LossJob {
    const float *render, *photo;
    const uint8_t* mask;  // null: every pixel counts
    int width, height;
    SplatRectangle inner;  // what counts; windows look at everything
    int tiles_x, tiles;
    float taps[kRadius + 1];
    float* maps;  // a, b_u, b_v: (3, height, width, 3)
    LossPart* parts;
    LossScales* scales;
    float* gradient;
};

struct Tile {
    int row0, col0;
};

__device__ Tile tile_of(const LossJob& job, int64_t block) {
    return {static_cast<int>(block) / job.tiles_x * kTileRows, static_cast<int>(block) % job.tiles_x * kTileCols};
}

// Values of a tile's rows, including the reach of its windows left and right.
template <int kPlanes>
struct Blurred {
    float of[kPlanes][kTileRows][kReach];
};

__device__ inline bool is_masked(const LossJob& job, int64_t pixel) { return job.mask && !job.mask[pixel]; }

// A pixel's value of a channel in both images; where the pixel does not count, the render takes the photo's.
struct Pair {
    float render, photo;
};

__device__ inline Pair pair_at(const LossJob& job, int row, int col, int channel) {
    const int64_t pixel = static_cast<int64_t>(row) * job.width + col, at = pixel * kChannels + channel;
    const float photo = job.photo[at];
    return {is_masked(job, pixel) ? photo : job.render[at], photo};
}

__device__ inline bool is_inner(const LossJob& job, int row, int col) {
    return col >= job.inner.left && col < job.inner.right && row >= job.inner.top && row < job.inner.bottom;
}

// Windowed sums down the columns of u, u^2, v, v^2; the image is mirrored at its border.
__device__ void blur_pictures(const LossJob& job, const Tile& tile, Blurred<4>* out) {
    const int column = static_cast<int>(threadIdx.x) % kColumnThreads;
    const int first = static_cast<int>(threadIdx.x) / kColumnThreads * kRows;
    if (column >= kReach) return;
    const int channel = column % kChannels;
    const int col = reflected(tile.col0 - kRadius + column / kChannels, job.width);
    float sums[4][kRows] = {};
#pragma unroll
    for (int i = 0; i < kRows + 2 * kRadius; ++i) {
        const Pair x = pair_at(job, reflected(tile.row0 + first + i - kRadius, job.height), col, channel);
        const float u = x.render + x.photo - 1.0f, v = x.render - x.photo;
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
            const int k = i - r - kRadius, distance = k < 0 ? -k : k;
            if (distance > kRadius) continue;
            const float tap = job.taps[distance];
            sums[0][r] += tap * u;
            sums[1][r] += tap * (u * u);
            sums[2][r] += tap * v;
            sums[3][r] += tap * (v * v);
        }
    }
#pragma unroll
    for (int plane = 0; plane < 4; ++plane)
#pragma unroll
        for (int r = 0; r < kRows; ++r) out->of[plane][first + r][column] = sums[plane][r];
}

// Along the row: the windowed sum centred kRadius pixels after p.
__device__ inline float blur_along(const float* p, const float* taps) {
    float sum = taps[0] * p[kRadius * kChannels];
#pragma unroll
    for (int d = 1; d <= kRadius; ++d) sum += taps[d] * (p[(kRadius - d) * kChannels] + p[(kRadius + d) * kChannels]);
    return sum;
}

struct MapsShared {
    Blurred<4> means;
    WarpSums<float> sums;
    WarpSums<int> counts;
};

// The three maps, and each tile's part of the sums. One block per tile.
__global__ void __launch_bounds__(kThreads, 3) make_maps(const LossJob job) {
    SPLAT_SHARED(MapsShared, shared);
    const Tile tile = tile_of(job, blockIdx.x);
    blur_pictures(job, tile, &shared.means);
    __syncthreads();
    const int64_t plane = static_cast<int64_t>(job.height) * job.width * kChannels;
    LossPart part{0.0f, 0.0f, 0};
    for (int i = static_cast<int>(threadIdx.x); i < kValues; i += kThreads) {
        const int r = i / kRowFloats, j = i % kRowFloats, channel = j % kChannels;
        const int row = tile.row0 + r, col = tile.col0 + j / kChannels;
        if (row >= job.height || col >= job.width) continue;
        float a, b_u, b_v;
        const float dissimilarity = dissimilarity_of(blur_along(&shared.means.of[0][r][j], job.taps),
                                                     blur_along(&shared.means.of[1][r][j], job.taps),
                                                     blur_along(&shared.means.of[2][r][j], job.taps),
                                                     blur_along(&shared.means.of[3][r][j], job.taps), &a, &b_u, &b_v);
        const int64_t pixel = static_cast<int64_t>(row) * job.width + col;
        const bool counts_here = is_inner(job, row, col) && !is_masked(job, pixel);
        if (counts_here) {
            const Pair x = pair_at(job, row, col, channel);
            part.l1 += fabsf(x.render - x.photo);
            part.dissimilarity += dissimilarity;
            part.counting += channel == 0;
        }
        float* maps = job.maps + pixel * kChannels + channel;
        maps[0] = counts_here ? a : 0.0f;
        maps[plane] = counts_here ? b_u : 0.0f;
        maps[2 * plane] = counts_here ? b_v : 0.0f;
    }
    part.l1 = sum_of_block(part.l1, &shared.sums);
    part.dissimilarity = sum_of_block(part.dissimilarity, &shared.sums);
    part.counting = sum_of_block(part.counting, &shared.counts);
    if (threadIdx.x == 0) job.parts[blockIdx.x] = part;
}

using DoubleSums = WarpSums<double>;

// Sums the tiles' parts in a fixed order: the loss, and the scale of the gradient. One block.
__global__ void add_parts(const LossJob job, double ssim_weight, double* value) {
    SPLAT_SHARED(DoubleSums, sums);
    double l1 = 0.0, dissimilarity = 0.0, counting = 0.0;
    for (int i = static_cast<int>(threadIdx.x); i < job.tiles; i += kThreads) {
        l1 += static_cast<double>(job.parts[i].l1);
        dissimilarity += static_cast<double>(job.parts[i].dissimilarity);
        counting += job.parts[i].counting;
    }
    l1 = sum_of_block(l1, &sums);
    dissimilarity = sum_of_block(dissimilarity, &sums);
    counting = sum_of_block(counting, &sums);
    if (threadIdx.x != 0) return;
    const double each = counting > 0.0 ? 1.0 / (3.0 * counting) : 0.0;
    *value = each * ((1.0 - ssim_weight) * l1 + ssim_weight * dissimilarity);
    *job.scales = {static_cast<float>((1.0 - ssim_weight) * each), static_cast<float>(ssim_weight * each)};
}

struct GradientShared {
    Blurred<3> maps;
    float taps[kRadius + 1];  // local, because indexing a kernel's arguments at run time would copy them
};

// The maps' transposed blur down the columns; kInside: away from the image's upper and lower border.
template <bool kInside>
__device__ void blur_maps(const LossJob& job, const Tile& tile, GradientShared* shared) {
    const int column = static_cast<int>(threadIdx.x) % kColumnThreads;
    const int first = static_cast<int>(threadIdx.x) / kColumnThreads * kRows;
    if (column >= kReach) return;
    const int col = tile.col0 - kRadius + column / kChannels;
    const bool is_column = col >= 0 && col < job.width;
    const int64_t plane = static_cast<int64_t>(job.height) * job.width * kChannels;
    float sums[3][kRows] = {};
#pragma unroll
    for (int i = 0; i < kRows + 2 * kRadius; ++i) {
        const int from = tile.row0 + first + i - kRadius;
        float map[3] = {0.0f, 0.0f, 0.0f};
        if (is_column && (kInside || (from >= 0 && from < job.height))) {
            const float* maps = job.maps + (static_cast<int64_t>(from) * job.width + col) * kChannels;
            for (int p = 0; p < 3; ++p) map[p] = maps[p * plane + column % kChannels];
        }
#pragma unroll
        for (int r = 0; r < kRows; ++r) {
            const int k = i - r - kRadius, distance = k < 0 ? -k : k;
            if (distance > kRadius) continue;
            const float tap =
                kInside ? job.taps[distance] : transposed_tap(shared->taps, tile.row0 + first + r, from, job.height);
            sums[0][r] += tap * map[0];
            sums[1][r] += tap * map[1];
            sums[2][r] += tap * map[2];
        }
    }
#pragma unroll
    for (int p = 0; p < 3; ++p)
#pragma unroll
        for (int r = 0; r < kRows; ++r) shared->maps.of[p][first + r][column] = sums[p][r];
}

// The same along the row, near its ends too. p: from kRadius pixels before the column.
__device__ inline float blur_back_along(const LossJob& job, const float* taps, const float* p, int col) {
    if (col >= kLossBorder && col < job.width - kLossBorder) return blur_along(p, job.taps);
    float sum = 0.0f;
    for (int k = 0; k < kTaps; ++k) sum += transposed_tap(taps, col, col + k - kRadius, job.width) * p[k * kChannels];
    return sum;
}

// From the maps to the gradient. One block per tile.
__global__ void __launch_bounds__(kThreads, 4) make_gradient(const LossJob job) {
    SPLAT_SHARED(GradientShared, shared);
    if (threadIdx.x == 0)
        for (int d = 0; d <= kRadius; ++d) shared.taps[d] = job.taps[d];
    __syncthreads();
    const Tile tile = tile_of(job, blockIdx.x);
    if (tile.row0 >= kLossBorder && tile.row0 + kTileRows <= job.height - kLossBorder)
        blur_maps<true>(job, tile, &shared);
    else
        blur_maps<false>(job, tile, &shared);
    __syncthreads();
    const LossScales scales = *job.scales;
    for (int i = static_cast<int>(threadIdx.x); i < kValues; i += kThreads) {
        const int r = i / kRowFloats, j = i % kRowFloats, channel = j % kChannels;
        const int row = tile.row0 + r, col = tile.col0 + j / kChannels;
        if (row >= job.height || col >= job.width) continue;
        const int64_t pixel = static_cast<int64_t>(row) * job.width + col;
        const Pair x = pair_at(job, row, col, channel);
        const float u = x.render + x.photo - 1.0f, v = x.render - x.photo;
        const float sign = v > 0.0f ? 1.0f : (v < 0.0f ? -1.0f : 0.0f);
        const float a = blur_back_along(job, shared.taps, &shared.maps.of[0][r][j], col);
        const float b_u = blur_back_along(job, shared.taps, &shared.maps.of[1][r][j], col);
        const float b_v = blur_back_along(job, shared.taps, &shared.maps.of[2][r][j], col);
        const float l1 = is_inner(job, row, col) ? scales.l1 : 0.0f;
        const float gradient = l1 * sign + scales.ssim * (a + 2.0f * (u * b_u + v * b_v));
        job.gradient[pixel * kChannels + channel] = is_masked(job, pixel) ? 0.0f : gradient;
    }
}

bool is_part(const SplatRectangle& part, int width, int height) {
    return part.left >= 0 && part.left < part.right && part.right <= width && part.top >= 0 && part.top < part.bottom &&
           part.bottom <= height;
}

int64_t lay_out_loss(void* memory, int width, int height, LossJob* job) {
    Carver carver(memory);
    job->tiles_x = static_cast<int>(divide_up(width, kTileCols));
    job->tiles = job->tiles_x * static_cast<int>(divide_up(height, kTileRows));
    job->maps = carver.take<float>(int64_t{3} * kChannels * width * height);
    job->parts = carver.take<LossPart>(job->tiles);
    job->scales = carver.take<LossScales>(1);
    return carver.bytes();
}

}  // namespace
}  // namespace cuda
}  // namespace splat

extern "C" {

int64_t splat_loss_bytes(int32_t width, int32_t height) {
    splat::cuda::LossJob job{};
    return splat::cuda::lay_out_loss(nullptr, width, height, &job);
}

int32_t splat_photo_loss(const float* render, const float* photo, const uint8_t* mask, int32_t width, int32_t height,
                         const SplatRectangle* inner, double ssim_weight, float* gradient, double* value, void* memory,
                         int64_t bytes, const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (width < splat::kLossMinSide || height < splat::kLossMinSide) return SPLAT_BAD_ARGUMENT;
    LossJob job{};
    if (bytes < lay_out_loss(memory, width, height, &job)) return SPLAT_TOO_LITTLE;
    job.render = render, job.photo = photo, job.mask = mask, job.gradient = gradient;
    job.width = width, job.height = height;
    job.inner = inner ? *inner : SplatRectangle{0, 0, width, height};
    if (!is_part(job.inner, width, height)) return SPLAT_BAD_ARGUMENT;
    splat::set_loss_taps(job.taps);
    SPLAT_LAUNCH(make_maps, job.tiles, stream, job);
    SPLAT_LAUNCH(add_parts, 1, stream, job, ssim_weight, value);
    SPLAT_LAUNCH(make_gradient, job.tiles, stream, job);
    return static_cast<int32_t>(cudaGetLastError());
}

}  // extern "C"
