#include "loss/photo_loss.h"

#include <cstddef>
#include <memory>
#include <vector>

#include "base/threads.h"
#include "loss/loss.h"
#include "loss/loss_math.h"

namespace splat {
namespace {

float* thread_scratch() {
    constexpr std::size_t kAlignment = 64;
    thread_local std::unique_ptr<float[]> memory;
    if (!memory) memory = std::make_unique<float[]>(kLossScratch + kAlignment / sizeof(float));
    void* start = memory.get();
    std::size_t space = kLossScratch * sizeof(float) + kAlignment;
    return static_cast<float*>(std::align(kAlignment, kLossScratch * sizeof(float), start, space));
}

bool is_row_of(const LossTile& tile, std::int64_t row) { return row >= tile.row0 && row < tile.row1; }

// The render with masked pixels replaced by the photo's; how many pixels count goes to *counting.
std::unique_ptr<float[]> replace_masked(const LossJob& job, std::int64_t* counting) {
    const std::size_t width = static_cast<std::size_t>(job.width);
    std::unique_ptr<float[]> replaced(new float[static_cast<std::size_t>(job.height) * width * 3]);
    std::vector<std::int64_t> counts(static_cast<std::size_t>(job.height));
    parallel_for(job.height, [&](std::int64_t row) {
        std::int64_t count = 0;
        const std::size_t start = static_cast<std::size_t>(row) * width;
        for (std::size_t pixel = start; pixel < start + width; ++pixel) {
            const float* source = (job.mask[pixel] ? job.render : job.photo) + pixel * 3;
            for (int c = 0; c < 3; ++c) replaced[pixel * 3 + c] = source[c];
        }
        if (is_row_of(job.inner, row))
            for (int col = job.inner.col0; col < job.inner.col1; ++col)
                count += job.mask[start + static_cast<std::size_t>(col)] != 0;
        counts[static_cast<std::size_t>(row)] = count;
    });
    *counting = 0;
    for (std::int64_t count : counts) *counting += count;
    return replaced;
}

// Tiles of a fixed division of the image, whatever the number of threads; their sums are added in order.
LossSums run_tiles(const LossJob& job) {
    const int down = (job.height + kLossTileRows - 1) / kLossTileRows;
    const int across = (job.width + kLossTileCols - 1) / kLossTileCols;
    std::vector<LossSums> sums(static_cast<std::size_t>(down) * across);
    const LossKernels& kernels = SPLAT_KERNELS(loss_kernels);
    parallel_for(static_cast<std::int64_t>(sums.size()), [&](std::int64_t index) {
        const std::int64_t i = index / across, j = index % across;
        const auto cut = [](std::int64_t part, int length, int parts) {
            return static_cast<int>(part * length / parts);
        };
        const LossTile tile{cut(i, job.height, down), cut(i + 1, job.height, down), cut(j, job.width, across),
                            cut(j + 1, job.width, across)};
        sums[static_cast<std::size_t>(index)] = kernels.tile(job, tile, thread_scratch());
    });
    LossSums total{0.0, 0.0};
    for (const LossSums& part : sums) total.l1 += part.l1, total.dissimilarity += part.dissimilarity;
    return total;
}

}  // namespace

double photo_loss(const LossImages& images, double ssim_weight) {
    LossJob job{};
    job.render = images.render, job.photo = images.photo, job.mask = images.mask, job.gradient = images.gradient;
    job.height = images.height, job.width = images.width;
    set_loss_taps(job.taps);
    const LossRectangle& inner = images.inner;
    job.inner = {inner.top, inner.bottom, inner.left, inner.right};
    std::int64_t counting = std::int64_t{inner.bottom - inner.top} * (inner.right - inner.left);
    std::unique_ptr<float[]> replaced;
    if (job.mask) {
        replaced = replace_masked(job, &counting);
        job.render = replaced.get();
    }
    const double each = counting ? 1.0 / (3.0 * static_cast<double>(counting)) : 0.0;
    job.l1_scale = static_cast<float>((1.0 - ssim_weight) * each);
    job.ssim_scale = static_cast<float>(ssim_weight * each);
    const LossSums sums = run_tiles(job);
    return each * ((1.0 - ssim_weight) * sums.l1 + ssim_weight * sums.dissimilarity);
}

}  // namespace splat
