#include "adam_step.h"

#include <algorithm>
#include <cstddef>

#include "adam.h"
#include "threads.h"

namespace splat {
namespace {

// A block's step sizes and row numbers for each tensor, which the job points into.
struct AdamTables {
    std::vector<std::vector<float>> rates;
    std::vector<std::vector<std::int32_t>> row_of;

    void add(const float* rates_of_columns, int width, double scale) {
        const std::size_t n = static_cast<std::size_t>(kAdamBlock) * width;
        rates.emplace_back(n);
        row_of.emplace_back(n);
        for (std::size_t i = 0; i < n; ++i) {
            rates.back()[i] = static_cast<float>(scale * rates_of_columns[i % width]);
            row_of.back()[i] = static_cast<std::int32_t>(i / width);
        }
    }
};

}  // namespace

std::int64_t adam_step(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
                       const AdamOptions& options) {
    AdamJob job{};
    AdamTables tables;
    const AdamCorrections corrections = corrections_of(options.beta1, options.beta2, options.step);
    for (const AdamRows& tensor : tensors) {
        tables.add(tensor.rates, tensor.width, corrections.rate);
        job.tensors[job.tensor_count++] = {tensor.values,
                                           tensor.gradient,
                                           tensor.mean,
                                           tensor.square,
                                           tables.rates.back().data(),
                                           tables.row_of.back().data(),
                                           tensor.width};
    }
    job.rows = rows, job.visible = visible;
    job.beta1 = static_cast<float>(options.beta1), job.beta2 = static_cast<float>(options.beta2);
    job.epsilon = static_cast<float>(options.epsilon);
    job.inverse_root_correction = corrections.inverse_root;
    const std::int64_t tasks = (rows + kAdamTaskRows - 1) / kAdamTaskRows;
    std::vector<std::int64_t> skipped(static_cast<std::size_t>(tasks));
    const AdamKernels& kernels = SPLAT_KERNELS(adam_kernels);
    parallel_for(tasks, [&](std::int64_t task) {
        const std::int64_t from = task * kAdamTaskRows, to = std::min(rows, from + kAdamTaskRows);
        skipped[static_cast<std::size_t>(task)] = kernels.rows(job, from, to);
    });
    std::int64_t total = 0;
    for (std::int64_t part : skipped) total += part;
    return total;
}

}  // namespace splat
