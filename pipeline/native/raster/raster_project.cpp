// From Gaussians to splats and back, one Gaussian per lane. Compiled once per ISA (see isa.h for what that forbids).
#include "raster/splat_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kMaxShFloats = (kMaxSh * 3 + kLanes - 1) / kLanes * kLanes;  // a Gaussian, to whole vectors

// The rows of a vector of candidates: pointers into the caller's arrays if they are contiguous, else to copies, padded
// with zeros at the end.
struct Rows {
    const float *means, *log_scales, *quats, *opacity_logits, *sh;
    float copies[kLanes * (3 + 3 + 4 + 1 + kMaxSh * 3)];
};

SPLAT_INLINE bool side_by_side(const int32_t* rows, int valid) {
    return valid == kLanes && rows[kLanes - 1] - rows[0] == kLanes - 1;
}

// The first `used` of the `width` floats of each row.
SPLAT_INLINE const float* copied(const float* from, int width, int used, const int32_t* rows, int valid, float* to) {
    for (int lane = 0; lane < kLanes; ++lane) {
        float* copy = to + lane * width;
        if (lane < valid)
            __builtin_memcpy(copy, from + int64_t{rows[lane]} * width, static_cast<size_t>(used) * sizeof(float));
        else
            __builtin_memset(copy, 0, static_cast<size_t>(used) * sizeof(float));
    }
    return to;
}

SPLAT_INLINE void find_rows(const Parameters& in, const int32_t* rows, int valid, Rows* found) {
    if (side_by_side(rows, valid)) {
        const int64_t first = rows[0];
        found->means = in.means + first * 3, found->log_scales = in.log_scales + first * 3;
        found->quats = in.quats + first * 4, found->opacity_logits = in.opacity_logits + first;
        return;
    }
    float* to = found->copies;
    found->means = copied(in.means, 3, 3, rows, valid, to);
    found->log_scales = copied(in.log_scales, 3, 3, rows, valid, to += kLanes * 3);
    found->quats = copied(in.quats, 4, 4, rows, valid, to += kLanes * 3);
    found->opacity_logits = copied(in.opacity_logits, 1, 1, rows, valid, to + kLanes * 4);
}

// The part of a row of SH that is read: the coefficients in use, rounded up to whole vectors.
SPLAT_INLINE int sh_floats_read(const View& view) {
    const int row = view.sh_count * 3, vectors = (sh_basis_size(view.sh_degree) * 3 + kLanes - 1) / kLanes * kLanes;
    return vectors < row ? vectors : row;
}

SPLAT_INLINE void find_sh(const View& view, const Parameters& in, const int32_t* rows, int valid, Rows* found) {
    const int width = view.sh_count * 3;
    if (side_by_side(rows, valid))
        found->sh = in.sh + int64_t{rows[0]} * width;
    else
        found->sh = copied(in.sh, width, sh_floats_read(view), rows, valid, found->copies + kLanes * (3 + 3 + 4 + 1));
}

constexpr int kLineFloats = 16;  // of the CPU's cache

// Prefetches the rows that are copied next: a CPU cannot predict where they are.
SPLAT_INLINE void fetch_rows(const View& view, const Parameters& in, const int32_t* rows, int valid) {
    if (side_by_side(rows, valid)) return;
    const int width = view.sh_count * 3, used = sh_floats_read(view);
    for (int lane = 0; lane < valid; ++lane) {
        const int64_t i = rows[lane];
        __builtin_prefetch(in.means + i * 3), __builtin_prefetch(in.log_scales + i * 3);
        __builtin_prefetch(in.quats + i * 4), __builtin_prefetch(in.opacity_logits + i);
        for (int f = 0; f < used; f += kLineFloats) __builtin_prefetch(in.sh + i * width + f);
    }
}

SPLAT_INLINE Lanes load_lanes(const Rows& rows) {
    Lanes lanes;
    load_rgb(rows.means, &lanes.mean.x, &lanes.mean.y, &lanes.mean.z);
    load_rgb(rows.log_scales, &lanes.log_scale.x, &lanes.log_scale.y, &lanes.log_scale.z);
    Floats quats[4];
    load_fours(rows.quats, quats);
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

// Slack of the candidate test: a false candidate costs little, a missed one would be an error.
constexpr float kRounding = 1e-6f;  // of a point in the camera's frame, over the sum of what it is made of
constexpr float kSurely = 1e3f;     // roundings that its depth has to have for its place to be known so well
constexpr float kRoom = 1.01f;      // times an ellipse's half-axes
constexpr float kSpread = 3.33f;    // √(2 ln 255): where the most opaque Gaussian has alpha = 1/255, deviations

// Whether the interval about a pixel coordinate may reach a picture of `size` pixels. `ratio`: x / z or
// y / z, `held`: the same clamped, `scale` and `drift`: the longest deviation and the rounding over z.
SPLAT_INLINE Mask may_reach(float focal, float centre, int size, Floats ratio, Floats held, Floats scale,
                            Floats drift) {
    const Floats one = fill(1.0f), place = fma(fill(focal), ratio, fill(centre));
    const Floats deviation = fill(focal) * scale * sqrt(fma(held, held, one));
    const Floats half = fill(kRoom * kSpread) * sqrt(fma(deviation, deviation, fill(kBlurPx2)));
    const Floats off = fill(focal) * drift * (one + magnitude(ratio)) + fill(kRounding * __builtin_fabsf(centre));
    const Floats reach = half + off + off;
    return both(at_most(fill(0.5f), place + reach), at_most(place - reach, fill(size - 0.5f)));
}

// Not where the definition finds a Gaussian visible: its deviation on the screen is at most that of a ball of its
// longest axis, f s √(1 + r²) / z with the clamped ratio r = x / z.
SPLAT_INLINE Mask may_be_visible(const View& view, const Vec3& mean, const Vec3& log_scale) {
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    const float* t = view.translation;
    const Floats x = dot(w0, mean) + fill(t[0]), y = dot(w1, mean) + fill(t[1]), z = dot(w2, mean) + fill(t[2]);
    const Floats size = magnitude(mean.x) + magnitude(mean.y) + magnitude(mean.z) +
                        fill(__builtin_fabsf(t[0]) + __builtin_fabsf(t[1]) + __builtin_fabsf(t[2]));
    const Floats rounding = fill(kRounding) * size, inv_z = fill(1.0f) / z;
    const Floats ratio_x = x * inv_z, ratio_y = y * inv_z;
    const Floats longest = max(max(log_scale.x, log_scale.y), log_scale.z);
    const Floats scale = exp2_wide(longest * fill(1.44269504f)) * inv_z, drift = rounding * inv_z;
    const Floats held_x = clamp(ratio_x, fill(view.ratio_min[0]), fill(view.ratio_max[0]));
    const Floats held_y = clamp(ratio_y, fill(view.ratio_min[1]), fill(view.ratio_max[1]));
    const Mask inside = both(may_reach(view.fx, view.cx, view.width, ratio_x, held_x, scale, drift),
                             may_reach(view.fy, view.cy, view.height, ratio_y, held_y, scale, drift));
    const Mask unsure = at_most(z, fill(kSurely) * rounding);
    return both(less(fill(view.near_z), z + rounding), either(unsure, inside));
}

int64_t find_candidates(const View& view, const Parameters& in, int64_t begin, int64_t end, int32_t* rows) {
    int64_t count = 0;
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const float *means = in.means + 3 * first, *log_scales = in.log_scales + 3 * first;
        float last_means[3 * kLanes] = {}, last_scales[3 * kLanes] = {};
        if (valid < kLanes) {
            __builtin_memcpy(last_means, means, static_cast<size_t>(3 * valid) * sizeof(float));
            __builtin_memcpy(last_scales, log_scales, static_cast<size_t>(3 * valid) * sizeof(float));
            means = last_means, log_scales = last_scales;
        }
        Vec3 mean, log_scale;
        load_rgb(means, &mean.x, &mean.y, &mean.z), load_rgb(log_scales, &log_scale.x, &log_scale.y, &log_scale.z);
        uint32_t left = bits(may_be_visible(view, mean, log_scale)) & ((uint32_t{1} << valid) - 1);
        for (; left; left &= left - 1) rows[count++] = static_cast<int32_t>(first + __builtin_ctz(left));
    }
    return count;
}

void project(const View& view, const Parameters& in, int64_t begin, int64_t end, const FrameData& frame, float* radii,
             uint8_t* visible) {
    Rows found;
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const int32_t* rows = frame.rows + first;
        if (first + 2 * kLanes <= end) fetch_rows(view, in, rows + kLanes, kLanes);
        find_rows(in, rows, valid, &found);
        const Lanes lanes = load_lanes(found);
        const Projection p = project_lanes(view, lanes);
        uint32_t seen = bits(p.usable);
        alignas(64) float fields[kFields][kLanes], radius[kLanes];
        if (seen) {
            Floats inv_length, basis[kMaxSh], sh[kMaxShFloats];
            find_sh(view, in, rows, valid, &found);
            load_sh(view, found, sh);
            const Vec3 dir = direction(view, lanes.mean, &inv_length);
            const SplatLanes splats = make_splats(view, p, colour_of(view.sh_degree, sh, dir, basis));
            put_fields(splats, fields), store(radius, splats.radius);
            seen = bits(splats.visible);
        }
        for (int lane = 0; lane < valid; ++lane) {
            const int64_t i = first + lane;
            frame.keys[i] = kCulled;
            frame.touched[i].rows = 0;
            if (!(seen >> lane & 1)) continue;
            visible[rows[lane]] = 1, radii[rows[lane]] = radius[lane];
            Splat& splat = frame.splats[i];
            float* out = &splat.x;
            for (int f = 0; f < kFields - 2; ++f) out[f] = fields[f][lane];
            const int first_row = static_cast<int>(fields[kFields - 2][lane]);
            const int tile_rows = static_cast<int>(fields[kFields - 1][lane]) - first_row + 1;
            frame.touched[i].first_row = static_cast<uint16_t>(first_row);
            frame.touched[i].rows = static_cast<uint16_t>(tile_rows > 0 ? tile_rows : 0);
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

// dL/d(SH), written over the coefficients.
SPLAT_INLINE void put_sh_gradient(const View& view, const Floats* basis, const Vec3& dcolour, Floats* sh) {
    const int count = sh_basis_size(view.sh_degree);
    for (int k = 0; k < count; ++k)
        sh[3 * k] = basis[k] * dcolour.x, sh[3 * k + 1] = basis[k] * dcolour.y, sh[3 * k + 2] = basis[k] * dcolour.z;
    for (int f = 3 * count; f < 3 * view.sh_count; ++f) sh[f] = fill(0.0f);
}

SPLAT_INLINE void put_rows(const LanesGradient& d, Floats* sh, int sh_row, Mask touched,
                           const ParameterGradients& out) {
    const auto seen = [&](Floats v) { return only(touched, v); };  // invisible ones may be NaN
    store_rgb(out.means, seen(d.mean.x), seen(d.mean.y), seen(d.mean.z));
    store_rgb(out.log_scales, seen(d.log_scale.x), seen(d.log_scale.y), seen(d.log_scale.z));
    Floats quats[4] = {seen(d.qw), seen(d.qx), seen(d.qy), seen(d.qz)};
    store_fours(out.quats, quats);
    store(out.opacity_logits, seen(d.logit));
    Floats means2d[kLanes] = {seen(d.mean2d_x), seen(d.mean2d_y)};
    store_columns(out.means2d, 2, means2d);
    for (int f = 0; f < sh_row; ++f) sh[f] = seen(sh[f]);
    store_columns(out.sh, sh_row, sh);
}

SPLAT_INLINE ParameterGradients rows_from(const ParameterGradients& out, int sh_row, int64_t first) {
    return {out.means + 3 * first,      out.log_scales + 3 * first, out.quats + 4 * first,
            out.opacity_logits + first, out.sh + sh_row * first,    out.means2d + 2 * first};
}

// With or without the gradient of depths, compiled separately: the one without rounds as if there were no other.
template <bool kDepth>
SPLAT_INLINE void project_backward_of(const View& view, const Parameters& in, int64_t begin, int64_t end,
                                      const FrameData& frame, bool magnitudes, const ParameterGradients& out) {
    Rows found;
    const int sh_row = view.sh_count * 3;
    constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats;
    alignas(64) float sums[kFloats][kLanes], touched[kLanes];
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        for (int lane = 0; lane < kLanes; ++lane) {
            const int64_t i = first + (lane < valid ? lane : 0);
            touched[lane] = lane < valid && frame.touched[i].slots < frame.touched[i + 1].slots ? 1.0f : 0.0f;
            sum_slots<kFloats>(frame, i, sums, lane);
        }
        find_rows(in, frame.rows + first, valid, &found);
        find_sh(view, in, frame.rows + first, valid, &found);
        const Lanes lanes = load_lanes(found);
        Floats sh[kMaxShFloats];
        load_sh(view, found, sh);
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
        LanesGradient d = project_lanes_backward<kDepth>(view, p, g, magnitudes);
        Vec3 dcolour = g.colour;
        Floats basis[kMaxSh];
        d.mean = d.mean + colour_backward(view, view.sh_degree, lanes.mean, sh, &dcolour, basis);
        put_sh_gradient(view, basis, dcolour, sh);
        put_rows(d, sh, sh_row, less(fill(0.0f), load(touched)), rows_from(out, sh_row, first - begin));
    }
}

void project_backward(const View& view, const Parameters& in, int64_t begin, int64_t end, const FrameData& frame,
                      bool magnitudes, const ParameterGradients& out) {
    if (frame.slot_floats == kDepthSlotFloats)
        project_backward_of<true>(view, in, begin, end, frame, magnitudes, out);
    else
        project_backward_of<false>(view, in, begin, end, frame, magnitudes, out);
}

}  // namespace

extern const ProjectKernels project_kernels = {find_candidates, project, find_spans, project_backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
