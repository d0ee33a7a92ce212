#include "raster/raster_cpu.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "adam/adam_tables.h"
#include "base/threads.h"
#include "raster/view.h"

namespace splat {
namespace {

constexpr int64_t kGaussiansATask = 8192;  // in the search for candidates: about 20 µs

// The gradients of a few candidates, row by row.
struct BackRows {
    float means[3 * kBackRows], log_scales[3 * kBackRows], quats[4 * kBackRows], opacity_logits[kBackRows];
    float sh[3 * kMaxShCount * kBackRows], means2d[2 * kBackRows];

    ParameterGradients gradients() { return {means, log_scales, quats, opacity_logits, sh, means2d}; }
};

// body(gradients, widths) of each of them and its floats a row.
template <class Body>
void for_gradients(const ParameterGradients& all, int sh_row, const Body& body) {
    body(all.means, 3), body(all.log_scales, 3), body(all.quats, 4), body(all.opacity_logits, 1);
    body(all.sh, sh_row), body(all.means2d, 2);
}

void zero_rows(const ParameterGradients& out, int sh_row, int64_t begin, int64_t end) {
    for_gradients(out, sh_row, [&](float* to, int width) { std::fill(to + begin * width, to + end * width, 0.0f); });
}

void copy_row(const ParameterGradients& from, int64_t from_row, int sh_row, int64_t row, const ParameterGradients& to) {
    const auto copy = [&](float* out, const float* in, int width) {
        std::copy_n(in + from_row * width, width, out + row * width);
    };
    copy(to.means, from.means, 3), copy(to.log_scales, from.log_scales, 3), copy(to.quats, from.quats, 4);
    copy(to.opacity_logits, from.opacity_logits, 1), copy(to.sh, from.sh, sh_row), copy(to.means2d, from.means2d, 2);
}

// Between gradients and their step: applies the gain of the rendered logits, and writes the values for density control
// from index `at` on. Returns the next index.
int64_t end_gradients(const FrameStep& step, const int32_t* rows, int count, int64_t at, BackRows* back) {
    for (int i = 0; i < count; ++i) {
        if (rows[i] < 0) continue;
        if (step.logit_gain) back->opacity_logits[i] *= step.logit_gain[rows[i]];
        if (!step.seen) continue;
        step.seen[at] = rows[i];
        std::copy_n(back->means2d + 2 * i, 2, step.means2d + 2 * at++);
    }
    return at;
}

void hold_scales(const FrameStep& step, const int32_t* rows, int count) {
    float* const values = step.tensors[1].values;
    for (int i = 0; i < count; ++i)
        for (int axis = 0; axis < 3 && rows[i] >= 0; ++axis) {
            float& value = values[3 * int64_t{rows[i]} + axis];  // a NaN stays one
            value = value < step.log_scale_min ? step.log_scale_min : value;
            value = value > step.log_scale_max ? step.log_scale_max : value;
        }
}

// Lengthens the steps of those of some rows that were far from the camera before; the same operations, in the same
// order, as in step_lengths.py.
void lengthen_steps(const FrameStep& step, const int32_t* rows, int count, const float* before) {
    constexpr float kNoDistance = 1e-30f;
    for (int i = 0; i < count; ++i, before += 3) {
        if (rows[i] < 0) continue;
        float ray[3];
        for (int axis = 0; axis < 3; ++axis) ray[axis] = before[axis] - step.far.centre[axis];
        const float distance = std::sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]);
        if (!(distance > step.far.unit)) continue;
        float* const value = step.tensors[0].values + 3 * int64_t{rows[i]};
        const float factor = distance / step.far.unit;
        float moved[3];
        for (int axis = 0; axis < 3; ++axis) {
            moved[axis] = (value[axis] - before[axis]) * factor;
            ray[axis] /= std::max(distance, kNoDistance);
        }
        const float along = (moved[0] * ray[0] + moved[1] * ray[1] + moved[2] * ray[2]) * (factor - 1.0f);
        for (int axis = 0; axis < 3; ++axis) value[axis] = before[axis] + moved[axis] + along * ray[axis];
    }
}

// Prefetches rows that are stepped soon: a CPU cannot predict where they are.
void fetch_moments(const AdamJob& job, const int32_t* rows, int count) {
    constexpr int kLineFloats = 16;
    for (int t = 0; t < job.tensor_count; ++t) {
        const AdamTensor& tensor = job.tensors[t];
        for (int i = 0; i < count; ++i)
            for (int f = 0; f < tensor.width; f += kLineFloats) {
                __builtin_prefetch(tensor.mean + int64_t{rows[i]} * tensor.width + f, 1);
                __builtin_prefetch(tensor.square + int64_t{rows[i]} * tensor.width + f, 1);
            }
    }
}

}  // namespace

void RasterFrame::forward(const View& view, const Parameters& in, const Pictures& out, float* radii, uint8_t* visible) {
    view_ = view;
    project_ = &SPLAT_KERNELS(project_kernels), blend_ = &SPLAT_KERNELS(blend_kernels);
    const int tiles = view.tiles_x * view.tiles_y;
    data_.transmittance = transmittance_.reserve(int64_t{tiles} * kTilePixels);
    data_.pixel_end = pixel_end_.reserve(int64_t{tiles} * kTilePixels);
    find_candidates(in, radii, visible);
    lists_.place(candidates_, &data_,
                 [&](int64_t begin, int64_t end) { project_->project(view_, in, begin, end, data_, radii, visible); });
    lists_.make(view_, *project_, &data_);
    data_.pair_blocks = pair_blocks_.reserve(lists_.pairs() * blend_->mask_bytes);
    parallel_for(tiles, [&](int64_t tile) { blend_->blend_tile(view_, data_, static_cast<int>(tile), out); });
}

void RasterFrame::blend_backward(const PictureGradients& gradients, bool magnitudes) {
    magnitudes_ = magnitudes;
    data_.slot_floats = gradients.depth_sum || gradients.depth_square_sum ? kDepthSlotFloats : kSlotFloats;
    data_.slots = slots_.reserve(lists_.pairs() * data_.slot_floats);
    parallel_for(view_.tiles_x * view_.tiles_y, [&](int64_t tile) {
        blend_->blend_tile_backward(view_, data_, static_cast<int>(tile), gradients, magnitudes);
    });
}

void RasterFrame::project_backward(const Parameters& in, const ParameterGradients& out) {
    const int sh_row = 3 * view_.sh_count;
    if (candidates_ == 0) zero_rows(out, sh_row, 0, in.count);
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        BackRows back;
        const ParameterGradients made = back.gradients();
        int64_t next = task == 0 ? 0 : data_.rows[begin];  // row to be written
        for (int64_t first = begin; first < end; first += kBackRows) {
            const int64_t last = std::min(end, first + kBackRows);
            project_->project_backward(view_, in, first, last, data_, magnitudes_, made);
            for (int64_t i = first; i < last; ++i) {
                const int64_t row = data_.rows[i];
                zero_rows(out, sh_row, next, row);
                copy_row(made, i - first, sh_row, row, out);
                next = row + 1;
            }
        }
        zero_rows(out, sh_row, next, end == candidates_ ? in.count : data_.rows[end]);
    });
}

int64_t RasterFrame::step(const Parameters& in, const FrameStep& step) {
    const AdamTables adam(step.tensors, step.count, nullptr, step.options);
    const AdamKernels& kernels = SPLAT_KERNELS(adam_kernels);
    std::vector<int64_t> skipped(static_cast<std::size_t>(divide_up(candidates_, kCandidatesATask)));
    for_tasks(candidates_, kCandidatesATask, [&](int64_t task, int64_t begin, int64_t end) {
        BackRows back;
        const float* gradients[] = {back.means, back.log_scales, back.quats, back.opacity_logits, back.sh};
        int64_t at = lists_.visible_before(task);
        for (int64_t first = begin; first < end && data_.rows[first] < step.count; first += kBackRows) {
            int count = static_cast<int>(std::min(end - first, int64_t{kBackRows}));
            while (data_.rows[first + count - 1] >= step.count) --count;
            fetch_moments(adam.job(), data_.rows + first, count);
            project_->project_backward(view_, in, first, first + count, data_, magnitudes_, back.gradients());
            int32_t rows[kBackRows];
            for (int i = 0; i < count; ++i) rows[i] = data_.keys[first + i] == kCulled ? -1 : data_.rows[first + i];
            at = end_gradients(step, rows, count, at, &back);
            float before[3 * kBackRows];
            for (int i = 0; i < count; ++i)
                std::copy_n(step.tensors[0].values + 3 * int64_t{data_.rows[first + i]}, 3, before + 3 * i);
            skipped[static_cast<std::size_t>(task)] += kernels.some(adam.job(), rows, count, gradients);
            lengthen_steps(step, rows, count, before);
            hold_scales(step, rows, count);
        }
    });
    int64_t total = 0;
    for (int64_t part : skipped) total += part;
    return total;
}

int64_t RasterFrame::contributions() const {
    int64_t count = 0;
    for (int tile = 0; tile < view_.tiles_x * view_.tiles_y; ++tile)
        count += blend_->count_contributions(view_, data_, tile);
    return count;
}

// The rows of Gaussians that may be visible, ascending; radii and visible are first cleared for all.
void RasterFrame::find_candidates(const Parameters& in, float* radii, uint8_t* visible) {
    const int64_t tasks = divide_up(in.count, kGaussiansATask);
    int64_t* counts = found_counts_.reserve(tasks);
    int32_t* found = found_rows_.reserve(in.count);
    for_tasks(in.count, kGaussiansATask, [&](int64_t task, int64_t begin, int64_t end) {
        counts[task] = project_->find_candidates(view_, in, begin, end, found + begin);
        std::fill(radii + begin, radii + end, 0.0f), std::fill(visible + begin, visible + end, uint8_t{0});
    });
    candidates_ = 0;
    for (int64_t task = 0; task < tasks; ++task) candidates_ += counts[task];
    int32_t* rows = candidate_rows_.reserve(candidates_);
    data_.rows = rows;
    for (int64_t task = 0; task < tasks; ++task) rows = std::copy_n(found + task * kGaussiansATask, counts[task], rows);
}

namespace {

Shelf<RasterFrame>& shelf = *new Shelf<RasterFrame>;  // never destroyed: a frame may be returned while the process ends

}  // namespace

std::shared_ptr<RasterFrame> borrow_frame() { return shelf.borrow(); }

void free_frames() { shelf.clear(); }

}  // namespace splat
