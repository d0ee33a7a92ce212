#include "adam/adam_step.h"

#include <algorithm>
#include <cstddef>

#include "adam/adam_tables.h"
#include "base/threads.h"

namespace splat {

AdamTables::AdamTables(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
                       const AdamOptions& options) {
    const AdamCorrections corrections = corrections_of(options.beta1, options.beta2, options.step);
    for (const AdamRows& tensor : tensors) {
        const std::size_t width = static_cast<std::size_t>(tensor.width), n = kAdamBlock * width;
        rates_.emplace_back(n);
        row_of_.emplace_back(n);
        for (std::size_t i = 0, row = 0; row < kAdamBlock; ++row)
            for (std::size_t column = 0; column < width; ++column, ++i) {
                rates_.back()[i] = static_cast<float>(corrections.rate * tensor.rates[column]);
                row_of_.back()[i] = static_cast<std::int32_t>(row);
            }
        job_.tensors[job_.tensor_count++] = {tensor.values,        tensor.gradient,       tensor.mean, tensor.square,
                                             rates_.back().data(), row_of_.back().data(), tensor.width};
    }
    job_.rows = rows, job_.visible = visible;
    job_.beta1 = static_cast<float>(options.beta1), job_.beta2 = static_cast<float>(options.beta2);
    job_.epsilon = static_cast<float>(options.epsilon);
    job_.inverse_root_correction = corrections.inverse_root;
}

std::int64_t adam_step(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
                       const AdamOptions& options) {
    const AdamTables tables(tensors, rows, visible, options);
    const std::int64_t tasks = (rows + kAdamTaskRows - 1) / kAdamTaskRows;
    std::vector<std::int64_t> skipped(static_cast<std::size_t>(tasks));
    const AdamKernels& kernels = SPLAT_KERNELS(adam_kernels);
    parallel_for(tasks, [&](std::int64_t task) {
        const std::int64_t from = task * kAdamTaskRows, to = std::min(rows, from + kAdamTaskRows);
        skipped[static_cast<std::size_t>(task)] = kernels.rows(tables.job(), from, to);
    });
    std::int64_t total = 0;
    for (std::int64_t part : skipped) total += part;
    return total;
}

}  // namespace splat
