// From Gaussians to splats and back, a Gaussian a lane. Compiled once per ISA (see isa.h for what that forbids).
#include "splat_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kMaxShFloats = (kMaxSh * 3 + kLanes - 1) / kLanes * kLanes;  // a Gaussian, to whole vectors

// The rows of a vector of Gaussians: pointers to the first, into the caller's arrays or, at the ragged end, to padded
// copies.
struct Rows {
    const float *means, *log_scales, *quats, *opacity_logits, *sh;
    float padding[kLanes * (3 + 3 + 4 + 1 + kMaxSh * 3)];
};

const float* padded(const float* from, int row, int64_t first, int valid, float** to) {
    float* copy = *to;
    *to += kLanes * row;
    for (int i = 0; i < kLanes * row; ++i) copy[i] = i < valid * row ? from[first * row + i] : 0.0f;
    return copy;
}

SPLAT_INLINE void find_rows(const Parameters& in, int sh_row, int64_t first, int valid, Rows* rows) {
    if (valid == kLanes) {
        rows->means = in.means + first * 3, rows->log_scales = in.log_scales + first * 3;
        rows->quats = in.quats + first * 4, rows->opacity_logits = in.opacity_logits + first;
        rows->sh = in.sh + first * sh_row;
        return;
    }
    float* to = rows->padding;
    rows->means = padded(in.means, 3, first, valid, &to);
    rows->log_scales = padded(in.log_scales, 3, first, valid, &to);
    rows->quats = padded(in.quats, 4, first, valid, &to);
    rows->opacity_logits = padded(in.opacity_logits, 1, first, valid, &to);
    rows->sh = padded(in.sh, sh_row, first, valid, &to);
}

SPLAT_INLINE Lanes load_lanes(const Rows& rows) {
    Lanes lanes;
    load_rgb(rows.means, &lanes.mean.x, &lanes.mean.y, &lanes.mean.z);
    load_rgb(rows.log_scales, &lanes.log_scale.x, &lanes.log_scale.y, &lanes.log_scale.z);
    Floats quats[kLanes];
    load_columns(rows.quats, 4, 4, quats);
    lanes.qw = quats[0], lanes.qx = quats[1], lanes.qy = quats[2], lanes.qz = quats[3];
    lanes.logit = load(rows.opacity_logits);
    return lanes;
}

// Coefficients that count, (k, rgb) vectors.
SPLAT_INLINE void load_sh(const View& view, const Rows& rows, Floats* sh) {
    load_columns(rows.sh, view.sh_count * 3, sh_basis_size(view.sh_degree) * 3, sh);
}

// Splat's fields as vectors, in the order of the struct, then the first and last tile rows.
constexpr int kFields = 18;

SPLAT_INLINE void put_fields(const SplatLanes& s, float (*fields)[kLanes]) {
    const Floats values[kFields] = {s.x,        s.y,        s.a,        s.b,       s.c,         s.log2_opacity,
                                    s.colour.x, s.colour.y, s.colour.z, s.depth,   s.slope,     s.inv_a,
                                    s.reach,    s.rows_dy,  s.depth_u,  s.depth_v, s.first_row, s.last_row};
    for (int i = 0; i < kFields; ++i) store(fields[i], values[i]);
}

void project(const View& view, const Parameters& in, int64_t begin, int64_t end, const FrameData& frame, float* radii,
             uint8_t* visible) {
    Rows rows;
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        find_rows(in, view.sh_count * 3, first, valid, &rows);
        const Lanes lanes = load_lanes(rows);
        const Projection p = project_lanes(view, lanes);
        uint32_t seen = bits(p.usable);
        alignas(64) float fields[kFields][kLanes], radius[kLanes];
        if (seen) {
            Floats inv_length, basis[kMaxSh], sh[kMaxShFloats];
            load_sh(view, rows, sh);
            const Vec3 dir = direction(view, lanes.mean, &inv_length);
            const SplatLanes splats = make_splats(view, p, colour_of(view.sh_degree, sh, dir, basis));
            put_fields(splats, fields), store(radius, splats.radius);
            seen = bits(splats.visible);
        }
        for (int lane = 0; lane < valid; ++lane) {
            const int64_t i = first + lane;
            const bool is_seen = seen >> lane & 1;
            visible[i] = is_seen;
            radii[i] = is_seen ? radius[lane] : 0.0f;
            frame.keys[i] = kCulled;
            frame.touched[i].rows = 0;
            if (!is_seen) continue;
            Splat& splat = frame.splats[i];
            float* out = &splat.x;
            for (int f = 0; f < kFields - 2; ++f) out[f] = fields[f][lane];
            const int first_row = static_cast<int>(fields[kFields - 2][lane]);
            const int rows = static_cast<int>(fields[kFields - 1][lane]) - first_row + 1;
            frame.touched[i].first_row = static_cast<uint16_t>(first_row);
            frame.touched[i].rows = static_cast<uint16_t>(rows > 0 ? rows : 0);
            __builtin_memcpy(&frame.keys[i], &splat.depth, sizeof(float));
        }
    }
}

int64_t find_spans(const View& view, int64_t begin, int64_t end, const FrameData& frame, int64_t first_span) {
    int64_t tiles = 0;
    Span* span = frame.spans + first_span;
    for (int64_t i = begin; i < end; ++i) {
        Touched& touched = frame.touched[i];
        touched.spans = static_cast<uint32_t>(span - frame.spans);
        touched.slots = static_cast<int32_t>(tiles);
        if (touched.rows == 0) continue;
        const Splat& s = frame.splats[i];
        const float half_y = half_height(s);
        for (int row = touched.first_row; row < touched.first_row + touched.rows; ++row, ++span) {
            *span = find_span(view, s, row, half_y);
            tiles += span->last - span->first;
        }
    }
    return tiles;
}

// The Gaussian's gradients on the screen: its slots, summed in their order.
template <int kFloats>
SPLAT_INLINE void sum_slots(const FrameData& frame, int64_t i, float (*sums)[kLanes], int lane) {
    float sum[kFloats] = {};
    for (int64_t slot = frame.touched[i].slots; slot < frame.touched[i + 1].slots; ++slot)
        for (int f = 0; f < kFloats; ++f) sum[f] += frame.slots[slot * kFloats + f];
    for (int f = 0; f < kFloats; ++f) sums[f][lane] = sum[f];
}

// dL/d(SH), in place of the coefficients.
SPLAT_INLINE void put_sh_gradient(const View& view, const Floats* basis, const Vec3& dcolour, Floats* sh) {
    const int count = sh_basis_size(view.sh_degree);
    for (int k = 0; k < count; ++k)
        sh[3 * k] = basis[k] * dcolour.x, sh[3 * k + 1] = basis[k] * dcolour.y, sh[3 * k + 2] = basis[k] * dcolour.z;
    for (int f = 3 * count; f < 3 * view.sh_count; ++f) sh[f] = fill(0.0f);
}

SPLAT_INLINE void zero(float* out, int64_t count) {
    __builtin_memset(out, 0, static_cast<size_t>(count) * sizeof(float));
}

SPLAT_INLINE void zero_rows(const ParameterGradients& out, int sh_row, int64_t first, int count) {
    zero(out.means + 3 * first, 3 * count), zero(out.log_scales + 3 * first, 3 * count);
    zero(out.quats + 4 * first, 4 * count), zero(out.opacity_logits + first, count);
    zero(out.means2d + 2 * first, 2 * count), zero(out.sh + sh_row * first, sh_row * count);
}

// The gradients of a vector of Gaussians, on the stack: where fewer than kLanes are left, only theirs may be written.
struct GradientRows {
    float means[3 * kLanes], log_scales[3 * kLanes], quats[4 * kLanes], opacity_logits[kLanes], means2d[2 * kLanes];
    float sh[3 * kMaxSh * kLanes];
};

SPLAT_INLINE void put_rows(const LanesGradient& d, Floats* sh, int sh_row, Mask touched,
                           const ParameterGradients& out) {
    const auto seen = [&](Floats v) { return only(touched, v); };  // what is not seen may be NaN
    store_rgb(out.means, seen(d.mean.x), seen(d.mean.y), seen(d.mean.z));
    store_rgb(out.log_scales, seen(d.log_scale.x), seen(d.log_scale.y), seen(d.log_scale.z));
    Floats quats[kLanes] = {seen(d.qw), seen(d.qx), seen(d.qy), seen(d.qz)};
    store_columns(out.quats, 4, quats);
    store(out.opacity_logits, seen(d.logit));
    Floats means2d[kLanes] = {seen(d.mean2d_x), seen(d.mean2d_y)};
    store_columns(out.means2d, 2, means2d);
    for (int f = 0; f < sh_row; ++f) sh[f] = seen(sh[f]);
    store_columns(out.sh, sh_row, sh);
}

SPLAT_INLINE ParameterGradients rows_from(const ParameterGradients& out, int sh_row, int64_t first) {
    return {out.means + 3 * first,   out.log_scales + 3 * first, out.quats + 4 * first, out.opacity_logits + first,
            out.sh + sh_row * first, out.means2d + 2 * first,    out.magnitudes};
}

void copy_rows(const GradientRows& from, int sh_row, int count, const ParameterGradients& to) {
    const auto copy = [count](float* out, const float* in, int width) {
        __builtin_memcpy(out, in, static_cast<size_t>(count) * width * sizeof(float));
    };
    copy(to.means, from.means, 3), copy(to.log_scales, from.log_scales, 3), copy(to.quats, from.quats, 4);
    copy(to.opacity_logits, from.opacity_logits, 1), copy(to.means2d, from.means2d, 2), copy(to.sh, from.sh, sh_row);
}

// With or without the gradient of depths, each compiled apart: the one without is rounded as if there were no other.
template <bool kDepth>
SPLAT_INLINE void project_backward_of(const View& view, const Parameters& in, int64_t begin, int64_t end,
                                      const FrameData& frame, const ParameterGradients& out) {
    Rows rows;
    GradientRows ragged;
    const int sh_row = view.sh_count * 3;
    constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats;
    alignas(64) float sums[kFloats][kLanes], touched[kLanes];
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        if (frame.touched[first].slots == frame.touched[first + valid].slots) {
            zero_rows(out, sh_row, first, valid);
            continue;
        }
        for (int lane = 0; lane < kLanes; ++lane) {
            const int64_t i = first + (lane < valid ? lane : 0);
            touched[lane] = lane < valid && frame.touched[i].slots < frame.touched[i + 1].slots ? 1.0f : 0.0f;
            sum_slots<kFloats>(frame, i, sums, lane);
        }
        find_rows(in, sh_row, first, valid, &rows);
        const Lanes lanes = load_lanes(rows);
        Floats sh[kMaxShFloats];
        load_sh(view, rows, sh);
        const SplatGradient g = {load(sums[0]),
                                 load(sums[1]),
                                 load(sums[2]),
                                 load(sums[3]),
                                 load(sums[4]),
                                 load(sums[5]),
                                 {load(sums[6]), load(sums[7]), load(sums[8])},
                                 load(sums[9]),
                                 load(sums[10]),
                                 load(sums[11]),
                                 kDepth ? load(sums[kSlotFloats]) : fill(0.0f),
                                 kDepth ? load(sums[kSlotFloats + 1]) : fill(0.0f)};
        const Projection p = project_lanes(view, lanes);
        LanesGradient d = project_lanes_backward<kDepth>(view, p, g, out.magnitudes);
        Vec3 dcolour = g.colour;
        Floats basis[kMaxSh];
        d.mean = d.mean + colour_backward(view, view.sh_degree, lanes.mean, sh, &dcolour, basis);
        put_sh_gradient(view, basis, dcolour, sh);
        const Mask seen = less(fill(0.0f), load(touched));
        const ParameterGradients here = rows_from(out, sh_row, first);
        const ParameterGradients stack = {ragged.means, ragged.log_scales, ragged.quats,  ragged.opacity_logits,
                                          ragged.sh,    ragged.means2d,    out.magnitudes};
        put_rows(d, sh, sh_row, seen, valid == kLanes ? here : stack);
        if (valid < kLanes) copy_rows(ragged, sh_row, valid, here);
    }
    streamed();
}

void project_backward(const View& view, const Parameters& in, int64_t begin, int64_t end, const FrameData& frame,
                      const ParameterGradients& out) {
    if (frame.slot_floats == kDepthSlotFloats)
        project_backward_of<true>(view, in, begin, end, frame, out);
    else
        project_backward_of<false>(view, in, begin, end, frame, out);
}

}  // namespace

extern const ProjectKernels project_kernels = {project, find_spans, project_backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
