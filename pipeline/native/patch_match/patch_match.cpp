#include "patch_match/patch_match.h"

#include <cstddef>
#include <vector>

#include "base/threads.h"

namespace splat {

void patch_match(PatchJob job, int iterations) {
    std::vector<std::uint32_t> chosen(static_cast<std::size_t>(job.width) * static_cast<std::size_t>(job.height));
    job.chosen = chosen.data();
    const PatchKernels& kernels = SPLAT_KERNELS(patch_kernels);
    parallel_for(job.height, [&](std::int64_t row) { kernels.begin(job, static_cast<int>(row)); });
    for (int iteration = 0; iteration < iterations; ++iteration)
        for (int colour = 0; colour < 2; ++colour)
            parallel_for(job.height,
                         [&](std::int64_t row) { kernels.improve(job, static_cast<int>(row), colour, iteration); });
}

}  // namespace splat
