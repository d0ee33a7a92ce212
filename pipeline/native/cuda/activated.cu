// Activated Gaussians to the screen and back, and spherical harmonics to colours and back: steps of the entry that
// takes plain features (features.cu). One thread per Gaussian.
#include "cuda/frame.h"
#include "cuda/project.cuh"
#include "cuda/stream.h"
#include "raster/features_math.h"
#include "raster/view.h"

namespace splat {
namespace cuda {
namespace {

// The values of a row, for each thread that has one.
__device__ __forceinline__ lane::Vec3 vec3_at(const float* rows, int64_t i) {
    return {rows[3 * i], rows[3 * i + 1], rows[3 * i + 2]};
}

__device__ __forceinline__ float value_at(const float* rows, int width, int64_t i, int k) {
    return rows ? rows[width * i + k] : 0.0f;
}

__device__ __forceinline__ lane::ActivatedLanes load_activated(const ActivatedGaussians& in, int64_t i) {
    const float* quat = in.quats + 4 * i;
    return {vec3_at(in.means, i), vec3_at(in.scales, i), {quat[0], quat[1], quat[2], quat[3]}};
}

__global__ void __launch_bounds__(kThreads)
    project_activated(const View view, const ProjectOptions options, const ActivatedGaussians in, const Projected out) {
    const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
    if (i >= in.count) return;
    const lane::ProjectedLanes p =
        lane::project_to_screen(view, options, load_activated(in, i), in.opacities[i], out.compensations != nullptr);
    const bool seen = p.seen;
    out.means2d[2 * i] = seen ? p.x : 0.0f, out.means2d[2 * i + 1] = seen ? p.y : 0.0f;
    out.depths[i] = seen ? p.depth : 0.0f;
    out.covariances[3 * i] = seen ? p.xx : 0.0f, out.covariances[3 * i + 1] = seen ? p.xy : 0.0f;
    out.covariances[3 * i + 2] = seen ? p.yy : 0.0f;
    out.determinants[i] = seen ? p.determinant : 0.0f;
    if (out.compensations) out.compensations[i] = seen ? p.compensation : 0.0f;
    if (out.slants) out.slants[2 * i] = seen ? p.zx : 0.0f, out.slants[2 * i + 1] = seen ? p.zy : 0.0f;
    out.radii[2 * i] = seen ? static_cast<int32_t>(p.radius_x) : 0;
    out.radii[2 * i + 1] = seen ? static_cast<int32_t>(p.radius_y) : 0;
}

__device__ __forceinline__ void add_vec3(float* rows, int64_t i, const lane::Vec3& v) {
    rows[3 * i] += v.x, rows[3 * i + 1] += v.y, rows[3 * i + 2] += v.z;
}

__global__ void __launch_bounds__(kThreads)
    project_activated_back(const View view, const ProjectOptions options, const ActivatedGaussians in,
                           const int32_t* radii, const ProjectedGradients by, const ActivatedGradients out) {
    const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
    if (i >= in.count || radii[2 * i] <= 0) return;
    const lane::ScreenLanes gradient = {
        value_at(by.means2d, 2, i, 0),
        value_at(by.means2d, 2, i, 1),
        value_at(by.depths, 1, i, 0),
        {value_at(by.covariances, 3, i, 0), value_at(by.covariances, 3, i, 1), value_at(by.covariances, 3, i, 2)},
        value_at(by.compensations, 1, i, 0),
        value_at(by.slants, 2, i, 0),
        value_at(by.slants, 2, i, 1)};
    const lane::ActivatedLanes d = lane::project_to_screen_backward(view, options, load_activated(in, i), gradient);
    add_vec3(out.means, i, d.mean), add_vec3(out.scales, i, d.scale);
    SPLAT_UNROLL
    for (int k = 0; k < 4; ++k) out.quats[4 * i + k] += d.quat[k];
}

__global__ void __launch_bounds__(kThreads) sh_colours(const View view, const ShRows in, float* out) {
    const int64_t i = int64_t{blockIdx.x} * kThreads + threadIdx.x;
    if (i >= in.count) return;
    lane::Vec3 colour = {0.0f, 0.0f, 0.0f};
    if (in.radii[2 * i] > 0) {
        const Parameters rows = {in.count, in.means, nullptr, nullptr, nullptr, in.sh};
        colour = colour_of(view, rows, i, vec3_at(in.means, i));
    }
    out[3 * i] = lane::max(colour.x, 0.0f), out[3 * i + 1] = lane::max(colour.y, 0.0f);
    out[3 * i + 2] = lane::max(colour.z, 0.0f);
}

// A block's bases and gradients by the colours, whose products are the gradients by the coefficients.
struct ShStaged {
    float basis[kThreads][lane::kMaxSh + 1];  // one more, to avoid bank conflicts
    float colour[kThreads][3];
};

template <int kDegree>
__device__ __forceinline__ lane::Vec3 stage_sh(const View& view, const ShRows& in, int64_t i, lane::Vec3 by_colour,
                                               ShStaged* staged) {
    constexpr int kCount = (kDegree + 1) * (kDegree + 1);
    const Parameters rows = {in.count, in.means, nullptr, nullptr, nullptr, in.sh};
    float sh[3 * kCount], basis[lane::kMaxSh];
    read_sh<3 * kCount>(sh_row(view, rows, i), sh_is_aligned(view, rows), sh);
    const lane::Vec3 mean = lane::colour_backward(view, kDegree, vec3_at(in.means, i), sh, &by_colour, basis);
    SPLAT_UNROLL
    for (int k = 0; k < kCount; ++k) staged->basis[threadIdx.x][k] = basis[k];
    float* colour = staged->colour[threadIdx.x];
    colour[0] = by_colour.x, colour[1] = by_colour.y, colour[2] = by_colour.z;
    return mean;
}

template <int kDegree>
__global__ void __launch_bounds__(kThreads)
    sh_colours_back(const View view, const ShRows in, const float* gradients, float* means, float* sh) {
    SPLAT_SHARED(ShStaged, staged);
    const int64_t first = int64_t{blockIdx.x} * kThreads, i = first + threadIdx.x;
    if (i < in.count && in.radii[2 * i] > 0)
        add_vec3(means, i, stage_sh<kDegree>(view, in, i, vec3_at(gradients, i), &staged));
    __syncthreads();
    constexpr int kUsed = 3 * (kDegree + 1) * (kDegree + 1);
    const int width = 3 * view.sh_count;
    const int rows = static_cast<int>(in.count - first < kThreads ? in.count - first : kThreads);
    for (int j = static_cast<int>(threadIdx.x); j < rows * kUsed; j += kThreads) {
        const int row = j / kUsed, column = j % kUsed;
        if (in.radii[2 * (first + row)] > 0)
            sh[(first + row) * width + column] += staged.basis[row][column / 3] * staged.colour[row][column % 3];
    }
}

bool find_activated(const SplatShot* shot, const SplatProjectOptions* options, const SplatActivated* in, View* view,
                    ProjectOptions* how, ActivatedGaussians* gaussians) {
    if (!shot || !options || !in || in->count < 0 || find_view(*shot, view)) return false;
    *how = {options->far_z, options->blur_px2, options->plane_sigmas, options->compensation_min, options->radius_clip};
    *gaussians = {in->count, in->means, in->quats, in->scales, in->opacities};
    return in->count == 0 || (in->means && in->quats && in->scales && in->opacities);
}

bool find_sh(const SplatShot* shot, const SplatShRows* in, View* view, ShRows* rows) {
    if (!shot || !in || in->count < 0 || find_view(*shot, view)) return false;
    for (int k = 0; k < 3; ++k) view->centre[k] = static_cast<float>(in->centre[k]);
    *rows = {in->count, in->means, in->sh, in->radii};
    return in->count == 0 || (in->means && in->sh && in->radii);
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat;
using namespace splat::cuda;

int32_t splat_project_activated(const SplatShot* shot, const SplatProjectOptions* options,
                                const SplatActivated* gaussians, const SplatProjected* out, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    View view{};
    ProjectOptions how;
    ActivatedGaussians in;
    if (!find_activated(shot, options, gaussians, &view, &how, &in) || !out) return SPLAT_BAD_ARGUMENT;
    if (in.count == 0) return SPLAT_OK;
    const bool all = out->means2d && out->depths && out->covariances && out->determinants && out->radii;
    if (!all) return SPLAT_BAD_ARGUMENT;
    const Projected to = {out->means2d,       out->depths, out->covariances, out->determinants,
                          out->compensations, out->slants, out->radii};
    SPLAT_LAUNCH(project_activated, divide_up(in.count, kThreads), stream, view, how, in, to);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_project_activated_backward(const SplatShot* shot, const SplatProjectOptions* options,
                                         const SplatActivated* gaussians, const int32_t* radii,
                                         const SplatProjectedGradients* gradients, const SplatActivatedGradients* out,
                                         const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    View view{};
    ProjectOptions how;
    ActivatedGaussians in;
    if (!find_activated(shot, options, gaussians, &view, &how, &in) || !gradients || !out) return SPLAT_BAD_ARGUMENT;
    if (in.count == 0) return SPLAT_OK;
    if (!radii || !out->means || !out->quats || !out->scales) return SPLAT_BAD_ARGUMENT;
    const ProjectedGradients by = {gradients->means2d, gradients->depths, gradients->covariances,
                                   gradients->compensations, gradients->slants};
    const ActivatedGradients to = {out->means, out->quats, out->scales};
    SPLAT_LAUNCH(project_activated_back, divide_up(in.count, kThreads), stream, view, how, in, radii, by, to);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_sh_colours(const SplatShot* shot, const SplatShRows* rows, float* out, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    View view{};
    ShRows in;
    if (!find_sh(shot, rows, &view, &in) || (in.count && !out)) return SPLAT_BAD_ARGUMENT;
    if (in.count) SPLAT_LAUNCH(sh_colours, divide_up(in.count, kThreads), stream, view, in, out);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_sh_colours_backward(const SplatShot* shot, const SplatShRows* rows, const float* gradients, float* means,
                                  float* sh, const SplatStream* on) {
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    View view{};
    ShRows in;
    if (!find_sh(shot, rows, &view, &in)) return SPLAT_BAD_ARGUMENT;
    if (in.count == 0) return SPLAT_OK;
    if (!gradients || !means || !sh) return SPLAT_BAD_ARGUMENT;
    const int64_t blocks = divide_up(in.count, kThreads);
    switch (view.sh_degree) {
        case 0:
            SPLAT_LAUNCH(sh_colours_back<0>, blocks, stream, view, in, gradients, means, sh);
            break;
        case 1:
            SPLAT_LAUNCH(sh_colours_back<1>, blocks, stream, view, in, gradients, means, sh);
            break;
        case 2:
            SPLAT_LAUNCH(sh_colours_back<2>, blocks, stream, view, in, gradients, means, sh);
            break;
        default:
            SPLAT_LAUNCH(sh_colours_back<3>, blocks, stream, view, in, gradients, means, sh);
    }
    return static_cast<int32_t>(cudaGetLastError());
}
