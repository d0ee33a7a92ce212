#include "descriptors/nearest.h"

#include <algorithm>
#include <cstdint>
#include <memory>
#include <new>

namespace splat {
namespace {

constexpr std::size_t kAlign = 64;

struct FreeAligned {
    void operator()(void* block) const { ::operator delete(block, std::align_val_t{kAlign}); }
};
using Aligned = std::unique_ptr<void, FreeAligned>;

Aligned aligned(std::int64_t bytes) {
    return Aligned(::operator new(static_cast<std::size_t>(bytes), std::align_val_t{kAlign}));
}

const NearestKernels& kernels() {
#if SPLAT_HAS_VNNI
    if (active_isa() == Isa::avx512 && __builtin_cpu_supports("avx512vnni")) return vnni::nearest_kernels;
#endif
    return SPLAT_KERNELS(nearest_kernels);
}

}  // namespace

void compare_groups(const NearestJob& all, const std::int64_t* query_bounds, const std::int64_t* value_bounds,
                    std::int64_t groups) {
    std::int64_t most = 0;
    for (std::int64_t g = 0; g < groups; ++g) most = std::max(most, query_bounds[g + 1] - query_bounds[g]);
    const Aligned state = aligned(std::max<std::int64_t>(most, 1) * kNearestState * sizeof(float));
    const Aligned packed = aligned(kNearestPacked), rows = aligned(kNearestRows * sizeof(float));
    const NearestScratch scratch{static_cast<float*>(state.get()), packed.get(), static_cast<float*>(rows.get())};
    const auto compare = kernels().compare;
    for (std::int64_t g = 0; g < groups; ++g) {
        const std::int64_t query = query_bounds[g], value = value_bounds[g];
        NearestJob job = all;
        job.queries += query * kDescriptor, job.values += value * kDescriptor;
        job.query_count = query_bounds[g + 1] - query, job.value_count = value_bounds[g + 1] - value;
        job.rows += query, job.best += query, job.second += query;
        if (job.query_count > 0 && job.value_count > 0) compare(job, scratch);
    }
}

}  // namespace splat
