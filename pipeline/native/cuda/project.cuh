// The first phase of a frame: project every Gaussian to the screen, and count each tile's pairs.
#pragma once

#include "cuda/four.cuh"
#include "cuda/frame.h"
#include "raster/splat_math.h"

namespace splat {
namespace cuda {
namespace {

// A thread counts a splat's pairs in up to this many tile rows, its warp does for more. Nearly all splats have fewer.
constexpr int kRowsAThread = 8;

constexpr int kRowsBits = 16;  // of FrameMemory::rows, for the number of rows
constexpr uint32_t kRowsMask = (1u << kRowsBits) - 1;

// The whole splat. Rounds identically wherever it is inlined, like find_span: counting and writing of pairs must agree.
__device__ __forceinline__ Splat expand(const Record& r) {
    Splat s;
    s.x = r.x, s.y = r.y, s.a = r.a, s.b = r.b, s.c = r.c;
    s.log2_opacity = r.log2_opacity;
    s.colour[0] = r.red, s.colour[1] = r.green, s.colour[2] = r.blue;
    s.depth = r.depth;
    s.slope = -r.b / r.a, s.inv_a = 1.0f / r.a;
    s.reach = __fsub_rn(r.log2_opacity, kLog2AlphaMin);  // not fused with what the logarithm ends with
    s.rows_dy = -lane::root(s.reach) * r.b / (r.c * sqrtf(lane::fused(r.b, r.b, r.c * r.c)));
    s.depth_u = r.depth_u, s.depth_v = r.depth_v;
    return s;
}

// The first floats of a row of spherical harmonics.
template <int kFloats>
__device__ __forceinline__ void read_sh(const float* row, bool aligned, float* sh) {
    constexpr int kFours = kFloats / 4 * 4;
    if (aligned) {
        SPLAT_UNROLL
        for (int f = 0; f < kFours; f += 4) {
            const Four four = *reinterpret_cast<const Four*>(row + f);
            SPLAT_UNROLL
            for (int i = 0; i < 4; ++i) sh[f + i] = four.of[i];
        }
    } else {
        SPLAT_UNROLL
        for (int f = 0; f < kFours; ++f) sh[f] = row[f];
    }
    SPLAT_UNROLL
    for (int f = kFours; f < kFloats; ++f) sh[f] = row[f];
}

__device__ __forceinline__ const float* sh_row(const View& view, const Parameters& in, int64_t i) {
    return in.sh + i * view.sh_count * 3;
}

// Whether all rows of spherical harmonics begin at multiples of sixteen bytes.
__device__ __forceinline__ bool sh_is_aligned(const View& view, const Parameters& in) {
    return view.sh_count * 3 % 4 == 0 && is_aligned(in.sh);
}

__device__ __forceinline__ lane::Lanes load_lanes(const Parameters& in, int64_t i) {
    lane::Lanes lanes;
    const float *mean = in.means + 3 * i, *log_scale = in.log_scales + 3 * i, *quat = in.quats + 4 * i;
    lanes.mean = {mean[0], mean[1], mean[2]};
    lanes.log_scale = {log_scale[0], log_scale[1], log_scale[2]};
    lanes.qw = quat[0], lanes.qx = quat[1], lanes.qy = quat[2], lanes.qz = quat[3];
    lanes.logit = in.opacity_logits[i];
    return lanes;
}

template <int kDegree>
__device__ __forceinline__ lane::Vec3 colour_at(const View& view, const float* row, bool aligned,
                                                const lane::Vec3& dir) {
    float sh[3 * (kDegree + 1) * (kDegree + 1)], basis[lane::kMaxSh];
    read_sh<3 * (kDegree + 1) * (kDegree + 1)>(row, aligned, sh);
    return lane::colour_of(kDegree, sh, dir, basis);
}

// One specialization per degree, so that the coefficients are in registers.
__device__ __forceinline__ lane::Vec3 colour_of(const View& view, const Parameters& in, int64_t i,
                                                const lane::Vec3& mean) {
    float inv_length;
    const lane::Vec3 dir = lane::direction(view, mean, &inv_length);
    const float* row = sh_row(view, in, i);
    const bool aligned = sh_is_aligned(view, in);
    switch (view.sh_degree) {
        case 0:
            return colour_at<0>(view, row, aligned, dir);
        case 1:
            return colour_at<1>(view, row, aligned, dir);
        case 2:
            return colour_at<2>(view, row, aligned, dir);
        default:
            return colour_at<3>(view, row, aligned, dir);
    }
}

// Writes all of a Gaussian but its pairs. Returns its tile rows as FrameMemory::rows has them.
__device__ __forceinline__ uint32_t project_one(const Job& job, int64_t i, Record* record) {
    const View& view = job.view;
    const lane::Lanes lanes = load_lanes(job.model, i);
    const lane::Projection p = lane::project_lanes(view, lanes);
    uint32_t rows = 0, key = kCulled;
    float radius = 0.0f;
    // Whether it is in the image is known without its colour, which is most of the data to read.
    if (p.usable && lane::make_splats(view, p, {0.0f, 0.0f, 0.0f}).visible) {
        const lane::SplatLanes s = lane::make_splats(view, p, colour_of(view, job.model, i, lanes.mean));
        if (s.visible) {
            *record = {s.x,        s.y,        s.a,        s.b,     s.c,       s.log2_opacity,
                       s.colour.x, s.colour.y, s.colour.z, s.depth, s.depth_u, s.depth_v};
            job.at.records[i] = *record;
            key = __float_as_uint(s.depth), radius = s.radius;
            const int first = static_cast<int>(s.first_row), count = static_cast<int>(s.last_row) - first + 1;
            rows = static_cast<uint32_t>(first) << kRowsBits | static_cast<uint32_t>(count);
        }
    }
    job.at.keys[0][i] = key, job.at.rows[i] = rows;
    job.radii[i] = radius, job.visible[i] = key != kCulled;
    return rows;
}

__device__ __forceinline__ void count_row(const Job& job, const Splat& splat, int row, float half_y) {
    const Span span = lane::find_span(job.view, splat, row, half_y);
    if (span.first >= span.last) return;
    int32_t* counts = job.at.tile_counts + static_cast<int64_t>(row) * job.view.tiles_x;
    atomicAdd(counts + span.first, 1);
    atomicAdd(counts + span.last, -1);
}

// The pairs of a warp's splats to the tiles' counts.
__device__ __forceinline__ void count_pairs(const Job& job, Record record, uint32_t rows) {
    const int lane = threadIdx.x % kWarp;
    const bool is_tall = (rows & kRowsMask) > kRowsAThread;
    if (!is_tall && (rows & kRowsMask)) {
        const Splat splat = expand(record);
        const float half_y = lane::half_height(splat);
        const int first = static_cast<int>(rows >> kRowsBits), end = first + static_cast<int>(rows & kRowsMask);
        for (int row = first; row < end; ++row) count_row(job, splat, row, half_y);
    }
    for (unsigned tall = __ballot_sync(kWholeWarp, is_tall); tall; tall &= tall - 1) {
        const int from = __ffs(static_cast<int>(tall)) - 1;
        const uint32_t its_rows = __shfl_sync(kWholeWarp, rows, from);
        Record its = {};
        its.x = __shfl_sync(kWholeWarp, record.x, from), its.y = __shfl_sync(kWholeWarp, record.y, from);
        its.a = __shfl_sync(kWholeWarp, record.a, from), its.b = __shfl_sync(kWholeWarp, record.b, from);
        its.c = __shfl_sync(kWholeWarp, record.c, from);
        its.log2_opacity = __shfl_sync(kWholeWarp, record.log2_opacity, from);
        const Splat splat = expand(its);
        const float half_y = lane::half_height(splat);
        const int first = static_cast<int>(its_rows >> kRowsBits), end = first + static_cast<int>(its_rows & kRowsMask);
        for (int row = first + lane; row < end; row += kWarp) count_row(job, splat, row, half_y);
    }
}

// A thread a Gaussian. tile_counts must be zero before.
__device__ __forceinline__ void project_phase(const Job& job) {
    const int64_t n = job.model.count;
    for (int64_t first = int64_t{blockIdx.x} * kThreads; first < n; first += int64_t{gridDim.x} * kThreads) {
        const int64_t i = first + threadIdx.x;
        Record record = {};
        const uint32_t rows = i < n ? project_one(job, i, &record) : 0;
        count_pairs(job, record, rows);
    }
}

}  // namespace
}  // namespace cuda
}  // namespace splat
