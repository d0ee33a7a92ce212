// Kernels that do what test_cuda_harness.py says of them, rightly and wrongly.
#include "cuda/grid.cuh"

namespace splat {
namespace cuda {
namespace {

struct Values {
    float of[kThreads];
};
struct Words {
    int of[kThreads];
};

// Each thread's value and the next one's, through shared memory; with `met`, after a barrier.
__global__ void add_next(const float* in, float* out, int met) {
    SPLAT_SHARED(Values, shared);
    const unsigned i = threadIdx.x;
    shared.of[i] = in[i];
    if (met) __syncthreads();
    out[i] = shared.of[i] + shared.of[(i + 1) % kThreads];
}

// The same within a warp.
__global__ void add_next_in_warp(const float* in, float* out, int met) {
    SPLAT_SHARED(Values, shared);
    const unsigned i = threadIdx.x, next = i / kWarp * kWarp + (i + 1) % kWarp;
    shared.of[i] = in[i];
    if (met) __syncwarp();
    out[i] = shared.of[i] + shared.of[next];
}

// Two rounds through the same memory; without the last barrier, a fast warp overwrites what a slow one has yet to read.
__global__ void reuse(float* out, int met) {
    SPLAT_SHARED(Values, shared);
    const unsigned i = threadIdx.x, other = (i + kThreads / 2) % kThreads;
    float sum = 0.0f;
    for (int round = 1; round <= 2; ++round) {
        shared.of[i] = static_cast<float>(round * 1000 + static_cast<int>(i));
        __syncthreads();
        sum += shared.of[other];
        if (met) __syncthreads();
    }
    out[i] = sum;
}

// A block reads what the block before it may have written.
__global__ void read_neighbour(float* out) {
    if (threadIdx.x != 0) return;
    out[blockIdx.x] = blockIdx.x == 0 ? 1.0f : out[blockIdx.x - 1] + 1.0f;
}

// Three rounds in which a block adds what the next one has written; with `met`, all wait for each other.
__global__ void add_next_block(float* sums, int met) {
    SPLAT_SHARED(Values, shared);
    shared.of[threadIdx.x] = static_cast<float>(blockIdx.x);  // stays the block's own
    __syncthreads();
    for (int round = 0; round < 3; ++round) {
        if (threadIdx.x == 255) sums[blockIdx.x] = shared.of[0] + static_cast<float>(round);
        if (met) sync_grid();
        const float next = sums[(blockIdx.x + 1) % gridDim.x];
        if (met) sync_grid();
        __syncthreads();
        shared.of[threadIdx.x] += next;
        __syncthreads();
    }
    if (threadIdx.x == 0) sums[blockIdx.x] = shared.of[0];
}

// Blocks that do not all come to the grid's barrier, or not to the same.
__global__ void miss_grid(int which) {
    if (which == 0 && blockIdx.x == 1) return;
    if (which == 1 && blockIdx.x == 1) sync_grid();
    if (which == 2 && threadIdx.x == 7) return;
    sync_grid();
    if (which == 1 && blockIdx.x != 1) sync_grid();
}

// Who comes first gets the lowest number.
__global__ void take_numbers(int* counter, int* out) { out[threadIdx.x] = atomicAdd(counter, 1); }

// What shared memory holds before anything is written there, and after.
__global__ void read_unwritten(float* out) {
    SPLAT_SHARED(Values, shared);
    const unsigned i = blockIdx.x * kThreads + threadIdx.x;
    out[i] = shared.of[threadIdx.x];
    shared.of[threadIdx.x] = 7.0f;
}

__global__ void write_beside(int index) {
    SPLAT_SHARED(Words, shared);
    if (threadIdx.x == 0) (&shared.of[0])[index] = 1;
}

struct Much {
    char bytes[50000];
};
__global__ void ask_for_much(int value) {
    SPLAT_SHARED(Much, shared);
    shared.bytes[threadIdx.x] = static_cast<char>(value);
}

// Threads that do not meet: `which` says how.
__global__ void miss(int* out, int which) {
    const int lane = static_cast<int>(threadIdx.x) % kWarp, warp = static_cast<int>(threadIdx.x) / kWarp;
    if (which == 0 && lane == 5) return;                                        // returned before a warp operation
    if (which == 1 && lane == 5) __syncthreads();                               // waits elsewhere
    if (which == 2 && warp == 3) return;                                        // returned before the barrier
    if (which == 3 && warp == 3) __syncthreads();                               // another barrier
    if (which == 4 && lane < 16) out[lane] = __shfl_sync(kWholeWarp, lane, 0);  // another operation
    if (which == 5 && lane < 16) out[lane] = __ballot_sync(0xffffu, 1);         // right: half a warp by itself
    if (which == 6 && lane < 16) out[lane] = __ballot_sync(0xff00u, 1);         // not named
    out[threadIdx.x] = __shfl_xor_sync(kWholeWarp, lane, 1);
    __syncthreads();
}

// What every operation gives, a row each, of a value a thread.
__global__ void all_operations(const int* in, int* out) {
    const int i = static_cast<int>(threadIdx.x), lane = i % kWarp, value = in[i];
    int row = 0;
    const auto put = [&](int result) { out[row++ * kThreads + i] = result; };
    put(__shfl_sync(kWholeWarp, value, value));
    put(__shfl_sync(kWholeWarp, value, lane + 3, 8));
    put(__shfl_up_sync(kWholeWarp, value, 3));
    put(__shfl_down_sync(kWholeWarp, value, 5, 16));
    put(__shfl_xor_sync(kWholeWarp, value, 21));
    put(static_cast<int>(__ballot_sync(kWholeWarp, value & 1)));
    put(__any_sync(kWholeWarp, value == 3));
    put(__all_sync(kWholeWarp, value < 30));
    put(static_cast<int>(__match_any_sync(kWholeWarp, value % 4)));
    put(__syncthreads_count(value % 3));
    put(__syncthreads_or(value == 31));
    put(__syncthreads_and(value < 31));
    put(__popc(static_cast<unsigned>(value)) + 100 * __ffs(value) + 10000 * __clz(value));
    put(static_cast<int>(__brev(static_cast<unsigned>(value))));
    const int64_t far = __shfl_sync(kWholeWarp, int64_t{1} << 40 | value, 31 - lane);
    put(far >> 40 == 1 ? static_cast<int>(far) : -1);
    put(static_cast<int>(__shfl_sync(kWholeWarp, 0.5 * value, 31 - lane) * 2.0));
}

}  // namespace
}  // namespace cuda
}  // namespace splat

using namespace splat::cuda;

#define EXAMPLE extern "C" __attribute__((visibility("default"))) int
EXAMPLE example_add_next(const float* in, float* out, int met) {
    SPLAT_LAUNCH(add_next, 1, nullptr, in, out, met);
    return cudaGetLastError();
}
EXAMPLE example_add_next_in_warp(const float* in, float* out, int met) {
    SPLAT_LAUNCH(add_next_in_warp, 1, nullptr, in, out, met);
    return cudaGetLastError();
}
EXAMPLE example_reuse(float* out, int met) {
    SPLAT_LAUNCH(reuse, 1, nullptr, out, met);
    return cudaGetLastError();
}
EXAMPLE example_read_neighbour(float* out, int blocks) {
    SPLAT_LAUNCH(read_neighbour, blocks, nullptr, out);
    return cudaGetLastError();
}
EXAMPLE example_add_next_block(float* sums, int blocks, int met) {
    SPLAT_LAUNCH_TOGETHER(add_next_block, blocks, nullptr, sums, met);
    return cudaGetLastError();
}
EXAMPLE example_miss_grid(int which, int together) {
    if (together)
        SPLAT_LAUNCH_TOGETHER(miss_grid, 3, nullptr, which);
    else
        SPLAT_LAUNCH(miss_grid, 3, nullptr, which);
    return cudaGetLastError();
}
EXAMPLE example_together(void) { return static_cast<int>(blocks_together(miss_grid)); }
EXAMPLE example_take_numbers(int* counter, int* out) {
    SPLAT_LAUNCH(take_numbers, 1, nullptr, counter, out);
    return cudaGetLastError();
}
EXAMPLE example_read_unwritten(float* out, int blocks) {
    SPLAT_LAUNCH(read_unwritten, blocks, nullptr, out);
    return cudaGetLastError();
}
EXAMPLE example_write_beside(int index) {
    SPLAT_LAUNCH(write_beside, 2, nullptr, index);
    return cudaGetLastError();
}
EXAMPLE example_miss(int* out, int which) {
    SPLAT_LAUNCH(miss, 2, nullptr, out, which);
    return cudaGetLastError();
}
EXAMPLE example_all_operations(const int* in, int* out) {
    SPLAT_LAUNCH(all_operations, 1, nullptr, in, out);
    return cudaGetLastError();
}
EXAMPLE example_ask_for_much() {
    SPLAT_LAUNCH(ask_for_much, 1, nullptr, 0);
    return cudaGetLastError();
}
