#include "sky/sky_behind.h"

#include <cstddef>
#include <cstdint>
#include <vector>

#include "base/threads.h"

namespace splat {
namespace {

int bands_of(const SkyJob& job) { return (job.height + job.step - 1) / job.step; }

}  // namespace

bool is_sound(const SkyJob& job) {
    const bool has_step = job.step >= 1 && job.step <= kSkyMostStep;
    const bool reaches = has_step && job.rows >= 1 && job.columns >= 1 &&
                         std::int64_t{job.rows - 1} * job.step >= job.height - 1 &&
                         std::int64_t{job.columns - 1} * job.step >= job.width - 1;
    return reaches && (!job.elsewhere || job.around);
}

void lay_over(const SkyJob& job, float* out) {
    const SkyKernels& kernels = SPLAT_KERNELS(sky_kernels);
    parallel_for(bands_of(job), [&](std::int64_t band) { kernels.forward(job, static_cast<int>(band), out); });
}

void lay_over_backward(const SkyJob& job, const float* upstream, float* alpha_gradient, float* node_gradient) {
    const SkyKernels& kernels = SPLAT_KERNELS(sky_kernels);
    const int bands = bands_of(job);
    const std::size_t line = static_cast<std::size_t>(job.columns) * 3;
    std::vector<float> shares(node_gradient ? static_cast<std::size_t>(bands) * 2 * line : 0);
    parallel_for(bands, [&](std::int64_t band) {
        float* own = node_gradient ? shares.data() + static_cast<std::size_t>(band) * 2 * line : nullptr;
        kernels.backward(job, static_cast<int>(band), upstream, alpha_gradient, own);
    });
    if (!node_gradient) return;
    for (int row = 0; row < job.rows; ++row)  // each from the band below it and the one above
        for (std::size_t i = 0; i < line; ++i) {
            const std::size_t at = static_cast<std::size_t>(row) * 2 * line + i;
            const float below = row < bands ? shares[at] : 0.0f;
            const float above = row >= 1 && row <= bands ? shares[at - line] : 0.0f;
            node_gradient[static_cast<std::size_t>(row) * line + i] = below + above;
        }
}

}  // namespace splat
