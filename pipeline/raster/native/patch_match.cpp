#include "patch_match.h"

#include "threads.h"

namespace splat {

void patch_match(const PatchJob& job, int iterations) {
    const PatchKernels& kernels = SPLAT_KERNELS(patch_kernels);
    parallel_for(job.height, [&](std::int64_t row) { kernels.begin(job, static_cast<int>(row)); });
    for (int iteration = 0; iteration < iterations; ++iteration)
        for (int colour = 0; colour < 2; ++colour)
            parallel_for(job.height,
                         [&](std::int64_t row) { kernels.improve(job, static_cast<int>(row), colour, iteration); });
}

}  // namespace splat
