// From Gaussians to splats and back, a Gaussian a lane. Compiled once per ISA (see isa.h for what that forbids).
#include "splat_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kMaxSh = 16;  // coefficients a channel

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
    return {gather3(rows.means, 3),    gather3(rows.log_scales, 3), gather(rows.quats, 4),    gather(rows.quats + 1, 4),
            gather(rows.quats + 2, 4), gather(rows.quats + 3, 4),   load(rows.opacity_logits)};
}

SPLAT_INLINE Vec3 direction(const View& view, const Vec3& mean, Floats* inv_length) {
    const Vec3 towards = mean - fill3(view.centre);
    *inv_length = fill(1.0f) / sqrt(dot(towards, towards));
    return *inv_length * towards;
}

SPLAT_INLINE Vec3 colour_of(const View& view, const Rows& rows, const Vec3& dir) {
    Floats basis[kMaxSh];
    sh_basis(view.sh_degree, dir, basis);
    const int count = (view.sh_degree + 1) * (view.sh_degree + 1), stride = view.sh_count * 3;
    Vec3 colour = {fill(0.5f), fill(0.5f), fill(0.5f)};
    for (int k = 0; k < count; ++k) colour = colour + basis[k] * gather3(rows.sh + 3 * k, stride);
    return colour;
}

SPLAT_INLINE Mask within(Floats x, float limit) { return both(at_most(x, fill(limit)), at_most(fill(-limit), x)); }

// Splat's fields as vectors, in the order of the struct up to rows_dy, then the first and last tile rows.
constexpr int kFields = 16;

SPLAT_INLINE Mask make_splats(const View& view, const Projection& p, const Vec3& colour, float (*fields)[kLanes],
                              float* radii) {
    const Floats x = fill(view.fx) * p.point.x * p.inv_z + fill(view.cx);
    const Floats y = fill(view.fy) * p.point.y * p.inv_z + fill(view.cy);
    const Floats k = fill(kHalfLog2E), reach = p.log2_opacity - fill(kLog2AlphaMin), zero = fill(0.0f);
    const Floats a = sqrt(k * p.yy / p.det), slope = p.xy / p.yy;
    const Floats spread = sqrt(max(reach, zero) / k);  // Mahalanobis distance at which alpha = 1/255
    const Floats half_x = spread * sqrt(p.xx), half_y = spread * sqrt(p.yy), half = fill(0.5f);
    Mask visible = both(p.usable, both(within(x, kMaxScreenPx), within(y, kMaxScreenPx)));
    visible = both(
        visible, both(within(colour.x, kMaxColour), both(within(colour.y, kMaxColour), within(colour.z, kMaxColour))));
    visible = both(visible, both(at_most(half, x + half_x), at_most(x - half_x, fill(view.width - 0.5f))));
    visible = both(visible, both(at_most(half, y + half_y), at_most(y - half_y, fill(view.height - 0.5f))));
    const Floats row0 = max(ceil(y - half_y - half), zero),
                 row1 = min(floor(y + half_y - half), fill(view.height - 1.0f));
    const Mask no_row = less(row1, row0);
    const Floats tile = fill(1.0f / kTile);
    const Floats values[kFields] = {x,
                                    y,
                                    a,
                                    -a * slope,
                                    sqrt(k / p.yy),
                                    p.log2_opacity,
                                    max(colour.x, zero),
                                    max(colour.y, zero),
                                    max(colour.z, zero),
                                    p.point.z,
                                    slope,
                                    fill(1.0f) / a,
                                    reach,
                                    spread * p.xy / sqrt(p.xx),
                                    select(no_row, fill(1.0f), floor(row0 * tile)),
                                    select(no_row, zero, floor(row1 * tile))};
    for (int i = 0; i < kFields; ++i) store(fields[i], values[i]);
    const Floats mean_variance = half * (p.xx + p.yy), half_difference = half * (p.xx - p.yy);
    const Floats largest = mean_variance + sqrt(half_difference * half_difference + p.xy * p.xy);
    store(radii, only(visible, fill(kRadiusSigmas) * sqrt(largest)));
    return visible;
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
            Floats inv_length;
            const Vec3 colour = colour_of(view, rows, direction(view, lanes.mean, &inv_length));
            seen = bits(make_splats(view, p, colour, fields, radius));
        }
        for (int lane = 0; lane < valid; ++lane) {
            const int64_t i = first + lane;
            const bool is_seen = seen >> lane & 1;
            visible[i] = is_seen;
            radii[i] = is_seen ? radius[lane] : 0.0f;
            frame.keys[i] = kCulled;
            if (!is_seen) continue;
            Splat& splat = frame.splats[i];
            float* out = &splat.x;
            for (int f = 0; f < kFields - 2; ++f) out[f] = fields[f][lane];
            splat.first_row = static_cast<uint16_t>(fields[kFields - 2][lane]);
            splat.last_row = static_cast<uint16_t>(fields[kFields - 1][lane]);
            __builtin_memcpy(&frame.keys[i], &splat.depth, sizeof(float));
        }
    }
}

SPLAT_INLINE float root(float x) { return __builtin_sqrtf(x > 0.0f ? x : 0.0f); }
SPLAT_INLINE float least(float a, float b) { return a < b ? a : b; }
SPLAT_INLINE float most(float a, float b) { return a > b ? a : b; }

// The chord of the ellipse between rows dy_first and dy_last reaches furthest right where dy is nearest to the
// ellipse's own rightmost point, for the ellipse is convex; and to the left alike.
int64_t find_spans(const View& view, const Splat& s, Span* spans) {
    int64_t touched = 0;
    const float half_y = root(s.reach) / s.c, right_px = static_cast<float>(view.width - 1);
    for (int row = s.first_row; row <= s.last_row; ++row, ++spans) {
        const int last_y = row * kTile + kTile < view.height ? row * kTile + kTile : view.height;
        const float dy_first = most(row * kTile + 0.5f - s.y, -half_y), dy_last = least(last_y - 0.5f - s.y, half_y);
        const float dy_right = least(most(s.rows_dy, dy_first), dy_last), v_right = s.c * dy_right;
        const float dy_left = least(most(-s.rows_dy, dy_first), dy_last), v_left = s.c * dy_left;
        const float right = s.x + s.slope * dy_right + s.inv_a * root(s.reach - v_right * v_right) - 0.5f;
        const float left = s.x + s.slope * dy_left - s.inv_a * root(s.reach - v_left * v_left) - 0.5f;
        const float first_px = most(__builtin_ceilf(left), 0.0f), last_px = least(__builtin_floorf(right), right_px);
        *spans = {0, 0};
        if (!(dy_first <= dy_last && first_px <= last_px)) continue;
        *spans = {static_cast<uint16_t>(static_cast<int>(first_px) / kTile),
                  static_cast<uint16_t>(static_cast<int>(last_px) / kTile + 1)};
        touched += spans->last - spans->first;
    }
    return touched;
}

// The Gaussian's gradients on the screen: its slots, summed in their order.
SPLAT_INLINE void sum_slots(const FrameData& frame, int64_t i, float (*sums)[kLanes], int lane) {
    float sum[kSlotFloats] = {};
    for (int64_t slot = frame.slot_begin[i]; slot < frame.slot_begin[i + 1]; ++slot)
        for (int f = 0; f < kSlotFloats; ++f) sum[f] += frame.slots[slot * kSlotFloats + f];
    for (int f = 0; f < kSlotFloats; ++f) sums[f][lane] = sum[f];
}

SPLAT_INLINE void put_row(float* out, const float (*values)[kLanes], int width, int lane) {
    for (int f = 0; f < width; ++f) out[f] = values[f][lane];
}

// dL/d(SH) from dL/d(colour), to sh (3 k vectors); returns dL/d(mean) through the direction.
SPLAT_INLINE Vec3 colour_backward(const View& view, const Rows& rows, const Vec3& mean, Vec3 dcolour,
                                  float (*sh)[kLanes]) {
    Floats inv_length, basis[kMaxSh], weights[kMaxSh];
    const Vec3 dir = direction(view, mean, &inv_length);
    const Vec3 colour = colour_of(view, rows, dir);
    const Floats zero = fill(0.0f);  // no gradient where the colour was clamped
    dcolour = {only(less(zero, colour.x), dcolour.x), only(less(zero, colour.y), dcolour.y),
               only(less(zero, colour.z), dcolour.z)};
    sh_basis(view.sh_degree, dir, basis);
    const int count = (view.sh_degree + 1) * (view.sh_degree + 1), stride = view.sh_count * 3;
    for (int k = 0; k < view.sh_count; ++k) {
        const bool counts = k < count;
        if (counts) weights[k] = dot(dcolour, gather3(rows.sh + 3 * k, stride));
        store(sh[3 * k], counts ? basis[k] * dcolour.x : zero);
        store(sh[3 * k + 1], counts ? basis[k] * dcolour.y : zero);
        store(sh[3 * k + 2], counts ? basis[k] * dcolour.z : zero);
    }
    const Vec3 ddir = sh_direction_gradient(view.sh_degree, dir, weights);
    return inv_length * (ddir - dot(dir, ddir) * dir);
}

SPLAT_INLINE void zero_rows(const ParameterGradients& out, int sh_row, int64_t i) {
    for (int f = 0; f < 3; ++f) out.means[3 * i + f] = out.log_scales[3 * i + f] = 0.0f;
    for (int f = 0; f < 4; ++f) out.quats[4 * i + f] = 0.0f;
    out.opacity_logits[i] = out.means2d[2 * i] = out.means2d[2 * i + 1] = 0.0f;
    for (int f = 0; f < sh_row; ++f) out.sh[sh_row * i + f] = 0.0f;
}

void project_backward(const View& view, const Parameters& in, int64_t begin, int64_t end, const FrameData& frame,
                      const ParameterGradients& out) {
    Rows rows;
    const int sh_row = view.sh_count * 3;
    alignas(64) float sums[kSlotFloats][kLanes], values[13][kLanes], sh[kMaxSh * 3][kLanes];
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const bool touched = frame.slot_begin[first] < frame.slot_begin[first + valid];
        if (touched) {
            for (int lane = 0; lane < kLanes; ++lane) {
                if (lane < valid) sum_slots(frame, first + lane, sums, lane);
                for (int f = 0; lane >= valid && f < kSlotFloats; ++f) sums[f][lane] = 0.0f;
            }
            find_rows(in, sh_row, first, valid, &rows);
            const Lanes lanes = load_lanes(rows);
            const SplatGradient g = {load(sums[0]),
                                     load(sums[1]),
                                     load(sums[2]),
                                     load(sums[3]),
                                     load(sums[4]),
                                     load(sums[5]),
                                     {load(sums[6]), load(sums[7]), load(sums[8])},
                                     load(sums[9])};
            LanesGradient d = project_lanes_backward(view, project_lanes(view, lanes), g);
            d.mean = d.mean + colour_backward(view, rows, lanes.mean, g.colour, sh);
            const Floats all[13] = {d.mean.x, d.mean.y, d.mean.z, d.log_scale.x, d.log_scale.y, d.log_scale.z, d.qw,
                                    d.qx,     d.qy,     d.qz,     d.logit,       d.mean2d_x,    d.mean2d_y};
            for (int f = 0; f < 13; ++f) store(values[f], all[f]);
        }
        for (int lane = 0; lane < valid; ++lane) {
            const int64_t i = first + lane;
            if (frame.slot_begin[i] == frame.slot_begin[i + 1]) {
                zero_rows(out, sh_row, i);
                continue;
            }
            put_row(out.means + 3 * i, values, 3, lane);
            put_row(out.log_scales + 3 * i, values + 3, 3, lane);
            put_row(out.quats + 4 * i, values + 6, 4, lane);
            put_row(out.opacity_logits + i, values + 10, 1, lane);
            put_row(out.means2d + 2 * i, values + 11, 2, lane);
            put_row(out.sh + sh_row * i, sh, sh_row, lane);
        }
    }
}

}  // namespace

extern const ProjectKernels project_kernels = {project, find_spans, project_backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
