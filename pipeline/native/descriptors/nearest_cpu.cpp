// Products of descriptors, compiled once per ISA: as 16-bit numbers, two at a time, with AVX2, else as floats.
#include "descriptors/nearest_tiles.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

#if SPLAT_ISA_AVX2

constexpr int kSteps = kDescriptor / 2;  // the instruction adds the products of two pairs of numbers

struct Products {
    static constexpr int kQueries = 4, kVectors = 2;  // of 16 registers
    static constexpr int kBlock = 96;                 // 24 kB

    // Two 16-bit numbers, the first in the lower half.
    struct Queries {
        int32_t values[kQueries][kSteps];

        SPLAT_METHOD Queries(const uint8_t* first, int count) {
            for (int i = 0; i < kQueries; ++i) {
                const uint8_t* query = first + (i < count ? i : 0) * kDescriptor;
                for (int k = 0; k < kSteps; ++k) values[i][k] = query[2 * k] | query[2 * k + 1] << 16;
            }
        }
    };

    // packed: (vectors, kSteps, kLanes) of two numbers.
    static SPLAT_METHOD void pack(const uint8_t* values, int count, const NearestScratch& scratch) {
        float* packed = static_cast<float*>(scratch.packed);
        constexpr int kColumns = kVectors * kLanes;
        const int end = (count + kColumns - 1) / kColumns * kColumns;
        for (int from = 0; from < end; from += kLanes) {
            for (int i = 0; i < kLanes; ++i) {
                float* row = scratch.rows + i * kSteps;
                if (from + i >= count) {
                    memset(row, 0, kSteps * sizeof(float));
                    continue;
                }
                const uint8_t* value = values + (from + i) * kDescriptor;
                for (int k = 0; k < kDescriptor; k += 16) {
                    const __m128i bytes = _mm_loadu_si128(reinterpret_cast<const __m128i*>(value + k));
                    _mm256_storeu_si256(reinterpret_cast<__m256i*>(row + k / 2), _mm256_cvtepu8_epi16(bytes));
                }
            }
            Floats columns[kSteps];
            load_columns(scratch.rows, kSteps, kSteps, columns);
            for (int k = 0; k < kSteps; ++k) store(packed + from * kSteps + k * kLanes, columns[k]);
        }
    }

    static SPLAT_METHOD void multiply(const Queries& queries, const NearestScratch& scratch, int vector,
                                      Floats (&found)[kQueries][kVectors]) {
        const __m256i* packed = static_cast<const __m256i*>(scratch.packed) + vector * kSteps;
        __m256i sums[kQueries][kVectors];
        for (int i = 0; i < kQueries; ++i)
            for (int v = 0; v < kVectors; ++v) sums[i][v] = _mm256_setzero_si256();
        for (int k = 0; k < kSteps; ++k) {
            __m256i two[kVectors];
            for (int v = 0; v < kVectors; ++v) two[v] = _mm256_load_si256(packed + v * kSteps + k);
            for (int i = 0; i < kQueries; ++i) {
                const __m256i value = _mm256_set1_epi32(queries.values[i][k]);
                for (int v = 0; v < kVectors; ++v)
                    sums[i][v] = _mm256_add_epi32(sums[i][v], _mm256_madd_epi16(two[v], value));
            }
        }
        for (int i = 0; i < kQueries; ++i)
            for (int v = 0; v < kVectors; ++v) found[i][v] = _mm256_cvtepi32_ps(sums[i][v]);
    }
};

static_assert(Products::kBlock * kSteps * sizeof(float) <= kNearestPacked, "scratch is too small");

#else

struct Products {
#if SPLAT_ISA_AVX512
    static constexpr int kQueries = 6, kVectors = 4;  // of 32 registers
#else
    static constexpr int kQueries = 4, kVectors = 3;  // of 16
#endif
    static constexpr int kBlock = kVectors * kLanes;  // up to 32 kB

    struct Queries {
        float values[kQueries][kDescriptor];

        SPLAT_METHOD Queries(const uint8_t* first, int count) {
            for (int i = 0; i < kQueries; ++i)
                for (int k = 0; k < kDescriptor; ++k)
                    values[i][k] = i < count ? static_cast<float>(first[i * kDescriptor + k]) : 0.0f;
        }
    };

    // packed: (vectors, kDescriptor, kLanes).
    static SPLAT_METHOD void pack(const uint8_t* values, int count, const NearestScratch& scratch) {
        float* packed = static_cast<float*>(scratch.packed);
        for (int first = 0; first < kBlock; first += kLanes) {
            for (int i = 0; i < kLanes; ++i)
                for (int k = 0; k < kDescriptor; ++k)
                    scratch.rows[i * kDescriptor + k] =
                        first + i < count ? static_cast<float>(values[(first + i) * kDescriptor + k]) : 0.0f;
            Floats columns[kDescriptor];
            load_columns(scratch.rows, kDescriptor, kDescriptor, columns);
            for (int k = 0; k < kDescriptor; ++k) store(packed + (first * kDescriptor) + k * kLanes, columns[k]);
        }
    }

    static SPLAT_METHOD void multiply(const Queries& queries, const NearestScratch& scratch, int vector,
                                      Floats (&found)[kQueries][kVectors]) {
        const float* packed = static_cast<const float*>(scratch.packed) + vector * kDescriptor * kLanes;
        Floats sums[kQueries][kVectors];
        for (int i = 0; i < kQueries; ++i)
            for (int v = 0; v < kVectors; ++v) sums[i][v] = fill(0.0f);
        for (int k = 0; k < kDescriptor; ++k) {
            Floats column[kVectors];
            for (int v = 0; v < kVectors; ++v) column[v] = load(packed + (v * kDescriptor + k) * kLanes);
            for (int i = 0; i < kQueries; ++i) {
                const Floats value = fill(queries.values[i][k]);
                for (int v = 0; v < kVectors; ++v) sums[i][v] = fma(value, column[v], sums[i][v]);
            }
        }
        for (int i = 0; i < kQueries; ++i)
            for (int v = 0; v < kVectors; ++v) found[i][v] = sums[i][v];
    }
};

static_assert(Products::kBlock * kDescriptor * sizeof(float) <= kNearestPacked, "scratch is too small");

#endif

void compare(const NearestJob& job, const NearestScratch& scratch) { compare_with<Products>(job, scratch); }

}  // namespace

extern const NearestKernels nearest_kernels = {compare};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
