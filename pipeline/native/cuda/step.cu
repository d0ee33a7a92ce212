// From each Gaussian's screen-space gradients to those of its parameters, fused with a step of Adam.
//
// A thread computes a Gaussian's gradients and stages them in shared memory; then the block processes its rows tensor
// by tensor, coalesced. For SH only the basis and the colour's gradient are staged: their product is the gradient. With
// 16 coefficients, a step moves 59 floats and their two moments, in and out: 1,416 bytes per visible Gaussian, 48 of
// gradients, and 192 that come from the cache a second time.
#include "cuda/project.cuh"
#include "cuda/step.cuh"
#include "cuda/stream.h"

namespace splat {
namespace cuda {
namespace {

// A Gaussian's staged gradients.
constexpr int kMeanAt = 0, kLogScaleAt = 3, kQuatAt = 6, kLogitAt = 10, kColourAt = 11, kBasisAt = 14;
constexpr int kPlainFloats = kColourAt;  // gradients of all but spherical harmonics
constexpr int kStagedFloats =
    kBasisAt + lane::kMaxSh + 1;  // odd, to avoid bank conflicts between threads that write their own rows
static_assert(kStagedFloats % 2 == 1, "");

struct Staged {
    float of[kThreads][kStagedFloats];
    uint8_t steps[kThreads];  // whether the Gaussian takes part
};

template <int kDegree>
__device__ __forceinline__ lane::Vec3 stage_colour(const View& view, const Parameters& in, int64_t i,
                                                   const lane::Vec3& mean, lane::Vec3 dcolour, float* staged) {
    constexpr int kCount = (kDegree + 1) * (kDegree + 1);
    float sh[3 * kCount], basis[lane::kMaxSh];
    read_sh<3 * kCount>(sh_row(view, in, i), sh_is_aligned(view, in), sh);
    const lane::Vec3 dmean = lane::colour_backward(view, kDegree, mean, sh, &dcolour, basis);
    staged[kColourAt] = dcolour.x, staged[kColourAt + 1] = dcolour.y, staged[kColourAt + 2] = dcolour.z;
    SPLAT_UNROLL
    for (int k = 0; k < kCount; ++k) staged[kBasisAt + k] = basis[k];
    return dmean;
}

// Each degree apart, so that the coefficients are in registers.
__device__ __forceinline__ lane::Vec3 stage_colour(const View& view, const Parameters& in, int64_t i,
                                                   const lane::Vec3& mean, const lane::Vec3& dcolour, float* staged) {
    switch (view.sh_degree) {
        case 0:
            return stage_colour<0>(view, in, i, mean, dcolour, staged);
        case 1:
            return stage_colour<1>(view, in, i, mean, dcolour, staged);
        case 2:
            return stage_colour<2>(view, in, i, mean, dcolour, staged);
        default:
            return stage_colour<3>(view, in, i, mean, dcolour, staged);
    }
}

template <bool kDepth>
__device__ __forceinline__ lane::SplatGradient read_sums(const Job& job, int64_t i) {
    constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats;
    float sum[kFloats];
    SPLAT_UNROLL
    for (int f = 0; f < kFloats; f += 4) {
        const Four four = *reinterpret_cast<const Four*>(job.back.sums + i * kFloats + f);
        SPLAT_UNROLL
        for (int e = 0; e < 4; ++e) sum[f + e] = four.of[e];
    }
    lane::SplatGradient g;
    g.s = sum[0], g.su = sum[1], g.sv = sum[2], g.suu = sum[3], g.suv = sum[4], g.svv = sum[5];
    g.colour = {sum[6], sum[7], sum[8]};
    g.depth = sum[9], g.size_x = sum[10], g.size_y = sum[11];
    g.depth_u = kDepth ? sum[kDepthSlotFloats - 4] : 0.0f, g.depth_v = kDepth ? sum[kDepthSlotFloats - 3] : 0.0f;
    return g;
}

// The gradients of a Gaussian that is visible, and those of its centre on the screen.
template <bool kDepth>
__device__ __forceinline__ void stage(const Job& job, int64_t i, float* staged, float* mean2d) {
    const lane::SplatGradient g = read_sums<kDepth>(job, i);
    const lane::Lanes lanes = load_lanes(job.model, i);
    const lane::Vec3 through_colour = stage_colour(job.view, job.model, i, lanes.mean, g.colour, staged);
    const lane::Projection p = lane::project_lanes(job.view, lanes);
    const lane::LanesGradient d = lane::project_lanes_backward<kDepth>(job.view, p, g, job.magnitudes != 0);
    staged[kMeanAt] = d.mean.x + through_colour.x, staged[kMeanAt + 1] = d.mean.y + through_colour.y;
    staged[kMeanAt + 2] = d.mean.z + through_colour.z;
    staged[kLogScaleAt] = d.log_scale.x, staged[kLogScaleAt + 1] = d.log_scale.y;
    staged[kLogScaleAt + 2] = d.log_scale.z;
    staged[kQuatAt] = d.qw, staged[kQuatAt + 1] = d.qx, staged[kQuatAt + 2] = d.qy, staged[kQuatAt + 3] = d.qz;
    staged[kLogitAt] = d.logit;
    mean2d[0] = d.mean2d_x, mean2d[1] = d.mean2d_y;
}

__device__ __forceinline__ void stage_zero(float* staged) {
    for (int f = 0; f < kStagedFloats; ++f) staged[f] = 0.0f;
}

__device__ __forceinline__ bool is_visible(const Job& job, int64_t i) { return job.at.rows[i] != 0; }

// dL/d(SH) at a column of a Gaussian's row.
__device__ __forceinline__ float sh_gradient(const float* staged, int column, int count) {
    const int k = column / 3;
    return k < count ? staged[kBasisAt + k] * staged[kColourAt + column - 3 * k] : 0.0f;
}

__device__ __forceinline__ bool is_staged_finite(const float* staged, int sh_count) {
    bool finite = true;
    for (int f = 0; f < kPlainFloats; ++f) finite = finite && is_finite(staged[f]);
    for (int f = 0; f < 3 * sh_count; ++f) finite = finite && is_finite(sh_gradient(staged, f, sh_count));
    return finite;
}

// A block's rows of a gradient.
template <class Gradient>
__device__ __forceinline__ void put_rows(float* out, int width, int rows, const Gradient& gradient) {
    for (int j = threadIdx.x; j < rows * width; j += kThreads) out[j] = gradient(j / width, j % width);
}

__device__ __forceinline__ int rows_of_block(int64_t count, int64_t first) {
    return static_cast<int>(count - first < kThreads ? count - first : kThreads);
}

template <bool kDepth>
__global__ void __launch_bounds__(kThreads, 2) gradient_kernel(const Job job, const SplatRows out, float* means2d) {
    SPLAT_SHARED(Staged, staged);
    const int64_t n = job.model.count;
    const int thread = threadIdx.x, sh_width = 3 * job.view.sh_count;
    const int sh_count = lane::sh_basis_size(job.view.sh_degree);
    for (int64_t first = int64_t{blockIdx.x} * kThreads; first < n; first += int64_t{gridDim.x} * kThreads) {
        const int rows = rows_of_block(n, first);
        if (thread < rows) {
            float mean2d[2] = {0.0f, 0.0f};
            if (is_visible(job, first + thread))
                stage<kDepth>(job, first + thread, staged.of[thread], mean2d);
            else
                stage_zero(staged.of[thread]);
            means2d[2 * (first + thread)] = mean2d[0], means2d[2 * (first + thread) + 1] = mean2d[1];
        }
        __syncthreads();
        const auto plain = [&](int at) { return [&, at](int row, int column) { return staged.of[row][at + column]; }; };
        put_rows(out.means + 3 * first, 3, rows, plain(kMeanAt));
        put_rows(out.log_scales + 3 * first, 3, rows, plain(kLogScaleAt));
        put_rows(out.quats + 4 * first, 4, rows, plain(kQuatAt));
        put_rows(out.opacity_logits + first, 1, rows, plain(kLogitAt));
        put_rows(out.sh + sh_width * first, sh_width, rows,
                 [&](int row, int column) { return sh_gradient(staged.of[row], column, sh_count); });
        __syncthreads();
    }
}

// The other parameters of a step, by value.
struct StepJob {
    int64_t rows;  // the first of the rendered ones
    SplatRows values, means, squares;
    float rates[5], rate_sh_rest;  // with their bias correction
    float beta1, beta2, epsilon, inverse_root_correction;
    float log_scale_min, log_scale_max;
    bool sparse;
    const float* logit_gain;
    int64_t* skipped;
    float* means2d;
};

// Stages the gradients of the thread's Gaussian. Returns whether it takes part in the step.
template <bool kDepth>
__device__ __forceinline__ bool stage_step(const Job& job, const StepJob& step, int64_t i, float* staged) {
    float mean2d[2] = {0.0f, 0.0f};
    bool steps = !step.sparse;
    if (is_visible(job, i)) {
        stage<kDepth>(job, i, staged, mean2d);
        if (step.logit_gain) staged[kLogitAt] *= step.logit_gain[i];
        steps = is_staged_finite(staged, lane::sh_basis_size(job.view.sh_degree));
        if (!steps) count_skipped(step.skipped);
    } else if (steps) {
        stage_zero(staged);
    }
    if (step.means2d) step.means2d[2 * i] = mean2d[0], step.means2d[2 * i + 1] = mean2d[1];
    return steps;
}

__device__ __forceinline__ void step_tensors(const StepJob& step, const Staged& staged, int64_t first, int rows,
                                             const View& view) {
    const lane::AdamConstants c =
        lane::adam_constants(step.beta1, step.beta2, step.epsilon, step.inverse_root_correction);
    const auto plain = [&](int at) { return [&, at](int row, int column) { return staged.of[row][at + column]; }; };
    const auto rate = [&](int tensor) { return [&, tensor](int) { return step.rates[tensor]; }; };
    const auto at = [&](float* SplatRows::* tensor, int width) {
        const int64_t begin = first * width;
        return MomentRows{step.values.*tensor + begin, step.means.*tensor + begin, step.squares.*tensor + begin};
    };
    step_rows(at(&SplatRows::log_scales, 3), 3, rows, staged.steps, c, plain(kLogScaleAt), rate(1));
    step_rows(at(&SplatRows::means, 3), 3, rows, staged.steps, c, plain(kMeanAt), rate(0));
    step_rows(at(&SplatRows::quats, 4), 4, rows, staged.steps, c, plain(kQuatAt), rate(2));
    step_rows(at(&SplatRows::opacity_logits, 1), 1, rows, staged.steps, c, plain(kLogitAt), rate(3));
    const int width = 3 * view.sh_count, count = lane::sh_basis_size(view.sh_degree);
    step_rows(
        at(&SplatRows::sh, width), width, rows, staged.steps, c,
        [&](int row, int column) { return sh_gradient(staged.of[row], column, count); },
        [&](int column) { return column < 3 ? step.rates[4] : step.rate_sh_rest; });
}

// All of these rows, including those not visible: density control may have made them smaller. NaN stays.
__device__ __forceinline__ void clamp_log_scales(const StepJob& step, int64_t first, int rows) {
    float* log_scales = step.values.log_scales + 3 * first;
    for (int j = threadIdx.x; j < 3 * rows; j += kThreads) {
        const float x = log_scales[j];
        if (x < step.log_scale_min) log_scales[j] = step.log_scale_min;
        if (x > step.log_scale_max) log_scales[j] = step.log_scale_max;
    }
}

template <bool kDepth>
__global__ void __launch_bounds__(kThreads, 2) step_kernel(const Job job, const StepJob step) {
    SPLAT_SHARED(Staged, staged);
    const int64_t n = step.rows;
    const int thread = threadIdx.x;
    for (int64_t first = int64_t{blockIdx.x} * kThreads; first < n; first += int64_t{gridDim.x} * kThreads) {
        const int rows = rows_of_block(n, first);
        const bool steps = thread < rows && stage_step<kDepth>(job, step, first + thread, staged.of[thread]);
        staged.steps[thread] = steps;
        if (__syncthreads_or(steps)) step_tensors(step, staged, first, rows, job.view);
        __syncthreads();
        clamp_log_scales(step, first, rows);
    }
}

bool has_all(const SplatRows& rows) {
    return rows.means && rows.log_scales && rows.quats && rows.opacity_logits && rows.sh;
}

int32_t make_step(const SplatStep& step, float* means2d, StepJob* job) {
    if (!has_all(step.values) || !has_all(step.means) || !has_all(step.squares) || !step.skipped)
        return SPLAT_BAD_ARGUMENT;
    if (!are_adam_options({step.beta1, step.beta2, step.epsilon, step.step})) return SPLAT_BAD_ARGUMENT;
    const AdamCorrections corrections = corrections_of(step.beta1, step.beta2, step.step);
    const auto corrected = [&](float rate) { return static_cast<float>(corrections.rate * rate); };
    job->rows = step.rows;
    job->values = step.values, job->means = step.means, job->squares = step.squares;
    for (int t = 0; t < 5; ++t) job->rates[t] = corrected(step.rates[t]);
    job->rate_sh_rest = corrected(step.rate_sh_rest);
    job->beta1 = static_cast<float>(step.beta1), job->beta2 = static_cast<float>(step.beta2);
    job->epsilon = static_cast<float>(step.epsilon), job->inverse_root_correction = corrections.inverse_root;
    job->log_scale_min = step.log_scale_min, job->log_scale_max = step.log_scale_max;
    job->sparse = step.sparse != 0, job->logit_gain = step.logit_gain;
    job->skipped = step.skipped, job->means2d = means2d;
    return SPLAT_OK;
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat;
using namespace splat::cuda;

int32_t splat_project_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                               const SplatRows* gradients, float* means2d, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    Job job;
    const int32_t code = prepare(shot, model, frame, true, &job);
    if (code != SPLAT_OK || job.model.count == 0) return code;
    if (!gradients || !has_all(*gradients) || !means2d) return SPLAT_BAD_ARGUMENT;
    const int64_t blocks = blocks_for(divide_up(job.model.count, kThreads));
    if (job.slot_floats == kDepthSlotFloats)
        SPLAT_LAUNCH(gradient_kernel<true>, blocks, stream, job, *gradients, means2d);
    else
        SPLAT_LAUNCH(gradient_kernel<false>, blocks, stream, job, *gradients, means2d);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_step(const SplatShot* shot, const SplatFrame* frame, const SplatStep* step, float* means2d,
                   const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (!step) return SPLAT_BAD_ARGUMENT;
    SplatRows rendered = step->values;
    if (step->logits) rendered.opacity_logits = const_cast<float*>(step->logits);
    Job job;
    StepJob what;
    int32_t code = prepare(shot, &rendered, frame, true, &job);
    if (code != SPLAT_OK) return code;
    if (step->rows < 0 || step->rows > job.model.count) return SPLAT_BAD_ARGUMENT;
    if (step->rows == 0) return SPLAT_OK;
    code = make_step(*step, means2d, &what);
    if (code != SPLAT_OK) return code;
    const int64_t blocks = blocks_for(divide_up(step->rows, kThreads));
    if (job.slot_floats == kDepthSlotFloats)
        SPLAT_LAUNCH(step_kernel<true>, blocks, stream, job, what);
    else
        SPLAT_LAUNCH(step_kernel<false>, blocks, stream, job, what);
    return static_cast<int32_t>(cudaGetLastError());
}
