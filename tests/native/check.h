// What the native tests stand on. They need no framework and no Python: they are built under a sanitizer (`make
// sanitize`), which no interpreter is.
//
// Arrays are vectors made in their size: they end where the heap block ends, so that AddressSanitizer sees one step too
// far.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <string>
#include <vector>

// Runs a test and remembers how it ended.
void test(const std::string& name, const std::function<void()>& body);

// The same once for every ISA that this CPU has, with that ISA in use.
void test_each_isa(const std::string& name, const std::function<void()>& body);

// Ends the test as failed unless it holds.
void check(bool holds, const std::string& what);

template <class T>
bool same_bits(const std::vector<T>& a, const std::vector<T>& b) {
    return a.size() == b.size() && (a.empty() || std::memcmp(a.data(), b.data(), a.size() * sizeof(T)) == 0);
}

inline bool all_finite(const std::vector<float>& values) {
    for (float value : values)
        if (!std::isfinite(value)) return false;
    return true;
}

// SplitMix64 (Steele et al. 2014): the same numbers everywhere.
class Random {
  public:
    explicit Random(std::uint64_t seed) : state_(seed) {}

    std::uint64_t bits() {
        std::uint64_t z = state_ += 0x9e3779b97f4a7c15u;
        z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
        z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
        return z ^ (z >> 31);
    }
    int below(int n) { return static_cast<int>(bits() % static_cast<std::uint64_t>(n)); }
    float uniform(float low, float high) { return low + (high - low) * static_cast<float>(bits() >> 40) * 0x1p-24f; }
    float normal() {
        const float radius = std::sqrt(-2.0f * std::log(uniform(1e-7f, 1.0f)));
        return radius * std::cos(uniform(0.0f, 6.2831853f));
    }

  private:
    std::uint64_t state_;
};

constexpr int kThreadCounts[] = {1, 2, 5};

void test_threads();
void test_raster();
void test_gradients();
void test_features();
void test_loss();
void test_colour();
void test_sky();
void test_patch_match();
void test_descriptors();
void test_surface();
void test_adam();
