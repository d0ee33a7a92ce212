// Peak performance of this machine: multiply-adds in registers and copies in memory, on a given number of threads.
//
// Usage: ceilings THREADS. Prints GFLOP/s per core (an FMA is two, by CPU time with all threads busy), products of
// 8-bit numbers summed to 32 bits per core (in 10⁹/s), and GB/s that all threads copy (read and written both count, by
// the wall clock). LANES is set by a compiler flag: floats in a vector register of the instruction set compiled for.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <functional>
#include <thread>
#include <vector>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace {

typedef float Vector __attribute__((vector_size(LANES * sizeof(float))));

constexpr int kChains = 10;  // hides an FMA's latency of 4 to 5 cycles at two a cycle, and still fits 16 registers
constexpr int kSteps = 2'000'000;
constexpr size_t kBytes = size_t{512} << 20;  // all threads' sources and targets together: beyond any cache
constexpr int kCopies = 5, kLoops = 20;       // repeats, of which the shortest counts

// Private to each thread; the sum is printed so that the compiler cannot optimise the work away.
void multiply_add(float* sink) {
    Vector chains[kChains];
    for (int c = 0; c < kChains; ++c) chains[c] = Vector{} + static_cast<float>(c + 1);
    const Vector factor = Vector{} + 0.9999f, term = Vector{} + *sink;
    for (int step = 0; step < kSteps; ++step) {
#pragma GCC unroll 16
        for (int c = 0; c < kChains; ++c) chains[c] = chains[c] * factor + term;
    }
    for (int c = 0; c < kChains; ++c) *sink += chains[c][0] * 1e-9f;
}

#if defined(__x86_64__)
void add_first(const void* numbers, float* sink) {
    int first;
    std::memcpy(&first, numbers, sizeof first);
    *sink += static_cast<float>(first) * 1e-20f;
}

// With VNNI: four bytes to a lane.
__attribute__((target("avx512f,avx512vnni"))) void multiply_bytes(float* sink) {
    const __m512i factor = _mm512_set1_epi32(static_cast<int>(*sink) + 0x01020304);
    __m512i chains[kChains];
    for (int c = 0; c < kChains; ++c) chains[c] = _mm512_set1_epi32(c);
    for (int step = 0; step < kSteps; ++step) {
#pragma GCC unroll 16
        for (int c = 0; c < kChains; ++c) chains[c] = _mm512_dpbusd_epi32(chains[c], factor, factor);
    }
    for (int c = 0; c < kChains; ++c) add_first(&chains[c], sink);
}

// With AVX2: two to a lane, as 16-bit numbers, and an addition.
__attribute__((target("avx2"))) void multiply_words(float* sink) {
    __m256i factor = _mm256_set1_epi32(static_cast<int>(*sink) + 0x00010002);
    __m256i chains[kChains];
    for (int c = 0; c < kChains; ++c) chains[c] = _mm256_set1_epi32(c);
    for (int step = 0; step < kSteps; ++step) {
#pragma GCC unroll 16
        for (int c = 0; c < kChains; ++c) {
            __asm__("" : "+x"(factor));  // or the compiler would multiply once
            chains[c] = _mm256_add_epi32(chains[c], _mm256_madd_epi16(factor, factor));
        }
    }
    for (int c = 0; c < kChains; ++c) add_first(&chains[c], sink);
}
#endif

double now(clockid_t clock) {
    timespec time{};
    clock_gettime(clock, &time);
    return static_cast<double>(time.tv_sec) + 1e-9 * static_cast<double>(time.tv_nsec);
}

double seconds(clockid_t clock, int threads, const std::function<void(int)>& work) {
    const double begin = now(clock);
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t) others.emplace_back(work, t);
    work(0);
    for (std::thread& other : others) other.join();
    return now(clock) - begin;
}

// The first run faults the memory in and lets the clock rate settle; the shortest run counts.
double shortest(clockid_t clock, int threads, int repeats, const std::function<void(int)>& work) {
    double best = seconds(clock, threads, work);
    for (int i = 1; i < repeats; ++i) best = std::min(best, seconds(clock, threads, work));
    return best;
}

}  // namespace

int main(int argc, char** argv) {
    const int threads = argc > 1 ? std::atoi(argv[1]) : 1;
    if (threads < 1 || threads > 256) return 2;
    std::vector<float> sinks(static_cast<size_t>(threads) * 64, 0.5f);  // a cache line and more apart
    const auto per_second = [&](void (*work)(float*), int lanes) {
        const auto one = [&](int t) { work(&sinks[static_cast<size_t>(t) * 64]); };
        const double steps = static_cast<double>(kSteps) * kChains * threads;
        return lanes * steps / shortest(CLOCK_PROCESS_CPUTIME_ID, threads, kLoops, one);
    };
    const double fma = per_second(multiply_add, LANES);
    double products = fma;  // as floats
#if defined(__x86_64__)
    if (__builtin_cpu_supports("avx512vnni"))
        products = per_second(multiply_bytes, 64);
    else if (__builtin_cpu_supports("avx2"))
        products = per_second(multiply_words, 16);
#endif
    const size_t bytes = kBytes / static_cast<size_t>(threads);
    std::vector<std::vector<char>> memory(static_cast<size_t>(threads), std::vector<char>(bytes, 1));
    const double copy = shortest(CLOCK_MONOTONIC, threads, kCopies, [&](int t) {
        char* half = memory[static_cast<size_t>(t)].data();
        std::memcpy(half + bytes / 2, half, bytes / 2);
        half[0] = half[bytes - 1];
    });
    std::printf("{\"gflops\": %.4g, \"gproducts\": %.4g, \"copy_gb_s\": %.4g, \"check\": %.3g}\n", 2e-9 * fma,
                1e-9 * products, 1e-9 * static_cast<double>(bytes) * threads / copy, static_cast<double>(sinks[0]));
    return 0;
}
