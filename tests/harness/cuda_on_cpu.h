// The subset of CUDA that the kernels use, for a C++ compiler and CPU. Included by device.h where SPLAT_ON_CPU is set.
//
// Blocks run one after another, each thread of a block on a stack of its own, from one synchronisation to the next: in
// an order that the test chooses, so that what a missing barrier leaves to chance differs from order to order. Shared
// memory is poisoned before every block. What no GPU would forgive ends the launch with an error that says where: warp
// operations and barriers that not all named threads reach, or in different places; writes beside shared memory.
#pragma once

#include <math.h>
#include <stdint.h>
#include <string.h>

#include <algorithm>
#include <tuple>
#include <type_traits>

#define __global__
#define __device__
#define __host__
#define __constant__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __align__(bytes) alignas(bytes)

#define HARNESS_LOCAL __attribute__((visibility("hidden")))

namespace harness {

struct Index {
    unsigned x, y, z;
};

enum class Operation : int { syncwarp, shuffle, shuffle_up, shuffle_down, shuffle_xor, ballot, any, all, match };
enum class Barrier : int { plain, count, any, all, grid };

// Where a thread waits: the same line, or the threads do not meet.
struct Place {
    const char* file;
    int line;
};

struct Request {
    Operation operation;
    int width;  // of a shuffle's segments
    unsigned mask;
    Place place;
};

HARNESS_LOCAL uint64_t at_warp(const Request& request, uint64_t value, int argument);
HARNESS_LOCAL int at_barrier(Barrier barrier, int predicate, Place place);
HARNESS_LOCAL int fault();  // the active one of the faults planted in the sources, 0: none
HARNESS_LOCAL void* shared(const void* site, size_t bytes, const char* name);
HARNESS_LOCAL int together_each();  // blocks that a multiprocessor holds at once
HARNESS_LOCAL void run(const char* kernel, int64_t blocks, int threads, bool together, void (*body)(const void*),
                       const void* context);

template <class... Values, class... Arguments>
void launch(const char* name, void (*kernel)(Values...), int64_t blocks, int threads, bool together,
            const Arguments&... arguments) {
    struct Context {
        void (*kernel)(Values...);
        std::tuple<Values...> values;
    } context{kernel, std::tuple<Values...>(arguments...)};
    static_assert(sizeof(context.values) <= 4096, "CUDA passes at most 4 KiB to a kernel");
    run(
        name, blocks, threads, together,
        [](const void* it) {
            const auto* c = static_cast<const Context*>(it);
            std::apply(c->kernel, c->values);
        },
        &context);
}

// A lane's value while it is exchanged between lanes.
template <class T>
uint64_t pack(T value) {
    static_assert(sizeof(T) <= sizeof(uint64_t), "");
    uint64_t bits = 0;
    memcpy(&bits, &value, sizeof(T));
    return bits;
}

template <class To, class From>
To bits_as(From value) {
    static_assert(sizeof(To) == sizeof(From), "");
    To bits;
    memcpy(&bits, &value, sizeof(To));
    return bits;
}

template <class T>
T shuffled(Operation operation, unsigned mask, T value, int argument, int width, Place place) {
    const uint64_t bits = at_warp({operation, width, mask, place}, pack(value), argument);
    T result;
    memcpy(&result, &bits, sizeof(T));
    return result;
}

}  // namespace harness

HARNESS_LOCAL extern harness::Index threadIdx, blockIdx, blockDim, gridDim;
constexpr int warpSize = 32;

#define SPLAT_SHARED(Type, name)                        \
    Type& name = *static_cast<Type*>(::harness::shared( \
        [] {                                            \
            static char site;                           \
            return &site;                               \
        }(),                                            \
        sizeof(Type), #name))
#define SPLAT_LAUNCH(kernel, blocks, stream, ...) \
    ((void)(stream), ::harness::launch(#kernel, kernel, (blocks), ::splat::cuda::kThreads, false, __VA_ARGS__))
#define SPLAT_LAUNCH_TOGETHER(kernel, blocks, stream, ...) \
    ((void)(stream), ::harness::launch(#kernel, kernel, (blocks), ::splat::cuda::kThreads, true, __VA_ARGS__))

// Synchronisation and warps.
#define HARNESS_PLACE const char *file = __builtin_FILE(), int line = __builtin_LINE()

inline void __syncthreads(HARNESS_PLACE) { harness::at_barrier(harness::Barrier::plain, 0, {file, line}); }
inline int __syncthreads_count(int predicate, HARNESS_PLACE) {
    return harness::at_barrier(harness::Barrier::count, predicate, {file, line});
}
inline int __syncthreads_or(int predicate, HARNESS_PLACE) {
    return harness::at_barrier(harness::Barrier::any, predicate, {file, line});
}
inline int __syncthreads_and(int predicate, HARNESS_PLACE) {
    return harness::at_barrier(harness::Barrier::all, predicate, {file, line});
}
inline void sync_grid(HARNESS_PLACE) { harness::at_barrier(harness::Barrier::grid, 0, {file, line}); }
inline void __syncwarp(unsigned mask = 0xffffffffu, HARNESS_PLACE) {
    harness::at_warp({harness::Operation::syncwarp, warpSize, mask, {file, line}}, 0, 0);
}
inline unsigned __ballot_sync(unsigned mask, int predicate, HARNESS_PLACE) {
    return static_cast<unsigned>(
        harness::at_warp({harness::Operation::ballot, warpSize, mask, {file, line}}, predicate != 0, 0));
}
inline int __any_sync(unsigned mask, int predicate, HARNESS_PLACE) {
    return static_cast<int>(
        harness::at_warp({harness::Operation::any, warpSize, mask, {file, line}}, predicate != 0, 0));
}
inline int __all_sync(unsigned mask, int predicate, HARNESS_PLACE) {
    return static_cast<int>(
        harness::at_warp({harness::Operation::all, warpSize, mask, {file, line}}, predicate != 0, 0));
}
template <class T>
unsigned __match_any_sync(unsigned mask, T value, HARNESS_PLACE) {
    return static_cast<unsigned>(
        harness::at_warp({harness::Operation::match, warpSize, mask, {file, line}}, harness::pack(value), 0));
}
template <class T>
T __shfl_sync(unsigned mask, T value, int lane, int width = warpSize, HARNESS_PLACE) {
    return harness::shuffled(harness::Operation::shuffle, mask, value, lane, width, {file, line});
}
template <class T>
T __shfl_up_sync(unsigned mask, T value, unsigned delta, int width = warpSize, HARNESS_PLACE) {
    return harness::shuffled(harness::Operation::shuffle_up, mask, value, static_cast<int>(delta), width, {file, line});
}
template <class T>
T __shfl_down_sync(unsigned mask, T value, unsigned delta, int width = warpSize, HARNESS_PLACE) {
    return harness::shuffled(harness::Operation::shuffle_down, mask, value, static_cast<int>(delta), width,
                             {file, line});
}
template <class T>
T __shfl_xor_sync(unsigned mask, T value, int bits, int width = warpSize, HARNESS_PLACE) {
    return harness::shuffled(harness::Operation::shuffle_xor, mask, value, bits, width, {file, line});
}
inline void __threadfence() {}
inline void __threadfence_block() {}

// Atomic operations, on integers only: sums of floats would depend on the order of threads.
template <class T, class U, class Change>
T harness_atomic(T* at, U value, Change change) {
    static_assert(std::is_integral<T>::value && sizeof(T) >= 4, "integers only");
    const T before = *at;
    *at = change(before, static_cast<T>(value));
    return before;
}
template <class T>
using harness_wrapping = typename std::make_unsigned<T>::type;

template <class T, class U>
T atomicAdd(T* at, U value) {
    using W = harness_wrapping<T>;
    return harness_atomic(at, value, [](T a, T b) { return static_cast<T>(static_cast<W>(a) + static_cast<W>(b)); });
}
template <class T, class U>
T atomicSub(T* at, U value) {
    using W = harness_wrapping<T>;
    return harness_atomic(at, value, [](T a, T b) { return static_cast<T>(static_cast<W>(a) - static_cast<W>(b)); });
}
template <class T, class U>
T atomicMax(T* at, U value) {
    return harness_atomic(at, value, [](T a, T b) { return a > b ? a : b; });
}
template <class T, class U>
T atomicMin(T* at, U value) {
    return harness_atomic(at, value, [](T a, T b) { return a < b ? a : b; });
}
template <class T, class U>
T atomicOr(T* at, U value) {
    return harness_atomic(at, value, [](T a, T b) { return static_cast<T>(a | b); });
}
template <class T, class U>
T atomicAnd(T* at, U value) {
    return harness_atomic(at, value, [](T a, T b) { return static_cast<T>(a & b); });
}
template <class T, class U>
T atomicXor(T* at, U value) {
    return harness_atomic(at, value, [](T a, T b) { return static_cast<T>(a ^ b); });
}
template <class T, class U>
T atomicExch(T* at, U value) {
    return harness_atomic(at, value, [](T, T b) { return b; });
}
template <class T, class U, class V>
T atomicCAS(T* at, U compare, V value) {
    return harness_atomic(at, value, [&](T a, T b) { return a == static_cast<T>(compare) ? b : a; });
}

// Loads and stores with hints.
template <class T>
T __ldg(const T* at) {
    return *at;
}
template <class T>
T __ldcs(const T* at) {
    return *at;
}
template <class T>
T __ldcg(const T* at) {
    return *at;
}
template <class T>
void __stcs(T* at, T value) {
    *at = value;
}
template <class T>
void __stcg(T* at, T value) {
    *at = value;
}

// Bits.
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline int __popcll(unsigned long long x) { return __builtin_popcountll(x); }
inline int __ffs(int x) { return __builtin_ffs(x); }
inline int __ffsll(long long x) { return __builtin_ffsll(x); }
inline int __clz(int x) { return x == 0 ? 32 : __builtin_clz(static_cast<unsigned>(x)); }
inline int __clzll(long long x) { return x == 0 ? 64 : __builtin_clzll(static_cast<unsigned long long>(x)); }
inline unsigned long long __brevll(unsigned long long x) {
    unsigned long long reversed = 0;
    for (int i = 0; i < 64; ++i) reversed = reversed << 1 | (x >> i & 1);
    return reversed;
}
inline unsigned __brev(unsigned x) { return static_cast<unsigned>(__brevll(x) >> 32); }
inline unsigned __umulhi(unsigned a, unsigned b) {
    return static_cast<unsigned>(static_cast<uint64_t>(a) * static_cast<uint64_t>(b) >> 32);
}
inline unsigned long long __umul64hi(unsigned long long a, unsigned long long b) {
    return static_cast<unsigned long long>(static_cast<unsigned __int128>(a) * b >> 64);
}
inline unsigned __float_as_uint(float x) { return harness::bits_as<unsigned>(x); }
inline int __float_as_int(float x) { return harness::bits_as<int>(x); }
inline float __uint_as_float(unsigned x) { return harness::bits_as<float>(x); }
inline float __int_as_float(int x) { return harness::bits_as<float>(x); }
inline long long __double_as_longlong(double x) { return harness::bits_as<long long>(x); }
inline double __longlong_as_double(long long x) { return harness::bits_as<double>(x); }

// Mathematics.
template <class A, class B>
typename std::common_type<A, B>::type harness_least(A a, B b) {
    using T = typename std::common_type<A, B>::type;
    if constexpr (std::is_floating_point<T>::value)  // the number, where one is NaN
        return static_cast<T>(fmin(a, b));
    else
        return static_cast<T>(b) < static_cast<T>(a) ? static_cast<T>(b) : static_cast<T>(a);
}
template <class A, class B>
typename std::common_type<A, B>::type harness_most(A a, B b) {
    using T = typename std::common_type<A, B>::type;
    if constexpr (std::is_floating_point<T>::value)
        return static_cast<T>(fmax(a, b));
    else
        return static_cast<T>(a) < static_cast<T>(b) ? static_cast<T>(b) : static_cast<T>(a);
}
template <class A, class B>
auto min(A a, B b) {
    return harness_least(a, b);
}
template <class A, class B>
auto max(A a, B b) {
    return harness_most(a, b);
}
#define rsqrtf harness_rsqrtf  // newer C libraries have their own
inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
inline float __frcp_rn(float x) { return 1.0f / x; }
inline float __frsqrt_rn(float x) { return static_cast<float>(1.0 / sqrt(static_cast<double>(x))); }
inline float __fsqrt_rn(float x) { return sqrtf(x); }
inline float __fdiv_rn(float a, float b) { return a / b; }
inline float __fdividef(float a, float b) { return a / b; }
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fsub_rn(float a, float b) { return a - b; }
inline float __fmul_rn(float a, float b) { return a * b; }
inline float __fmaf_rn(float a, float b, float c) { return fmaf(a, b, c); }
inline double __dadd_rn(double a, double b) { return a + b; }
inline double __dmul_rn(double a, double b) { return a * b; }
inline float __expf(float x) { return expf(x); }
inline float __logf(float x) { return logf(x); }
inline float __log2f(float x) { return log2f(x); }
inline float __powf(float x, float y) { return powf(x, y); }
inline float __saturatef(float x) { return fminf(fmaxf(x, 0.0f), 1.0f); }
inline int __float2int_rn(float x) { return static_cast<int>(nearbyintf(x)); }
inline int __float2int_rd(float x) { return static_cast<int>(floorf(x)); }
inline int __float2int_ru(float x) { return static_cast<int>(ceilf(x)); }
inline int __float2int_rz(float x) { return static_cast<int>(x); }
inline float __int2float_rn(int x) { return static_cast<float>(x); }
inline float __uint2float_rn(unsigned x) { return static_cast<float>(x); }

// Vectors, aligned as CUDA's.
#define HARNESS_VECTORS(T, name)                                                  \
    struct alignas(2 * sizeof(T)) name##2 { T x, y; };                            \
    struct name##3 { T x, y, z; };                                                \
    struct alignas(sizeof(T) > 4 ? 16 : 4 * sizeof(T)) name##4 { T x, y, z, w; }; \
    inline name##2 make_##name##2(T x, T y) { return {x, y}; }                    \
    inline name##3 make_##name##3(T x, T y, T z) { return {x, y, z}; }            \
    inline name##4 make_##name##4(T x, T y, T z, T w) { return {x, y, z, w}; }
HARNESS_VECTORS(float, float)
HARNESS_VECTORS(int, int)
HARNESS_VECTORS(unsigned, uint)
HARNESS_VECTORS(double, double)
HARNESS_VECTORS(unsigned char, uchar)
HARNESS_VECTORS(unsigned short, ushort)
HARNESS_VECTORS(unsigned long long, ulonglong)

// The runtime, as far as the host's side of the kernels calls it. Everything has happened when a call returns.
using cudaStream_t = void*;
using cudaError_t = int;
constexpr cudaError_t cudaSuccess = 0, cudaErrorInvalidValue = 1, cudaErrorInvalidConfiguration = 9,
                      cudaErrorInvalidDevice = 101, cudaErrorLaunchFailure = 719,
                      cudaErrorCooperativeLaunchTooLarge = 720;
enum cudaMemcpyKind { cudaMemcpyHostToHost, cudaMemcpyHostToDevice, cudaMemcpyDeviceToHost, cudaMemcpyDeviceToDevice };
enum cudaDeviceAttr {
    cudaDevAttrMultiProcessorCount,
    cudaDevAttrComputeCapabilityMajor,
    cudaDevAttrComputeCapabilityMinor
};
struct cudaDeviceProp {
    char name[256];
    size_t totalGlobalMem;
    int multiProcessorCount, major, minor;
};
struct cudaFuncAttributes {
    size_t sharedSizeBytes, localSizeBytes, constSizeBytes;
    int maxThreadsPerBlock, numRegs, binaryVersion, ptxVersion;
};

HARNESS_LOCAL cudaError_t cudaGetLastError();
HARNESS_LOCAL cudaError_t cudaPeekAtLastError();
HARNESS_LOCAL const char* cudaGetErrorString(cudaError_t error);
HARNESS_LOCAL const char* cudaGetErrorName(cudaError_t error);
HARNESS_LOCAL cudaError_t cudaGetDevice(int* device);
HARNESS_LOCAL cudaError_t cudaGetDeviceCount(int* count);
HARNESS_LOCAL cudaError_t cudaGetDeviceProperties(cudaDeviceProp* properties, int device);
HARNESS_LOCAL cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int device);
HARNESS_LOCAL cudaError_t cudaMemGetInfo(size_t* unused, size_t* total);
HARNESS_LOCAL cudaError_t cudaDriverGetVersion(int* version);
HARNESS_LOCAL cudaError_t cudaRuntimeGetVersion(int* version);
HARNESS_LOCAL cudaError_t cudaSetDevice(int device);
inline cudaError_t cudaStreamSynchronize(cudaStream_t) { return cudaSuccess; }
inline cudaError_t cudaDeviceSynchronize() { return cudaSuccess; }
HARNESS_LOCAL cudaError_t cudaMemsetAsync(void* at, int value, size_t bytes, cudaStream_t = nullptr);
inline cudaError_t cudaMemcpyAsync(void* to, const void* from, size_t bytes, cudaMemcpyKind, cudaStream_t = nullptr) {
    if (bytes > 0) memmove(to, from, bytes);
    return cudaSuccess;
}
template <class Kernel>
cudaError_t cudaFuncGetAttributes(cudaFuncAttributes* attributes, Kernel*) {
    *attributes = {0, 0, 0, 1024, 32, 0, 0};
    return cudaSuccess;
}
template <class Kernel>
cudaError_t cudaOccupancyMaxActiveBlocksPerMultiprocessor(int* blocks, Kernel*, int, size_t) {
    *blocks = harness::together_each();
    return cudaSuccess;
}
