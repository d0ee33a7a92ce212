// Adam, fused and row by row, so that rows that no photo saw cost nothing. Compiled once per ISA: internal linkage, no
// std templates.

#include "adam/adam.h"
#include "adam/adam_math.h"

namespace splat::SPLAT_ISA_NAMESPACE {
namespace {

constexpr unsigned kAllRows = (1u << kAdamBlock) - 1;
static_assert(kAdamBlock % kLanes == 0, "a block of any width is whole vectors");

// A block of rows of one tensor, in the tensor or in a copy.
struct Block {
    float *values, *mean, *square;
    const float *gradient, *rates;
};

// kLanes values starting at j; if lanes are given, only where those are set.
SPLAT_INLINE void step_lanes(const Block& b, int j, const AdamConstants& c, const Mask* lanes) {
    const AdamValues old = {load(b.values + j), load(b.mean + j), load(b.square + j)};
    AdamValues next = adam_step(c, load(b.rates + j), load(b.gradient + j), old);
    if (lanes) {
        next.mean = select(*lanes, next.mean, old.mean);
        next.square = select(*lanes, next.square, old.square);
        next.value = select(*lanes, next.value, old.value);
    }
    store(b.mean + j, next.mean), store(b.square + j, next.square), store(b.values + j, next.value);
}

// Steps the rows of a block whose bits are set.
SPLAT_INLINE void step_block(const Block& b, const AdamTensor& tensor, const AdamConstants& c, unsigned rows) {
    const int width = tensor.width, n = kAdamBlock * width;
    if (rows == kAllRows) {
        for (int j = 0; j < n; j += kLanes) step_lanes(b, j, c, nullptr);
    } else if (width % kLanes == 0) {
        for (int row = 0; row < kAdamBlock; ++row)
            if (rows >> row & 1u)
                for (int j = row * width; j < (row + 1) * width; j += kLanes) step_lanes(b, j, c, nullptr);
    } else {
        for (int j = 0; j < n; j += kLanes) {
            std::int32_t chosen[kLanes];
            for (int l = 0; l < kLanes; ++l) chosen[l] = rows >> tensor.row_of[j + l] & 1u;
            const Mask lanes = below(0, chosen);
            step_lanes(b, j, c, &lanes);
        }
    }
}

// Whether n values are finite: others, multiplied by zero, give NaN, which differs from itself.
bool all_finite(const float* p, int n) {
    Floats sum = {};
    int j = 0;
    for (; j + kLanes <= n; j += kLanes) sum += load(p + j) * 0.0f;
    float rest = 0.0f;
    for (int l = 0; l < kLanes; ++l) rest += sum[l];
    for (; j < n; ++j) rest += p[j] * 0.0f;
    return rest == 0.0f;
}

// Which of a block's `count` rows are stepped, as bits; counts those skipped for their gradients.
unsigned stepping_rows(const AdamJob& job, std::int64_t from, int count, std::int64_t* skipped) {
    unsigned rows = 0;
    for (int i = 0; i < count; ++i) rows |= unsigned(!job.visible || job.visible[from + i]) << i;
    if (!rows) return 0;
    bool finite = true;
    for (int t = 0; t < job.tensor_count; ++t) {
        const int width = job.tensors[t].width;
        finite = finite && all_finite(job.tensors[t].gradient + from * width, count * width);
    }
    if (finite) return rows;
    for (int i = 0; i < count; ++i) {
        if (!(rows >> i & 1u)) continue;
        bool row_finite = true;
        for (int t = 0; t < job.tensor_count; ++t) {
            const int width = job.tensors[t].width;
            row_finite = row_finite && all_finite(job.tensors[t].gradient + (from + i) * width, width);
        }
        if (row_finite) continue;
        rows &= ~(1u << i);
        ++*skipped;
    }
    return rows;
}

// The last, incomplete block: through a copy, so that nothing beyond the tensors is touched.
void step_last(const AdamTensor& tensor, std::int64_t from, int count, const AdamConstants& c, unsigned rows) {
    float values[kAdamBlock * kAdamWidth], mean[kAdamBlock * kAdamWidth], square[kAdamBlock * kAdamWidth];
    float gradient[kAdamBlock * kAdamWidth];
    const std::int64_t start = from * tensor.width;
    const int n = count * tensor.width;
    for (int j = 0; j < kAdamBlock * tensor.width; ++j) {
        const bool there = j < n;
        values[j] = there ? tensor.values[start + j] : 0.0f;
        mean[j] = there ? tensor.mean[start + j] : 0.0f;
        square[j] = there ? tensor.square[start + j] : 0.0f;
        gradient[j] = there ? tensor.gradient[start + j] : 0.0f;
    }
    step_block({values, mean, square, gradient, tensor.rates}, tensor, c, rows);
    for (int j = 0; j < n; ++j) {
        tensor.values[start + j] = values[j];
        tensor.mean[start + j] = mean[j];
        tensor.square[start + j] = square[j];
    }
}

// Tensor by tensor, each over all rows: a CPU prefetches no more than about four memory streams well.
std::int64_t adam_rows(const AdamJob& job, std::int64_t from, std::int64_t to) {
    const AdamConstants c = adam_constants(job.beta1, job.beta2, job.epsilon, job.inverse_root_correction);
    std::int64_t skipped = 0;
    unsigned stepping[kAdamTaskRows / kAdamBlock];
    for (std::int64_t row = from; row < to; row += kAdamBlock) {
        const int count = to - row < kAdamBlock ? int(to - row) : kAdamBlock;
        stepping[(row - from) / kAdamBlock] = stepping_rows(job, row, count, &skipped);
    }
    for (int t = 0; t < job.tensor_count; ++t) {
        const AdamTensor& tensor = job.tensors[t];
        for (std::int64_t row = from; row < to; row += kAdamBlock) {
            const unsigned rows = stepping[(row - from) / kAdamBlock];
            const std::int64_t at = row * tensor.width;
            if (!rows) continue;
            if (to - row < kAdamBlock)
                step_last(tensor, row, int(to - row), c, rows);
            else
                step_block(
                    {tensor.values + at, tensor.mean + at, tensor.square + at, tensor.gradient + at, tensor.rates},
                    tensor, c, rows);
        }
    }
    return skipped;
}

// The floats of a row, of a Gaussian's own parameters without a call.
SPLAT_INLINE void copy_row(float* to, const float* from, int width) {
    if (width == 1)
        to[0] = from[0];
    else if (width == 3)
        __builtin_memcpy(to, from, 3 * sizeof(float));
    else if (width == 4)
        __builtin_memcpy(to, from, 4 * sizeof(float));
    else
        __builtin_memcpy(to, from, static_cast<std::size_t>(width) * sizeof(float));
}

// Up to kAdamBlock scattered rows of one tensor: one by one if a row consists of whole vectors, otherwise through a
// copy of all.
void step_apart(const AdamTensor& tensor, const float* gradient, const std::int32_t* rows, int count,
                const AdamConstants& c, unsigned stepping) {
    const int width = tensor.width;
    if (width % kLanes == 0) {
        for (int i = 0; i < count; ++i) {
            if (!(stepping >> i & 1u)) continue;
            const std::int64_t at = std::int64_t{rows[i]} * width;
            const Block row{tensor.values + at, tensor.mean + at, tensor.square + at, gradient + i * width,
                            tensor.rates};
            for (int j = 0; j < width; j += kLanes) step_lanes(row, j, c, nullptr);
        }
        return;
    }
    constexpr int kRoom = kAdamBlock * kAdamWidth;
    float values[kRoom], mean[kRoom], square[kRoom];
    for (int i = 0; i < count; ++i) {
        const std::int64_t at = std::int64_t{rows[i] < 0 ? 0 : rows[i]} * width;
        copy_row(values + i * width, tensor.values + at, width), copy_row(mean + i * width, tensor.mean + at, width);
        copy_row(square + i * width, tensor.square + at, width);
    }
    const Block block{values, mean, square, gradient, tensor.rates};
    for (int j = 0; j < count * width; j += kLanes) step_lanes(block, j, c, nullptr);
    for (int i = 0; i < count; ++i) {
        if (!(stepping >> i & 1u)) continue;
        const std::int64_t at = std::int64_t{rows[i]} * width;
        copy_row(tensor.values + at, values + i * width, width), copy_row(tensor.mean + at, mean + i * width, width);
        copy_row(tensor.square + at, square + i * width, width);
    }
}

// Which of up to kAdamBlock scattered rows are stepped, as bits; counts those skipped for their gradients.
unsigned stepping_apart(const AdamJob& job, const std::int32_t* rows, int count, const float* const* gradients,
                        std::int64_t* skipped) {
    unsigned stepping = 0;
    bool all = true;  // their gradients lie side by side
    for (int t = 0; t < job.tensor_count; ++t) all = all && all_finite(gradients[t], count * job.tensors[t].width);
    for (int i = 0; i < count; ++i) {
        if (rows[i] < 0) continue;
        bool finite = true;
        for (int t = 0; t < job.tensor_count && !all; ++t) {
            const int width = job.tensors[t].width;
            finite = finite && all_finite(gradients[t] + i * width, width);
        }
        stepping |= unsigned(finite) << i;
        *skipped += !finite;
    }
    return stepping;
}

std::int64_t adam_some(const AdamJob& job, const std::int32_t* rows, int count, const float* const* gradients) {
    const AdamConstants c = adam_constants(job.beta1, job.beta2, job.epsilon, job.inverse_root_correction);
    std::int64_t skipped = 0;
    for (int from = 0; from < count; from += kAdamBlock) {
        const int here = count - from < kAdamBlock ? count - from : kAdamBlock;
        const float* of[kAdamTensors];
        for (int t = 0; t < job.tensor_count; ++t) of[t] = gradients[t] + from * job.tensors[t].width;
        const unsigned stepping = stepping_apart(job, rows + from, here, of, &skipped);
        const bool is_block =
            here == kAdamBlock && stepping == kAllRows && rows[from + kAdamBlock - 1] - rows[from] == kAdamBlock - 1;
        for (int t = 0; t < job.tensor_count && stepping; ++t) {
            const AdamTensor& tensor = job.tensors[t];
            const std::int64_t at = std::int64_t{rows[from]} * tensor.width;
            if (is_block)
                step_block({tensor.values + at, tensor.mean + at, tensor.square + at, of[t], tensor.rates}, tensor, c,
                           stepping);
            else
                step_apart(tensor, of[t], rows + from, here, c, stepping);
        }
    }
    return skipped;
}

}  // namespace

extern const AdamKernels adam_kernels = {adam_rows, adam_some};

}  // namespace splat::SPLAT_ISA_NAMESPACE
