// The nearest and the second nearest of many descriptors by their products, which are whole numbers below 2^23 and so
// exact in floats: the same on every CPU. Kernels, compiled once per ISA, and the driver.
#pragma once

#include <cstdint>

#include "base/isa.h"

namespace splat {

constexpr int kDescriptor = 128;
constexpr std::int64_t kNearestMost = 1 << 24;  // descriptors that are compared at once: rows are kept as floats

// Where a kernel works.
constexpr int kNearestState = 3 * 16;                    // floats a query
constexpr std::int64_t kNearestPacked = 64 * 1024;       // bytes, aligned to 64
constexpr std::int64_t kNearestRows = 16 * kDescriptor;  // floats, likewise

// Queries, and the values that each is compared with.
struct NearestJob {
    const std::uint8_t* queries;  // (query_count, kDescriptor)
    std::int64_t query_count;
    const std::uint8_t* values;  // (value_count, kDescriptor), at least one
    std::int64_t value_count;
    std::int64_t* rows;    // of the nearest value, the first of equal ones, for each query
    std::int32_t* best;    // its product
    std::int32_t* second;  // the largest product of the others; 0 without any
};

struct NearestScratch {
    float* state;  // kNearestState for each query
    void* packed;
    float* rows;
};

struct NearestKernels {
    void (*compare)(const NearestJob& job, const NearestScratch& scratch);
};

// Compare groups of queries with groups of values: the rows between two bounds with those between the same two. Rows
// count from the group's start. A group without values leaves its queries' results alone.
void compare_groups(const NearestJob& all, const std::int64_t* query_bounds, const std::int64_t* value_bounds,
                    std::int64_t groups);

}  // namespace splat

SPLAT_DECLARE_KERNELS(NearestKernels, nearest_kernels)
#if SPLAT_HAS_VNNI || SPLAT_ISA_VNNI
namespace splat::vnni {
extern const NearestKernels nearest_kernels;
}
#endif
