// What the kernels of nearest.h share, whichever instructions multiply. No std templates, internal linkage.
#pragma once

#include <string.h>

#include "base/simd.h"
#include "descriptors/nearest.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

static_assert(3 * kLanes <= kNearestState && kLanes * kDescriptor <= kNearestRows, "scratch is too small");

// What is known of a query in each lane: the largest product, the next, and the row of the largest.
struct State {
    Floats best, second, row;

    SPLAT_METHOD static State at(const float* p) { return {load(p), load(p + kLanes), load(p + 2 * kLanes)}; }
    SPLAT_METHOD void to(float* p) const { store(p, best), store(p + kLanes, second), store(p + 2 * kLanes, row); }
    SPLAT_METHOD void add(Floats found, Floats rows) {
        row = select(less(best, found), rows, row);
        second = max(second, min(best, found));
        best = max(best, found);
    }
};

SPLAT_INLINE Floats lane_numbers() {
    float numbers[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) numbers[lane] = static_cast<float>(lane);
    return load(numbers);
}

// The result of a query from its lanes.
SPLAT_INLINE void finish(const float* state, const NearestJob& job, int64_t query) {
    float best = -1.0f, second = 0.0f, row = 0.0f;
    for (int lane = 0; lane < kLanes; ++lane) {
        const float theirs = state[lane], next = state[kLanes + lane], number = state[2 * kLanes + lane];
        const float less_of_both = theirs < best ? theirs : best;
        second = next > second ? next : second;
        second = less_of_both > second ? less_of_both : second;
        if (theirs > best || (theirs == best && number < row)) best = theirs, row = number;
    }
    job.rows[query] = static_cast<int64_t>(row);
    job.best[query] = static_cast<int32_t>(best);
    job.second[query] = static_cast<int32_t>(second);
}

// Block after block of values, packed for the multiplication; in each, a few queries at a time. Values that fill up a
// block are zeros: no product is smaller, and their rows are larger.
//
// Products has: kQueries, kVectors, kBlock; pack(values, count, scratch); Queries(first, count);
// multiply(queries, scratch, vector, found).
template <class Products>
SPLAT_INLINE void compare_with(const NearestJob& job, const NearestScratch& scratch) {
    constexpr int kQueries = Products::kQueries, kVectors = Products::kVectors, kBlock = Products::kBlock;
    constexpr int kColumns = kVectors * kLanes;
    static_assert(kBlock % kColumns == 0, "a block is of whole tiles");
    const State none{fill(-1.0f), fill(0.0f), fill(0.0f)};
    for (int64_t q = 0; q < job.query_count; ++q) none.to(scratch.state + q * kNearestState);
    const Floats lanes = lane_numbers();
    for (int64_t start = 0; start < job.value_count; start += kBlock) {
        const int64_t left = job.value_count - start;
        const int count = left < kBlock ? static_cast<int>(left) : kBlock;
        Products::pack(job.values + start * kDescriptor, count, scratch);
        for (int64_t q = 0; q < job.query_count; q += kQueries) {
            const int here = job.query_count - q < kQueries ? static_cast<int>(job.query_count - q) : kQueries;
            const typename Products::Queries queries(job.queries + q * kDescriptor, here);
            for (int column = 0; column < count; column += kColumns) {
                Floats found[kQueries][kVectors];
                Products::multiply(queries, scratch, column / kLanes, found);
                const Floats first = fill(static_cast<float>(start + column)) + lanes;
                for (int i = 0; i < here; ++i) {
                    float* place = scratch.state + (q + i) * kNearestState;
                    State state = State::at(place);
                    for (int v = 0; v < kVectors; ++v)
                        state.add(found[i][v], first + fill(static_cast<float>(v * kLanes)));
                    state.to(place);
                }
            }
        }
    }
    for (int64_t q = 0; q < job.query_count; ++q) finish(scratch.state + q * kNearestState, job, q);
}

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
