// Density control's kernels: the random numbers of train/random_numbers.py, the positions of a split's halves, and
// Morton codes.
#include <math.h>

#include "cuda/api.h"
#include "cuda/stream.h"

namespace splat {
namespace cuda {
namespace {

constexpr uint64_t kWeyl = 0x9E3779B97F4A7C15u;  // SplitMix64's increment and multipliers
constexpr uint64_t kMultiply1 = 0xBF58476D1CE4E5B9u, kMultiply2 = 0x94D049BB133111EBu;
constexpr double kToUnit = 1.0 / 9007199254740992.0;  // 2^-53
constexpr double kTwoPi = 6.283185307179586;
constexpr float kLeastNorm = 1e-12f;
constexpr int kMortonBits = 21;  // an axis: three of them fill 63

__host__ __device__ inline uint64_t mix(uint64_t bits) {
    bits = (bits ^ (bits >> 30)) * kMultiply1;
    bits = (bits ^ (bits >> 27)) * kMultiply2;
    return bits ^ (bits >> 31);
}

uint64_t key_of(uint64_t seed, uint64_t step, uint64_t stream_of_use) {
    uint64_t key = 0;
    for (const uint64_t word : {seed, step, stream_of_use}) key = mix((key ^ word) + kWeyl);
    return key;
}

__device__ inline double uniform_at(uint64_t key, uint64_t index) {
    const uint64_t bits = mix(key + kWeyl * (index + 1)) >> 11;
    return (static_cast<double>(bits) + 0.5) * kToUnit;
}

// Box-Muller.
__device__ inline double normal_at(uint64_t key, uint64_t index) {
    return sqrt(-2.0 * log(uniform_at(key, 2 * index))) * cos(kTwoPi * uniform_at(key, 2 * index + 1));
}

__global__ void draw_uniform(uint64_t key, int64_t count, double* out) {
    const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (i < count) out[i] = uniform_at(key, static_cast<uint64_t>(i));
}

struct Vector {
    float x, y, z;
};

__device__ inline Vector cross(const Vector& a, const Vector& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

// Rotation by a quaternion (w, x, y, z), not necessarily normalized: v + 2 u x (u x v + w v) for |q| = 1.
__device__ inline Vector rotated(const float* quat, const Vector& v) {
    const float square = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
    const float norm = fmaxf(sqrtf(square), kLeastNorm), w = quat[0] / norm;
    const Vector axis{quat[1] / norm, quat[2] / norm, quat[3] / norm};
    const Vector inner = cross(axis, v);
    const Vector turned = cross(axis, {inner.x + w * v.x, inner.y + w * v.y, inner.z + w * v.z});
    return {v.x + 2.0f * turned.x, v.y + 2.0f * turned.y, v.z + 2.0f * turned.z};
}

// Two positions within each parent: one thread per child, whose index selects the random numbers.
__global__ void draw_splits(uint64_t key, const int64_t* rows, int64_t count, const float* log_scales,
                            const float* quats, float* out) {
    const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= 2 * count) return;
    const int64_t row = rows[i % count];
    const uint64_t child = 2 * static_cast<uint64_t>(row) + (i >= count);
    float local[3];
    for (int axis = 0; axis < 3; ++axis)
        local[axis] = static_cast<float>(normal_at(key, 3 * child + axis)) * expf(log_scales[3 * row + axis]);
    const Vector offset = rotated(quats + 4 * row, {local[0], local[1], local[2]});
    out[3 * i] = offset.x, out[3 * i + 1] = offset.y, out[3 * i + 2] = offset.z;
}

// The bits of a number with two zeros between neighbours.
__device__ inline uint64_t spread(uint64_t bits) {
    bits = (bits | bits << 32) & 0x001f00000000ffffu;
    bits = (bits | bits << 16) & 0x001f0000ff0000ffu;
    bits = (bits | bits << 8) & 0x100f00f00f00f00fu;
    bits = (bits | bits << 4) & 0x10c30c30c30c30c3u;
    return (bits | bits << 2) & 0x1249249249249249u;
}

struct Box {
    float lowest[3];
    float cells[3];  // a world unit
};

// The first axis has the lowest bit; NaN maps to the lowest cell.
__global__ void find_morton(const float* means, int64_t count, const Box box, int64_t* keys) {
    const int64_t i = static_cast<int64_t>(blockIdx.x) * kThreads + threadIdx.x;
    if (i >= count) return;
    constexpr float kLast = static_cast<float>((1 << kMortonBits) - 1);
    uint64_t key = 0;
#pragma unroll
    for (int axis = 0; axis < 3; ++axis) {
        const float place = (means[3 * i + axis] - box.lowest[axis]) * box.cells[axis];
        key |= spread(static_cast<uint64_t>(fminf(fmaxf(place, 0.0f), kLast))) << axis;
    }
    keys[i] = static_cast<int64_t>(key);
}

}  // namespace
}  // namespace cuda
}  // namespace splat

extern "C" {

int32_t splat_uniform(uint64_t seed, uint64_t step, uint64_t stream_of_use, int64_t count, double* out,
                      const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (count < 0) return SPLAT_BAD_ARGUMENT;
    if (count == 0) return SPLAT_OK;
    const uint64_t key = key_of(seed, step, stream_of_use);
    SPLAT_LAUNCH(draw_uniform, divide_up(count, kThreads), stream, key, count, out);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_split_offsets(uint64_t seed, uint64_t step, uint64_t stream_of_use, const int64_t* rows, int64_t count,
                            const float* log_scales, const float* quats, float* out, const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (count < 0) return SPLAT_BAD_ARGUMENT;
    if (count == 0) return SPLAT_OK;
    const uint64_t key = key_of(seed, step, stream_of_use);
    SPLAT_LAUNCH(draw_splits, divide_up(2 * count, kThreads), stream, key, rows, count, log_scales, quats, out);
    return static_cast<int32_t>(cudaGetLastError());
}

int32_t splat_morton(const float* means, int64_t count, const float* lowest, const float* size, int64_t* keys,
                     const SplatStream* on) {
    using namespace splat::cuda;
    cudaStream_t stream;
    if (const int32_t error = enter(on, &stream)) return error;
    if (count < 0) return SPLAT_BAD_ARGUMENT;
    if (count == 0) return SPLAT_OK;
    Box box;
    for (int axis = 0; axis < 3; ++axis) {
        box.lowest[axis] = lowest[axis];
        box.cells[axis] = size[axis] > 0.0f ? static_cast<float>(1 << kMortonBits) / size[axis] : 0.0f;
    }
    SPLAT_LAUNCH(find_morton, divide_up(count, kThreads), stream, means, count, box, keys);
    return static_cast<int32_t>(cudaGetLastError());
}

}  // extern "C"
