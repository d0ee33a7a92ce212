// Products of descriptors as bytes, four at a time: for CPUs with AVX-512 and VNNI, compiled for them alone.
#include "descriptors/nearest_tiles.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kSteps = kDescriptor / 4;  // the instruction adds the products of four unsigned and four signed bytes

struct ByteProducts {
    static constexpr int kQueries = 6, kVectors = 4;
    static constexpr int kBlock = 256;  // 32 kB

    // Less 128 each, which makes them signed; the values' sums times 128 make up for it.
    struct Queries {
        int32_t values[kQueries][kSteps];

        SPLAT_METHOD Queries(const uint8_t* first, int count) {
            for (int i = 0; i < kQueries; ++i) {
                memcpy(values[i], first + (i < count ? i : 0) * kDescriptor, kDescriptor);
                for (int k = 0; k < kSteps; ++k) values[i][k] ^= static_cast<int32_t>(0x80808080U);
            }
        }
    };

    // packed: (vectors, kSteps, kLanes) of four bytes, then 128 times the sum of each value.
    static SPLAT_METHOD void pack(const uint8_t* values, int count, const NearestScratch& scratch) {
        int32_t* packed = static_cast<int32_t*>(scratch.packed);
        int32_t* sums = packed + kBlock * kSteps;
        constexpr int kColumns = kVectors * kLanes;
        const int end = (count + kColumns - 1) / kColumns * kColumns;
        for (int from = 0; from < end; from += kLanes) {
            const int here = count - from < kLanes ? count - from : kLanes;
            const float* rows = reinterpret_cast<const float*>(values + from * kDescriptor);
            if (here < kLanes) {
                memset(scratch.rows, 0, kLanes * kDescriptor);
                if (here > 0) memcpy(scratch.rows, values + from * kDescriptor, here * kDescriptor);
                rows = scratch.rows;
            }
            Floats columns[kSteps];
            load_columns(rows, kSteps, kSteps, columns);
            __m512i sum = _mm512_setzero_si512();
            for (int k = 0; k < kSteps; ++k) {
                const __m512i four = _mm512_castps_si512(columns[k]);
                _mm512_storeu_si512(packed + from * kSteps + k * kLanes, four);
                sum = _mm512_dpbusd_epi32(sum, four, _mm512_set1_epi8(1));
            }
            _mm512_storeu_si512(sums + from, _mm512_slli_epi32(sum, 7));
        }
    }

    static SPLAT_METHOD void multiply(const Queries& queries, const NearestScratch& scratch, int vector,
                                      Floats (&found)[kQueries][kVectors]) {
        const int32_t* packed = static_cast<const int32_t*>(scratch.packed);
        __m512i products[kQueries][kVectors];
        for (int v = 0; v < kVectors; ++v) {
            const __m512i sum = _mm512_loadu_si512(packed + kBlock * kSteps + (vector + v) * kLanes);
            for (int i = 0; i < kQueries; ++i) products[i][v] = sum;
        }
        packed += vector * kLanes * kSteps;
        for (int k = 0; k < kSteps; ++k) {
            __m512i four[kVectors];
            for (int v = 0; v < kVectors; ++v) four[v] = _mm512_loadu_si512(packed + (v * kSteps + k) * kLanes);
            for (int i = 0; i < kQueries; ++i) {
                const __m512i value = _mm512_set1_epi32(queries.values[i][k]);
                for (int v = 0; v < kVectors; ++v) products[i][v] = _mm512_dpbusd_epi32(products[i][v], four[v], value);
            }
        }
        for (int i = 0; i < kQueries; ++i)
            for (int v = 0; v < kVectors; ++v) found[i][v] = _mm512_cvtepi32_ps(products[i][v]);
    }
};

static_assert(ByteProducts::kBlock * (kDescriptor + 4) <= kNearestPacked, "scratch is too small");

void compare(const NearestJob& job, const NearestScratch& scratch) { compare_with<ByteProducts>(job, scratch); }

}  // namespace

extern const NearestKernels nearest_kernels = {compare};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
