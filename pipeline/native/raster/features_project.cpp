// From activated Gaussians to the screen and back, one Gaussian per lane. Compiled once per ISA (see isa.h for what
// that forbids).
#include "raster/features.h"
#include "raster/splat_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kReachSigmas = 3.33f;  // beyond these even an opaque Gaussian has alpha < 1/255
constexpr float kMinOpacity = 1e-30f;  // whose logarithm can be taken

// Rows first..first+valid-1 of an array, padded with zeros to a whole vector.
template <int kWidth>
struct WholeRows {
    const float* rows;
    float copies[kWidth * kLanes];

    SPLAT_METHOD WholeRows(const float* from, int64_t first, int valid) : rows(from + first * kWidth) {
        if (valid == kLanes) return;
        __builtin_memset(copies, 0, sizeof copies);
        __builtin_memcpy(copies, rows, static_cast<size_t>(valid * kWidth) * sizeof(float));
        rows = copies;
    }
    SPLAT_METHOD Vec3 vec3() const {
        Vec3 v;
        load_rgb(rows, &v.x, &v.y, &v.z);
        return v;
    }
    SPLAT_METHOD Floats column(int k) const { return gather(rows + k, kWidth); }
};

SPLAT_INLINE Floats column_or_zero(const float* from, int width, int64_t first, int valid, int k) {
    if (!from) return fill(0.0f);
    float lanes[kLanes] = {};
    for (int lane = 0; lane < valid; ++lane) lanes[lane] = from[(first + lane) * width + k];
    return load(lanes);
}

// The valid rows of a vector of columns.
template <int kWidth>
SPLAT_INLINE void put_columns(const Floats (&columns)[kWidth], float* to, int64_t first, int valid) {
    float lanes[kWidth][kLanes];
    for (int k = 0; k < kWidth; ++k) store(lanes[k], columns[k]);
    for (int lane = 0; lane < valid; ++lane)
        for (int k = 0; k < kWidth; ++k) to[(first + lane) * kWidth + k] = lanes[k][lane];
}

// Adds the rows of a vector of columns for which `which` has a bit.
template <int kWidth>
SPLAT_INLINE void add_columns(const Floats (&columns)[kWidth], uint32_t which, float* to, int64_t first) {
    float lanes[kWidth][kLanes];
    for (int k = 0; k < kWidth; ++k) store(lanes[k], columns[k]);
    for (; which; which &= which - 1) {
        const int lane = __builtin_ctz(which);
        for (int k = 0; k < kWidth; ++k) to[(first + lane) * kWidth + k] += lanes[k][lane];
    }
}

SPLAT_INLINE uint32_t visible_lanes(const int32_t* radii, int64_t first, int valid) {
    uint32_t seen = 0;
    for (int lane = 0; lane < valid; ++lane) seen |= uint32_t{radii[2 * (first + lane)] > 0} << lane;
    return seen;
}

// The projection of project_lanes, of activated values and without their opacity.
SPLAT_INLINE Projection project_activated(const View& view, const ProjectOptions& options, const Vec3& mean,
                                          const Vec3& scale, const Floats (&quat)[4]) {
    Projection p;
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    const Floats zero = fill(0.0f), one = fill(1.0f);
    p.point = {dot(w0, mean) + fill(view.translation[0]), dot(w1, mean) + fill(view.translation[1]),
               dot(w2, mean) + fill(view.translation[2])};
    p.usable = both(at_most(fill(view.near_z), p.point.z), at_most(p.point.z, fill(options.far_z)));
    p.usable = both(p.usable, less(zero, p.point.z));
    p.inv_z = one / select(p.usable, p.point.z, one);
    const Floats ratio_x = p.point.x * p.inv_z, ratio_y = p.point.y * p.inv_z;
    p.ratio_x = clamp(ratio_x, fill(view.ratio_min[0]), fill(view.ratio_max[0]));
    p.ratio_y = clamp(ratio_y, fill(view.ratio_min[1]), fill(view.ratio_max[1]));
    p.clamped_x = either(less(p.ratio_x, ratio_x), less(ratio_x, p.ratio_x));
    p.clamped_y = either(less(p.ratio_y, ratio_y), less(ratio_y, p.ratio_y));
    p.jw0 = (fill(view.fx) * p.inv_z) * (w0 - p.ratio_x * w2);
    p.jw1 = (fill(view.fy) * p.inv_z) * (w1 - p.ratio_y * w2);
    rotate({mean, scale, quat[0], quat[1], quat[2], quat[3], zero}, &p);
    p.scale = scale;
    p.row0 = times(p.jw0.x * p.r0 + p.jw0.y * p.r1 + p.jw0.z * p.r2, scale);
    p.row1 = times(p.jw1.x * p.r0 + p.jw1.y * p.r1 + p.jw1.z * p.r2, scale);
    p.row2 = times(w2.x * p.r0 + w2.y * p.r1 + w2.z * p.r2, scale);
    const Floats xx = dot(p.row0, p.row0), yy = dot(p.row1, p.row1), blur = fill(options.blur_px2);
    p.xx = xx + blur, p.xy = dot(p.row0, p.row1), p.yy = yy + blur;
    p.zx = dot(p.row2, p.row0), p.zy = dot(p.row2, p.row1);
    p.normal = cross(p.row0, p.row1);
    p.sharp = dot(p.normal, p.normal);
    p.det = p.sharp + blur * (xx + yy) + blur * blur;
    const Vec3 reach = fill(options.plane_sigmas) * p.row2;  // of the depth
    p.usable = both(p.usable, less(dot(reach, reach), p.point.z * p.point.z));
    const Floats limit = fill(kMaxVariancePx2);
    p.usable = both(p.usable, both(at_most(p.xx, limit), at_most(p.yy, limit)));
    p.usable = both(p.usable, less(zero, p.det));
    return p;
}

// √(det Σ' / det(Σ' + blur)) or its floor's root; `free`: above the floor.
SPLAT_INLINE Floats compensation(const ProjectOptions& options, const Projection& p, Mask* free) {
    const Floats ratio = p.sharp / select(p.usable, p.det, fill(1.0f)), floor = fill(options.compensation_min);
    *free = at_most(floor, ratio);
    return sqrt(select(*free, ratio, floor));
}

void project(const View& view, const ProjectOptions& options, const ActivatedGaussians& in, int64_t begin, int64_t end,
             const Projected& out) {
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const WholeRows<3> means(in.means, first, valid), scales(in.scales, first, valid);
        const WholeRows<4> quats(in.quats, first, valid);
        const WholeRows<1> opacities(in.opacities, first, valid);
        const Floats quat[4] = {quats.column(0), quats.column(1), quats.column(2), quats.column(3)};
        const Projection p = project_activated(view, options, means.vec3(), scales.vec3(), quat);
        Mask free;
        const Floats factor = compensation(options, p, &free);
        const Floats opacity = out.compensations ? load(opacities.rows) * factor : load(opacities.rows);
        const Floats zero = fill(0.0f), above = log2(max(opacity, fill(kMinOpacity))) - fill(kLog2AlphaMin);
        const Floats sigmas = min(sqrt(max(above, zero) * fill(1.0f / kHalfLog2E)), fill(kReachSigmas));
        const Floats radius_x = ceil(sigmas * sqrt(p.xx)), radius_y = ceil(sigmas * sqrt(p.yy));
        const Floats x = fill(view.fx) * p.point.x * p.inv_z + fill(view.cx);
        const Floats y = fill(view.fy) * p.point.y * p.inv_z + fill(view.cy);
        Mask seen = both(p.usable, both(within(x, kMaxScreenPx), within(y, kMaxScreenPx)));
        seen = both(seen, at_most(fill(kAlphaMin), opacity));
        seen = both(seen, either(less(fill(options.radius_clip), radius_x), less(fill(options.radius_clip), radius_y)));
        seen = both(seen, both(less(zero, radius_x), less(zero, radius_y)));
        seen = both(seen, both(less(zero, x + radius_x), less(x - radius_x, fill(static_cast<float>(view.width)))));
        seen = both(seen, both(less(zero, y + radius_y), less(y - radius_y, fill(static_cast<float>(view.height)))));
        put_columns({only(seen, x), only(seen, y)}, out.means2d, first, valid);
        put_columns({only(seen, p.point.z)}, out.depths, first, valid);
        put_columns({only(seen, p.xx), only(seen, p.xy), only(seen, p.yy)}, out.covariances, first, valid);
        put_columns({only(seen, p.det)}, out.determinants, first, valid);
        if (out.compensations) put_columns({only(seen, factor)}, out.compensations, first, valid);
        if (out.slants) put_columns({only(seen, p.zx), only(seen, p.zy)}, out.slants, first, valid);
        float radii[2][kLanes];
        store(radii[0], only(seen, radius_x)), store(radii[1], only(seen, radius_y));
        for (int lane = 0; lane < valid; ++lane)
            for (int k = 0; k < 2; ++k) out.radii[2 * (first + lane) + k] = static_cast<int32_t>(radii[k][lane]);
    }
}

// Gradients by the rows of B = J W R S, and of W's third row times R S.
struct RowsGradient {
    Vec3 row0, row1, row2;
};

SPLAT_INLINE RowsGradient rows_gradient(const ProjectOptions& options, const Projection& p, const Vec3& covariance,
                                        Floats by_compensation, Floats by_zx, Floats by_zy) {
    const Floats two = fill(2.0f), half = fill(0.5f), zero = fill(0.0f);
    Mask free;
    // Through ln of the compensation, 1/2 ln(sharp / det); none where it is its floor, or zero.
    const Floats factor = compensation(options, p, &free);
    free = both(free, less(zero, p.sharp));
    const Floats s = only(free, by_compensation * factor), s_sharp = s / select(free, p.sharp, fill(1.0f));
    const Floats s_det = half * s / p.det;
    const Floats xx = covariance.x - s_det * p.yy, yy = covariance.z - s_det * p.xx;
    const Floats xy = covariance.y + two * s_det * p.xy;
    return {(two * xx) * p.row0 + xy * p.row1 + s_sharp * cross(p.row1, p.normal) + by_zx * p.row2,
            xy * p.row0 + (two * yy) * p.row1 + s_sharp * cross(p.normal, p.row0) + by_zy * p.row2,
            by_zx * p.row0 + by_zy * p.row1};
}

void project_backward(const View& view, const ProjectOptions& options, const ActivatedGaussians& in, int64_t begin,
                      int64_t end, const int32_t* radii, const ProjectedGradients& upstream,
                      const ActivatedGradients& out) {
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    const Floats fx = fill(view.fx), fy = fill(view.fy), zero = fill(0.0f);
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const uint32_t seen = visible_lanes(radii, first, valid);
        if (!seen) continue;
        const auto by = [&](const float* from, int width, int k) {
            return column_or_zero(from, width, first, valid, k);
        };
        const WholeRows<3> means(in.means, first, valid), scales(in.scales, first, valid);
        const WholeRows<4> quats(in.quats, first, valid);
        const Floats quat[4] = {quats.column(0), quats.column(1), quats.column(2), quats.column(3)};
        const Projection p = project_activated(view, options, means.vec3(), scales.vec3(), quat);
        const Vec3 covariance = {by(upstream.covariances, 3, 0), by(upstream.covariances, 3, 1),
                                 by(upstream.covariances, 3, 2)};
        const RowsGradient d = rows_gradient(options, p, covariance, by(upstream.compensations, 1, 0),
                                             by(upstream.slants, 2, 0), by(upstream.slants, 2, 1));
        // Of J W R and of W's third row times R.
        const Vec3 du0 = times(d.row0, p.scale), du1 = times(d.row1, p.scale), du2 = times(d.row2, p.scale);
        const Vec3 scale = times(d.row0, p.jw0.x * p.r0 + p.jw0.y * p.r1 + p.jw0.z * p.r2) +
                           times(d.row1, p.jw1.x * p.r0 + p.jw1.y * p.r1 + p.jw1.z * p.r2) +
                           times(d.row2, w2.x * p.r0 + w2.y * p.r1 + w2.z * p.r2);
        LanesGradient turn;
        quat_gradient(p, p.jw0.x * du0 + p.jw1.x * du1 + w2.x * du2, p.jw0.y * du0 + p.jw1.y * du1 + w2.y * du2,
                      p.jw0.z * du0 + p.jw1.z * du1 + w2.z * du2, &turn);
        const Vec3 djw0 = {dot(du0, p.r0), dot(du0, p.r1), dot(du0, p.r2)};
        const Vec3 djw1 = {dot(du1, p.r0), dot(du1, p.r1), dot(du1, p.r2)};
        Floats dinv_z = fx * dot(djw0, w0 - p.ratio_x * w2) + fy * dot(djw1, w1 - p.ratio_y * w2);
        const Floats dratio_x =
            fx * by(upstream.means2d, 2, 0) + select(p.clamped_x, zero, -fx * p.inv_z * dot(djw0, w2));
        const Floats dratio_y =
            fy * by(upstream.means2d, 2, 1) + select(p.clamped_y, zero, -fy * p.inv_z * dot(djw1, w2));
        dinv_z = dinv_z + dratio_x * p.point.x + dratio_y * p.point.y;
        const Floats dz = by(upstream.depths, 1, 0) - p.inv_z * p.inv_z * dinv_z;
        const Vec3 mean = (dratio_x * p.inv_z) * w0 + (dratio_y * p.inv_z) * w1 + dz * w2;
        add_columns({mean.x, mean.y, mean.z}, seen, out.means, first);
        add_columns({turn.qw, turn.qx, turn.qy, turn.qz}, seen, out.quats, first);
        add_columns({scale.x, scale.y, scale.z}, seen, out.scales, first);
    }
}

constexpr int kMaxShFloats = (kMaxSh * 3 + kLanes - 1) / kLanes * kLanes;  // a Gaussian, to whole vectors

// The coefficients that count of a vector of rows, (k, rgb).
SPLAT_INLINE void load_sh(const View& view, const ShRows& in, int64_t first, int valid, Floats* sh) {
    const int width = view.sh_count * 3, used = sh_basis_size(view.sh_degree) * 3;
    const float* rows = in.sh + first * width;
    float copies[kLanes * kMaxSh * 3];
    if (valid < kLanes) {
        __builtin_memset(copies, 0, sizeof copies);
        __builtin_memcpy(copies, rows, static_cast<size_t>(valid * width) * sizeof(float));
        rows = copies;
    }
    load_columns(rows, width, used, sh);
}

void colours(const View& view, const ShRows& in, int64_t begin, int64_t end, float* out) {
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const uint32_t seen = visible_lanes(in.radii, first, valid);
        float lanes[3][kLanes] = {};
        if (seen) {
            const WholeRows<3> means(in.means, first, valid);
            Floats inv_length, basis[kMaxSh], sh[kMaxShFloats];
            load_sh(view, in, first, valid, sh);
            const Vec3 dir = direction(view, means.vec3(), &inv_length);
            const Vec3 colour = colour_of(view.sh_degree, sh, dir, basis);
            const Floats zero = fill(0.0f);
            store(lanes[0], max(colour.x, zero)), store(lanes[1], max(colour.y, zero));
            store(lanes[2], max(colour.z, zero));
        }
        for (int lane = 0; lane < valid; ++lane)
            for (int k = 0; k < 3; ++k) out[3 * (first + lane) + k] = seen >> lane & 1 ? lanes[k][lane] : 0.0f;
    }
}

void colours_backward(const View& view, const ShRows& in, int64_t begin, int64_t end, const float* gradients,
                      float* means_out, float* sh_out) {
    const int count = sh_basis_size(view.sh_degree);
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        uint32_t seen = visible_lanes(in.radii, first, valid);
        if (!seen) continue;
        const WholeRows<3> means(in.means, first, valid), upstream(gradients, first, valid);
        Floats basis[kMaxSh], sh[kMaxShFloats];
        load_sh(view, in, first, valid, sh);
        Vec3 dcolour = upstream.vec3();
        const Vec3 mean = colour_backward(view, view.sh_degree, means.vec3(), sh, &dcolour, basis);
        add_columns({mean.x, mean.y, mean.z}, seen, means_out, first);
        float by_colour[3][kLanes], lanes[kMaxSh][kLanes];
        store(by_colour[0], dcolour.x), store(by_colour[1], dcolour.y), store(by_colour[2], dcolour.z);
        for (int k = 0; k < count; ++k) store(lanes[k], basis[k]);
        for (; seen; seen &= seen - 1) {
            const int lane = __builtin_ctz(seen);
            float* row = sh_out + (first + lane) * view.sh_count * 3;
            for (int k = 0; k < count; ++k)
                for (int c = 0; c < 3; ++c) row[3 * k + c] += lanes[k][lane] * by_colour[c][lane];
        }
    }
}

// Fields of Splat as vectors, in the order of the struct, without its colour and depth; then the tile rows.
struct PlacedLanes {
    Floats x, y, a, b, c, log2_opacity, slope, inv_a, reach, rows_dy, depth_u, depth_v, first_row, last_row;
    Mask drawn;
};

SPLAT_INLINE PlacedLanes place_lanes(const View& view, const Features& features, const ScreenSplats& in, int64_t first,
                                     int valid) {
    const WholeRows<2> means2d(in.means2d, first, valid);
    const WholeRows<3> covariances(in.covariances, first, valid);
    const WholeRows<1> determinants(in.determinants, first, valid), opacities(in.opacities, first, valid);
    const Floats x = means2d.column(0), y = means2d.column(1), zero = fill(0.0f), half = fill(0.5f);
    const Vec3 covariance = covariances.vec3();
    const Floats xx = covariance.x, xy = covariance.y, yy = covariance.z, opacity = load(opacities.rows);
    const Floats k = fill(kHalfLog2E), log2_opacity = log2(max(opacity, fill(kMinOpacity)));
    const Floats reach = log2_opacity - fill(kLog2AlphaMin);
    const Floats a = sqrt(k * yy / load(determinants.rows)), slope = xy / yy, c = sqrt(k / yy);
    const Floats spread = sqrt(max(reach, zero) / k), half_x = spread * sqrt(xx), half_y = spread * sqrt(yy);
    const Floats row0 = max(ceil(y - half_y - half), zero);
    const Floats row1 = min(floor(y + half_y - half), fill(view.height - 1.0f)), tile = fill(1.0f / kTile);
    Mask drawn = both(at_most(fill(kAlphaMin), opacity), at_most(zero, reach));
    drawn = both(drawn, both(at_most(half, x + half_x), at_most(x - half_x, fill(view.width - 0.5f))));
    drawn = both(drawn, both(at_most(row0, row1), both(within(x, kMaxScreenPx), within(y, kMaxScreenPx))));
    Floats depth_u = zero, depth_v = zero;
    if (features.slanted) {
        const WholeRows<2> slants(in.slants, first, valid);
        const Floats inv_k = fill(1.0f / kHalfLog2E), zy = slants.column(1);
        depth_u = inv_k * a * (slants.column(0) - slope * zy), depth_v = inv_k * c * zy;
    }
    return {x,
            y,
            a,
            -a * slope,
            c,
            log2_opacity,
            slope,
            fill(1.0f) / a,
            reach,
            spread * xy / sqrt(xx),
            depth_u,
            depth_v,
            floor(row0 * tile),
            floor(row1 * tile),
            drawn};
}

static_assert(offsetof(Splat, colour) == kInlineAt * sizeof(float) &&
                  offsetof(Splat, slope) == (kInlineAt + kInlineChannels) * sizeof(float),
              "room for kInlineChannels");

void place(const View& view, const Features& features, const ScreenSplats& in, int64_t begin, int64_t end,
           const FrameData& frame) {
    constexpr int kFields = 12;
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        uint32_t seen = visible_lanes(in.radii, first, valid);
        for (int lane = 0; lane < valid; ++lane)
            frame.keys[first + lane] = kCulled, frame.touched[first + lane].rows = 0;
        if (!seen) continue;
        const PlacedLanes s = place_lanes(view, features, in, first, valid);
        const Floats values[kFields + 2] = {s.x,         s.y,       s.a,     s.b,       s.c,       s.log2_opacity,
                                            s.slope,     s.inv_a,   s.reach, s.rows_dy, s.depth_u, s.depth_v,
                                            s.first_row, s.last_row};
        alignas(64) float fields[kFields + 2][kLanes];
        for (int f = 0; f < kFields + 2; ++f) store(fields[f], values[f]);
        for (seen &= bits(s.drawn); seen; seen &= seen - 1) {
            const int lane = __builtin_ctz(seen);
            const int64_t i = first + lane;
            float* out = &frame.splats[i].x;
            for (int f = 0; f < kInlineAt; ++f) out[f] = fields[f][lane];
            for (int f = kInlineAt; f < kFields; ++f) out[kInlineChannels + f] = fields[f][lane];
            for (int c = 0; c < kInlineChannels; ++c)
                out[kInlineAt + c] = features.channels <= kInlineChannels && c < features.channels
                                         ? in.features[i * features.channels + c]
                                         : 0.0f;
            frame.touched[i].first_row = static_cast<uint16_t>(fields[kFields][lane]);
            frame.touched[i].rows = static_cast<uint16_t>(fields[kFields + 1][lane] - fields[kFields][lane] + 1.0f);
            __builtin_memcpy(&frame.keys[i], in.depths + i, sizeof(float));
        }
    }
}

// Sums floats first..first+count-1 of a splat's slots, in their order.
SPLAT_INLINE void sum_slots(const FrameData& frame, int64_t i, int first, int count, float* sums) {
    for (int f = 0; f < count; ++f) sums[f] = 0.0f;
    for (int64_t slot = frame.touched[i].slots; slot < frame.touched[i + 1].slots; ++slot)
        for (int f = 0; f < count; ++f) sums[f] += frame.slots[slot * frame.slot_floats + first + f];
}

// From the moments of (u, v), which splat_math.h's rows_gradient explains, to the splat's place, covariance and
// opacity.
void finish(const Features& features, const ScreenSplats& in, int64_t begin, int64_t end, const FrameData& frame,
            const ScreenGradients& out) {
    constexpr float inv_k = 1.0f / kHalfLog2E, half = 0.5f * inv_k * inv_k;
    const int channels_at = kMomentFloats + (features.slanted ? kSlantFloats : 0);
    for (int64_t i = begin; i < end; ++i) {
        if (frame.touched[i].slots == frame.touched[i + 1].slots) continue;
        float m[kMomentFloats + kSlantFloats] = {};
        sum_slots(frame, i, 0, channels_at, m);
        const Splat& splat = frame.splats[i];
        const float a = splat.a, b = splat.b, c = splat.c;
        const float s = m[0], su = m[1], sv = m[2], suu = m[3], suv = m[4], svv = m[5];
        float x = inv_k * a * su, y = inv_k * (b * su + c * sv);
        float xx = half * a * a * suu, xy = 2.0f * half * a * (b * suu + c * suv);
        float yy = half * (b * b * suu + 2.0f * b * c * suv + c * c * svv);
        if (out.magnitudes) out.magnitudes[2 * i] += inv_k * a * m[6], out.magnitudes[2 * i + 1] += inv_k * m[7];
        constexpr int kChunk = 16;
        float last = 0.0f;
        for (int first = 0; first < features.channels; first += kChunk) {
            const int count = features.channels - first < kChunk ? features.channels - first : kChunk;
            float sums[kChunk];
            sum_slots(frame, i, channels_at + first, count, sums);
            float* row = out.features + i * features.channels + first;
            for (int f = 0; f < count; ++f) row[f] += sums[f];
            last = sums[count - 1];
        }
        if (features.slanted) {  // see slant_gradient of splat_math.h
            const float zx = in.slants[2 * i], zy = in.slants[2 * i + 1];
            const float y_x = inv_k * a * m[8], y_y = inv_k * (b * m[8] + c * m[9]);
            const float u = inv_k * (a * zx + b * zy), v = inv_k * c * zy, q_x = a * u, q_y = b * u + c * v;
            xx -= q_x * y_x, yy -= q_y * y_y, xy -= q_x * y_y + q_y * y_x;
            x -= last * q_x, y -= last * q_y;
            out.slants[2 * i] += y_x, out.slants[2 * i + 1] += y_y;
        }
        out.means2d[2 * i] += x, out.means2d[2 * i + 1] += y;
        out.covariances[3 * i] += xx, out.covariances[3 * i + 1] += xy, out.covariances[3 * i + 2] += yy;
        out.opacities[i] += s / in.opacities[i];
    }
}

}  // namespace

extern const FeatureKernels feature_kernels = {project, project_backward, colours, colours_backward, place, finish};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
