// A frame of features: splats that are projected already (activated.cu) to images of any number of channels, and back.
#include <math.h>

#include "cuda/bin.cuh"
#include "cuda/blend_features.cuh"
#include "cuda/blend_features_back.cuh"
#include "cuda/features.h"
#include "cuda/grid.cuh"
#include "cuda/stream.h"
#include "raster/features_math.h"

namespace splat {
namespace cuda {
namespace {

constexpr int kMaxChannels = 1 << 16;
constexpr int kWideBlocks = 3;      // per multiprocessor: 80 registers
constexpr int kWideBackBlocks = 3;  // 80 registers
constexpr int kRestFeatureBlocks = 2;

// The groups' passes backward. The widest ones also do without magnitudes or slants, which are zero then.
template <bool kSlanted, bool kMagnitudes>
using InlineFields = FeatureFields<kInlineChannels, true, kSlanted, kMagnitudes>;
using WideFields = FeatureFields<kWideChannels, true, true, true>;
using MoreFields = FeatureFields<kWideChannels, false, false, false>;

bool is_wide(int channels) { return channels > kInlineChannels; }

__host__ __device__ inline int groups_of(const FeatureJob& features) {
    return features.channels <= kInlineChannels ? 1 : (features.channels + kWideChannels - 1) / kWideChannels;
}

__host__ __device__ inline ChannelGroup group_at(const FeatureJob& features, int number) {
    const int first = number * kWideChannels, left = features.channels - first;
    return {first, left < kWideChannels ? left : kWideChannels};
}

// A thread a splat: its record, rows and key, and its tiles' pairs counted. tile_counts must be zero before.
__global__ void __launch_bounds__(kThreads) place_kernel(const Job job, const FeatureJob features) {
    const int64_t n = job.model.count, i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
    const ScreenSplats& in = features.splats;
    Record record = {};
    uint32_t rows = 0, key = kCulled;
    if (i < n && in.radii[2 * i] > 0) {
        const lane::ScreenSplatLanes at = {
            in.means2d[2 * i],
            in.means2d[2 * i + 1],
            {in.covariances[3 * i], in.covariances[3 * i + 1], in.covariances[3 * i + 2]},
            in.determinants[i],
            in.opacities[i],
            in.slants ? in.slants[2 * i] : 0.0f,
            in.slants ? in.slants[2 * i + 1] : 0.0f};
        const lane::PlacedLanes s = lane::place_on_screen(job.view, at, in.slants != nullptr);
        if (s.drawn) {
            record = {s.x, s.y, s.a, s.b, s.c, s.log2_opacity, 0.0f, 0.0f, 0.0f, 0.0f, s.depth_u, s.depth_v};
            if (features.channels > kInlineChannels) {
                record.red = __uint_as_float(static_cast<uint32_t>(i));
            } else {
                const float* row = in.features + i * features.channels;
                record.red = row[0];
                record.green = features.channels > 1 ? row[1] : 0.0f;
                record.blue = features.channels > 2 ? row[2] : 0.0f;
                record.depth = features.channels > 3 ? row[3] : 0.0f;
            }
            job.at.records[i] = record;
            key = __float_as_uint(in.depths[i]);
            const int first = static_cast<int>(s.first_row), count = static_cast<int>(s.last_row) - first + 1;
            rows = static_cast<uint32_t>(first) << kRowsBits | static_cast<uint32_t>(count);
        }
    }
    if (i < n) job.at.keys[0][i] = key, job.at.rows[i] = rows;
    count_pairs(job, record, rows);
}

template <int kWidth, bool kSlanted>
__global__ void __launch_bounds__(kThreads, kWidth == kInlineChannels ? kBlendBlocks : kWideBlocks)
    blend_features_kernel(const Job job, const FeatureJob features, const ChannelGroup group, int chunk) {
    SPLAT_SHARED(Batch<kThreads>, batch);
    if (is_chunk(job, chunk)) blend_feature_tiles<kWidth, kSlanted>(job, features, group, chunk, &batch);
}

// `only`: as of blend_back_kernel in frame.cu.
template <class Of>
__global__ void __launch_bounds__(kThreads, Of::kWidth == kInlineChannels ? kBlendBlocks : kWideBackBlocks)
    blend_features_back_kernel(const Job job, const FeatureJob features, const ChannelGroup group, int chunk,
                               bool only) {
    using Shared = FeatureBackBatch<Of::kValues>;
    SPLAT_SHARED(Shared, batch);
    if (is_chunk(job, chunk) && !(only && job.at.header->facts.chunks > 1))
        blend_feature_tiles_back<Of>(job, features, group, chunk, &batch);
}

template <class Of>
__global__ void __launch_bounds__(kThreads)
    sum_features_kernel(const Job job, const FeatureJob features, const ChannelGroup group, int chunk, bool only) {
    if (is_chunk(job, chunk) && !(only && job.at.header->facts.chunks > 1))
        sum_feature_slots<Of>(job, features, group, chunk);
}

// What exceeds the forecast, as in frame.cu; slants and magnitudes are zero where there are none.
template <int kWidth>
__global__ void __launch_bounds__(kThreads, kRestFeatureBlocks)
    rest_features_kernel(const __grid_constant__ Job job, const __grid_constant__ FeatureJob features, int first) {
    SPLAT_SHARED(Batch<kThreads>, batch);
    for (int chunk = first; is_chunk(job, chunk); ++chunk) {
        bin_chunk(job, chunk);
        for (int number = 0; number < groups_of(features); ++number)
            blend_feature_tiles<kWidth, true>(job, features, group_at(features, number), chunk, &batch);
        sync_grid();
    }
}

template <class Of>
__global__ void __launch_bounds__(kThreads, kRestFeatureBlocks)
    rest_features_back_kernel(const __grid_constant__ Job job, const __grid_constant__ FeatureJob features, int first) {
    using Shared = FeatureBackBatch<Of::kValues>;
    SPLAT_SHARED(Shared, batch);
    if (job.at.header->facts.chunks == 1) return;
    for (int chunk = first; is_chunk(job, chunk); ++chunk) {
        bin_chunk(job, chunk);
        blend_feature_tiles_back<Of>(job, features, group_at(features, 0), chunk, &batch);
        sync_grid();
        sum_feature_slots<Of>(job, features, group_at(features, 0), chunk);
        sync_grid();
        if constexpr (Of::kWidth == kWideChannels) {
            for (int number = 1; number < groups_of(features); ++number) {
                blend_feature_tiles_back<MoreFields>(job, features, group_at(features, number), chunk, &batch);
                sync_grid();
                sum_feature_slots<MoreFields>(job, features, group_at(features, number), chunk);
                sync_grid();
            }
        }
    }
}

// A thread a splat: from its sums to the gradients of its place, covariance, opacity and slant.
__global__ void __launch_bounds__(kThreads) finish_kernel(const Job job, const FeatureJob features) {
    const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
    if (i >= job.model.count || job.at.rows[i] == 0) return;
    const float* sums = features.sums + i * kSumFloats;
    const ScreenSplats& in = features.splats;
    const ScreenGradients& out = features.out;
    const Record record = job.at.records[i];
    const bool slanted = in.slants;
    const lane::Moments m = {sums[0], sums[1], sums[2], sums[3],        sums[4],
                             sums[5], sums[6], sums[7], sums[kSlantAt], sums[kSlantAt + 1]};
    const lane::PlaceGradient g =
        lane::place_gradient(m, record.a, record.b, record.c, slanted, sums[kLastAt], slanted ? in.slants[2 * i] : 0.0f,
                             slanted ? in.slants[2 * i + 1] : 0.0f);
    out.means2d[2 * i] += g.x, out.means2d[2 * i + 1] += g.y;
    out.covariances[3 * i] += g.xx, out.covariances[3 * i + 1] += g.xy, out.covariances[3 * i + 2] += g.yy;
    out.opacities[i] += m.s / in.opacities[i];
    if (out.magnitudes) out.magnitudes[2 * i] += g.size_x, out.magnitudes[2 * i + 1] += g.size_y;
    if (out.slants) out.slants[2 * i] += g.zx, out.slants[2 * i + 1] += g.zy;
}

template <int kWidth, bool kSlanted>
void launch_groups(const Job& job, const FeatureJob& features, int chunk, cudaStream_t stream) {
    const auto kernel = blend_features_kernel<kWidth, kSlanted>;
    for (int number = 0; number < groups_of(features); ++number)
        SPLAT_LAUNCH(kernel, tile_blocks(job), stream, job, features, group_at(features, number), chunk);
}

void launch_chunks(const Job& job, const FeatureJob& features, int passes, cudaStream_t stream) {
    for (int chunk = 0; chunk < passes; ++chunk) {
        launch_bin(job, {chunk, false}, stream);
        if (is_wide(features.channels))
            launch_groups<kWideChannels, true>(job, features, chunk, stream);
        else if (features.splats.slants)
            launch_groups<kInlineChannels, true>(job, features, chunk, stream);
        else
            launch_groups<kInlineChannels, false>(job, features, chunk, stream);
    }
    const auto rest =
        is_wide(features.channels) ? rest_features_kernel<kWideChannels> : rest_features_kernel<kInlineChannels>;
    SPLAT_LAUNCH_TOGETHER(rest, blocks_together(rest), stream, job, features, passes);
}

template <class Of>
void launch_group_back(const Job& job, const FeatureJob& features, int number, int chunk, bool only,
                       cudaStream_t stream) {
    const int64_t ranks = blocks_for(divide_up(job.model.count, kThreads / Of::kThreadsASlot));
    const ChannelGroup group = group_at(features, number);
    SPLAT_LAUNCH(blend_features_back_kernel<Of>, tile_blocks(job), stream, job, features, group, chunk, only);
    SPLAT_LAUNCH(sum_features_kernel<Of>, ranks, stream, job, features, group, chunk, only);
}

// If one chunk is forecast, nothing bins it again: any further chunks belong to the rest.
template <class Of, class Rest>
void launch_chunks_back(const Job& job, const FeatureJob& features, int passes, cudaStream_t stream) {
    const bool only = passes == 1;
    for (int chunk = 0; chunk < passes; ++chunk) {
        if (!only) launch_bin(job, {chunk, true}, stream);
        launch_group_back<Of>(job, features, 0, chunk, only, stream);
        for (int number = 1; number < groups_of(features); ++number)
            launch_group_back<MoreFields>(job, features, number, chunk, only, stream);
    }
    const auto rest = rest_features_back_kernel<Rest>;
    SPLAT_LAUNCH_TOGETHER(rest, blocks_together(rest), stream, job, features, only ? 0 : passes);
}

// Slots, then sums; returns their size.
int64_t lay_out_back(void* memory, int64_t count, int64_t capacity, int channels, FeatureJob* features) {
    constexpr int kInlineValues = InlineFields<true, true>::kValues, kWideValues = WideFields::kValues;
    Carver carver(memory);
    features->slots = carver.take<float>(capacity * (is_wide(channels) ? kWideValues : kInlineValues));
    features->sums = carver.take<float>(count * kSumFloats);
    return carver.bytes();
}

bool are_features(const SplatFeatures& in, int64_t count) {
    if (in.channels < 1 || in.channels > kMaxChannels || !(in.alpha_max > 0.0f && in.alpha_max < 1.0f)) return false;
    const int stride = is_wide(in.channels) ? (in.channels + 3) / 4 * 4 : in.channels;
    if (in.stride != stride) return false;
    if (count == 0) return true;
    if (is_wide(in.channels) && reinterpret_cast<uintptr_t>(in.features) % sizeof(Four) != 0) return false;
    return in.means2d && in.depths && in.covariances && in.determinants && in.opacities && in.radii && in.features;
}

int32_t prepare(const SplatShot* shot, const SplatFeatures* in, const SplatFrame* frame, Job* job,
                FeatureJob* features) {
    *features = FeatureJob{};
    if (!in || !frame || !are_features(*in, frame->count)) return SPLAT_BAD_ARGUMENT;
    if (const int32_t code = prepare(shot, frame, job)) return code;
    features->splats = {frame->count,  in->means2d,  in->depths, in->covariances, in->determinants,
                        in->opacities, in->features, in->slants, in->radii};
    features->channels = in->channels, features->stride = in->stride;
    features->alpha_max = in->alpha_max, features->log2_alpha_max = log2f(in->alpha_max);
    features->background = in->background;
    features->pixels = int64_t{job->view.width} * job->view.height;
    return SPLAT_OK;
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat::cuda;

static_assert(SPLAT_INLINE_CHANNELS == splat::kInlineChannels, "");

int64_t splat_feature_back_bytes(const SplatShot* shot, int64_t count, int64_t capacity, int32_t channels) {
    if (splat_frame_bytes(shot, count, capacity) < 0 || channels < 1 || channels > kMaxChannels)
        return SPLAT_BAD_ARGUMENT;
    FeatureJob features;
    return lay_out_back(nullptr, count, capacity, channels, &features);
}

int32_t splat_blend_features(const SplatShot* shot, const SplatFeatures* given, const SplatFrame* frame,
                             const SplatFeaturePictures* pictures, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    Job job;
    FeatureJob features;
    if (const int32_t code = prepare(shot, given, frame, &job, &features)) return code;
    if (!pictures || !pictures->features || !pictures->alpha) return SPLAT_BAD_ARGUMENT;
    features.pictures = {pictures->features, pictures->alpha};
    clear_counts(job, stream);
    if (frame->count) SPLAT_LAUNCH(place_kernel, divide_up(frame->count, kThreads), stream, job, features);
    launch_plan(job, stream);
    launch_chunks(job, features, passes_of(job, *frame), stream);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_blend_features_backward(const SplatShot* shot, const SplatFeatures* given, const SplatFrame* frame,
                                      const SplatFeaturePictureGradients* gradients, const SplatFeatureGradients* out,
                                      const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    Job job;
    FeatureJob features;
    if (const int32_t code = prepare(shot, given, frame, &job, &features)) return code;
    if (!gradients || !out || !out->slants != !given->slants) return SPLAT_BAD_ARGUMENT;
    if (frame->count == 0) return SPLAT_OK;
    if (!out->means2d || !out->covariances || !out->opacities || !out->features) return SPLAT_BAD_ARGUMENT;
    if (!frame->back || reinterpret_cast<uintptr_t>(frame->back) % 256 != 0) return SPLAT_BAD_ARGUMENT;
    if (lay_out_back(frame->back, frame->count, frame->capacity, features.channels, &features) > frame->back_bytes)
        return SPLAT_TOO_LITTLE;
    features.by = {gradients->features, gradients->alpha};
    features.out = {out->means2d, out->covariances, out->opacities, out->features, out->slants, out->magnitudes};
    const auto bytes = static_cast<size_t>(frame->count) * kSumFloats * sizeof(float);
    cudaMemsetAsync(features.sums, 0, bytes, stream);
    const int passes = passes_of(job, *frame);
    const bool slanted = given->slants, magnitudes = out->magnitudes;
    using Rest = InlineFields<true, true>;
    if (is_wide(features.channels))
        launch_chunks_back<WideFields, WideFields>(job, features, passes, stream);
    else if (slanted && magnitudes)
        launch_chunks_back<InlineFields<true, true>, Rest>(job, features, passes, stream);
    else if (slanted)
        launch_chunks_back<InlineFields<true, false>, Rest>(job, features, passes, stream);
    else if (magnitudes)
        launch_chunks_back<InlineFields<false, true>, Rest>(job, features, passes, stream);
    else
        launch_chunks_back<InlineFields<false, false>, Rest>(job, features, passes, stream);
    SPLAT_LAUNCH(finish_kernel, divide_up(frame->count, kThreads), stream, job, features);
    return static_cast<int32_t>(cudaGetLastError());
}
