// Python faces of the loss and the optimiser: checks, tiles and threads around the kernels.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <tuple>
#include <vector>

#include "adam.h"
#include "loss.h"
#include "threads.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using Image = nb::ndarray<const float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using MutableImage = nb::ndarray<float, nb::shape<-1, -1, 3>, nb::c_contig, nb::device::cpu>;
using Mask = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<float, nb::c_contig, nb::device::cpu>;
using ConstRows = nb::ndarray<const float, nb::c_contig, nb::device::cpu>;
using Rates = nb::ndarray<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using RowMask = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

constexpr double kWindowSigma = 1.5;  // pixels

void require(bool holds, const char* message) {
    if (!holds) throw nb::value_error(message);
}

void set_taps(float* taps) {
    double weights[6], sum = 0.0;
    for (int d = 0; d < 6; ++d) {
        weights[d] = std::exp(-0.5 * d * d / (kWindowSigma * kWindowSigma));
        sum += d ? 2.0 * weights[d] : weights[d];
    }
    for (int d = 0; d < 6; ++d) taps[d] = static_cast<float>(weights[d] / sum);
}

float* thread_scratch() {
    constexpr std::size_t kAlignment = 64;
    thread_local std::unique_ptr<float[]> memory;
    if (!memory) memory = std::make_unique<float[]>(splat::kLossScratch + kAlignment / sizeof(float));
    void* start = memory.get();
    std::size_t space = splat::kLossScratch * sizeof(float) + kAlignment;
    return static_cast<float*>(std::align(kAlignment, splat::kLossScratch * sizeof(float), start, space));
}

// The render with masked pixels replaced by the photo's; how many pixels count goes to *counting.
std::unique_ptr<float[]> replace_masked(const splat::LossJob& job, std::int64_t* counting) {
    const std::size_t width = static_cast<std::size_t>(job.width);
    std::unique_ptr<float[]> replaced(new float[static_cast<std::size_t>(job.height) * width * 3]);
    std::vector<std::int64_t> counts(static_cast<std::size_t>(job.height));
    splat::parallel_for(job.height, [&](std::int64_t row) {
        std::int64_t count = 0;
        const std::size_t start = static_cast<std::size_t>(row) * width;
        for (std::size_t pixel = start; pixel < start + width; ++pixel) {
            const float* source = (job.mask[pixel] ? job.render : job.photo) + pixel * 3;
            for (int c = 0; c < 3; ++c) replaced[pixel * 3 + c] = source[c];
            count += job.mask[pixel] != 0;
        }
        counts[static_cast<std::size_t>(row)] = count;
    });
    *counting = 0;
    for (std::int64_t count : counts) *counting += count;
    return replaced;
}

// Tiles of a fixed division of the image, whatever the number of threads; their sums are added in order.
splat::LossSums run_tiles(const splat::LossJob& job) {
    const int down = (job.height + splat::kLossTileRows - 1) / splat::kLossTileRows;
    const int across = (job.width + splat::kLossTileCols - 1) / splat::kLossTileCols;
    std::vector<splat::LossSums> sums(static_cast<std::size_t>(down) * across);
    const splat::LossKernels& kernels = SPLAT_KERNELS(loss_kernels);
    splat::parallel_for(static_cast<std::int64_t>(sums.size()), [&](std::int64_t index) {
        const std::int64_t i = index / across, j = index % across;
        const auto cut = [](std::int64_t part, int length, int parts) {
            return static_cast<int>(part * length / parts);
        };
        const splat::LossTile tile{cut(i, job.height, down), cut(i + 1, job.height, down), cut(j, job.width, across),
                                   cut(j + 1, job.width, across)};
        sums[static_cast<std::size_t>(index)] = kernels.tile(job, tile, thread_scratch());
    });
    splat::LossSums total{0.0, 0.0};
    for (const splat::LossSums& part : sums) total.l1 += part.l1, total.dissimilarity += part.dissimilarity;
    return total;
}

double photo_loss(const Image& render, const Image& photo, const std::optional<Mask>& mask, double ssim_weight,
                  const MutableImage& gradient) {
    const std::size_t height = render.shape(0), width = render.shape(1);
    require(photo.shape(0) == height && photo.shape(1) == width, "render and photo differ in size");
    require(gradient.shape(0) == height && gradient.shape(1) == width, "render and gradient differ in size");
    require(!mask || (mask->shape(0) == height && mask->shape(1) == width), "render and mask differ in size");
    require(height >= splat::kLossMinSide && width >= splat::kLossMinSide, "the loss needs 6 pixels a side");
    require(height <= INT32_MAX / 4 && width <= INT32_MAX / 4, "the image is too large");
    nb::gil_scoped_release release;
    splat::LossJob job{};
    job.render = render.data(), job.photo = photo.data(), job.gradient = gradient.data();
    job.mask = mask ? mask->data() : nullptr;
    job.height = static_cast<int>(height), job.width = static_cast<int>(width);
    set_taps(job.taps);
    std::int64_t counting = static_cast<std::int64_t>(height * width);
    std::unique_ptr<float[]> replaced;
    if (mask) {
        replaced = replace_masked(job, &counting);
        job.render = replaced.get();
    }
    const double each = counting ? 1.0 / (3.0 * static_cast<double>(counting)) : 0.0;
    job.l1_scale = static_cast<float>((1.0 - ssim_weight) * each);
    job.ssim_scale = static_cast<float>(ssim_weight * each);
    const splat::LossSums sums = run_tiles(job);
    return each * ((1.0 - ssim_weight) * sums.l1 + ssim_weight * sums.dissimilarity);
}

struct AdamOptions {
    double beta1, beta2, epsilon;
    std::int64_t step;
};

// A block's step sizes and row numbers for each tensor, which the job points into.
struct AdamTables {
    std::vector<std::vector<float>> rates;
    std::vector<std::vector<std::int32_t>> row_of;

    void add(const float* rates_of_columns, int width, double scale) {
        const std::size_t n = static_cast<std::size_t>(splat::kAdamBlock) * width;
        rates.emplace_back(n);
        row_of.emplace_back(n);
        for (std::size_t i = 0; i < n; ++i) {
            rates.back()[i] = static_cast<float>(scale * rates_of_columns[i % width]);
            row_of.back()[i] = static_cast<std::int32_t>(i / width);
        }
    }
};

std::int64_t adam_step(const std::vector<Rows>& values, const std::vector<ConstRows>& gradients,
                       const std::vector<Rows>& means, const std::vector<Rows>& squares,
                       const std::vector<Rates>& rates, const std::optional<RowMask>& visible,
                       const AdamOptions& options) {
    const std::size_t count = values.size();
    require(count <= splat::kAdamTensors, "too many tensors");
    require(gradients.size() == count && means.size() == count && squares.size() == count && rates.size() == count,
            "not as many gradients, moments and rates as tensors");
    require(options.step >= 1, "steps count from 1");
    splat::AdamJob job{};
    AdamTables tables;
    job.rows = count && values[0].ndim() ? static_cast<std::int64_t>(values[0].shape(0)) : 0;
    require(!visible || static_cast<std::int64_t>(visible->shape(0)) == job.rows, "visible has another number of rows");
    if (!job.rows) return 0;
    const double step = static_cast<double>(options.step);
    const double step_scale = 1.0 / (1.0 - std::pow(options.beta1, step));
    for (std::size_t t = 0; t < count; ++t) {
        const std::size_t size = values[t].size(), width = rates[t].shape(0);
        require(width >= 1 && width <= splat::kAdamWidth, "a row has 1 to 64 values");
        require(size == static_cast<std::size_t>(job.rows) * width, "rows or rates differ between tensors");
        require(gradients[t].size() == size && means[t].size() == size && squares[t].size() == size,
                "a gradient or moment differs in size from its tensor");
        tables.add(rates[t].data(), static_cast<int>(width), step_scale);
        job.tensors[t] = {values[t].data(),       gradients[t].data(),        means[t].data(),
                          squares[t].data(),      tables.rates.back().data(), tables.row_of.back().data(),
                          static_cast<int>(width)};
    }
    job.tensor_count = static_cast<int>(count);
    job.visible = visible ? visible->data() : nullptr;
    job.beta1 = static_cast<float>(options.beta1), job.beta2 = static_cast<float>(options.beta2);
    job.epsilon = static_cast<float>(options.epsilon);
    job.inverse_root_correction = static_cast<float>(1.0 / std::sqrt(1.0 - std::pow(options.beta2, step)));
    nb::gil_scoped_release release;
    const std::int64_t tasks = (job.rows + splat::kAdamTaskRows - 1) / splat::kAdamTaskRows;
    std::vector<std::int64_t> skipped(static_cast<std::size_t>(tasks));
    const splat::AdamKernels& kernels = SPLAT_KERNELS(adam_kernels);
    splat::parallel_for(tasks, [&](std::int64_t task) {
        const std::int64_t from = task * splat::kAdamTaskRows,
                           to = from + splat::kAdamTaskRows < job.rows ? from + splat::kAdamTaskRows : job.rows;
        skipped[static_cast<std::size_t>(task)] = kernels.rows(job, from, to);
    });
    std::int64_t total = 0;
    for (std::int64_t part : skipped) total += part;
    return total;
}

}  // namespace

void bind_loss(nb::module_& m) {
    m.def("photo_loss", &photo_loss, "render"_a.noconvert(), "photo"_a.noconvert(), "mask"_a.noconvert().none(),
          "ssim_weight"_a, "gradient"_a.noconvert(),
          "(1 - w) L1 + w (1 - SSIM) of two (h, w, 3) images; its gradient by the render goes to `gradient`.");
    m.def(
        "adam_step",
        [](const std::vector<Rows>& values, const std::vector<ConstRows>& gradients, const std::vector<Rows>& means,
           const std::vector<Rows>& squares, const std::vector<Rates>& rates, const std::optional<RowMask>& visible,
           std::tuple<double, double, double, std::int64_t> options) {
            const auto [beta1, beta2, epsilon, step] = options;
            return adam_step(values, gradients, means, squares, rates, visible, {beta1, beta2, epsilon, step});
        },
        "values"_a.noconvert(), "gradients"_a.noconvert(), "means"_a.noconvert(), "squares"_a.noconvert(),
        "rates"_a.noconvert(), "visible"_a.noconvert().none(), "options"_a,
        "One Adam step in place; options: (beta1, beta2, epsilon, step). Returns the rows left out for their "
        "gradients.");
}
