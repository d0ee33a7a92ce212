// Products of descriptors as floats, compiled once per ISA.
#include "descriptors/nearest_tiles.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

struct FloatProducts {
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

static_assert(FloatProducts::kBlock * kDescriptor * sizeof(float) <= kNearestPacked, "scratch is too small");

void compare(const NearestJob& job, const NearestScratch& scratch) { compare_with<FloatProducts>(job, scratch); }

}  // namespace

extern const NearestKernels nearest_kernels = {compare};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
