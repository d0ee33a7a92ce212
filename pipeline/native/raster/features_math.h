// The mathematics of features.h: activated Gaussians to the screen and back, one Gaussian per lane. For kernel files,
// on the CPU and on CUDA, like splat_math.h.
#pragma once

#include "raster/features.h"
#include "raster/splat_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kReachSigmas = 3.33f;  // beyond these even an opaque Gaussian has alpha < 1/255
constexpr float kMinOpacity = 1e-30f;  // whose logarithm can be taken

// A Gaussian's activated values.
struct ActivatedLanes {
    Vec3 mean, scale;
    Floats quat[4];
};

// The projection of project_lanes, of activated values and without their opacity.
SPLAT_INLINE Projection project_activated(const View& view, const ProjectOptions& options, const ActivatedLanes& in) {
    Projection p;
    const Vec3 &mean = in.mean, &scale = in.scale;
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
    rotate({mean, scale, in.quat[0], in.quat[1], in.quat[2], in.quat[3], zero}, &p);
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

// A projected Gaussian, see Projected; meaningful where seen.
struct ProjectedLanes {
    Floats x, y, depth, xx, xy, yy, determinant, compensation, zx, zy, radius_x, radius_y;
    Mask seen;
};

SPLAT_INLINE ProjectedLanes project_to_screen(const View& view, const ProjectOptions& options, const ActivatedLanes& in,
                                              Floats opacity, bool compensates) {
    const Projection p = project_activated(view, options, in);
    Mask free;
    const Floats factor = compensation(options, p, &free);
    if (compensates) opacity = opacity * factor;
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
    return {x, y, p.point.z, p.xx, p.xy, p.yy, p.det, factor, p.zx, p.zy, radius_x, radius_y, seen};
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

// dL/d(what a projection results in).
struct ScreenLanes {
    Floats x, y, depth;
    Vec3 covariance;
    Floats compensation, zx, zy;
};

// dL/d(activated values) of a Gaussian that is seen.
SPLAT_INLINE ActivatedLanes project_to_screen_backward(const View& view, const ProjectOptions& options,
                                                       const ActivatedLanes& in, const ScreenLanes& by) {
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    const Floats fx = fill(view.fx), fy = fill(view.fy), zero = fill(0.0f);
    const Projection p = project_activated(view, options, in);
    const RowsGradient d = rows_gradient(options, p, by.covariance, by.compensation, by.zx, by.zy);
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
    const Floats dratio_x = fx * by.x + select(p.clamped_x, zero, -fx * p.inv_z * dot(djw0, w2));
    const Floats dratio_y = fy * by.y + select(p.clamped_y, zero, -fy * p.inv_z * dot(djw1, w2));
    dinv_z = dinv_z + dratio_x * p.point.x + dratio_y * p.point.y;
    const Floats dz = by.depth - p.inv_z * p.inv_z * dinv_z;
    const Vec3 mean = (dratio_x * p.inv_z) * w0 + (dratio_y * p.inv_z) * w1 + dz * w2;
    return {mean, scale, {turn.qw, turn.qx, turn.qy, turn.qz}};
}

// What is blended of a projected Gaussian.
struct ScreenSplatLanes {
    Floats x, y;
    Vec3 covariance;
    Floats determinant, opacity, zx, zy;
};

// Fields of Splat as vectors, in the order of the struct, without its colour and depth; then the tile rows.
struct PlacedLanes {
    Floats x, y, a, b, c, log2_opacity, slope, inv_a, reach, rows_dy, depth_u, depth_v, first_row, last_row;
    Mask drawn;
};

SPLAT_INLINE PlacedLanes place_on_screen(const View& view, const ScreenSplatLanes& in, bool slanted) {
    const Floats x = in.x, y = in.y, zero = fill(0.0f), half = fill(0.5f);
    const Floats xx = in.covariance.x, xy = in.covariance.y, yy = in.covariance.z, opacity = in.opacity;
    const Floats k = fill(kHalfLog2E), log2_opacity = log2(max(opacity, fill(kMinOpacity)));
    const Floats reach = log2_opacity - fill(kLog2AlphaMin);
    const Floats a = sqrt(k * yy / in.determinant), slope = xy / yy, c = sqrt(k / yy);
    const Floats spread = sqrt(max(reach, zero) / k), half_x = spread * sqrt(xx), half_y = spread * sqrt(yy);
    const Floats row0 = max(ceil(y - half_y - half), zero);
    const Floats row1 = min(floor(y + half_y - half), fill(view.height - 1.0f)), tile = fill(1.0f / kTile);
    Mask drawn = both(at_most(fill(kAlphaMin), opacity), at_most(zero, reach));
    drawn = both(drawn, both(at_most(half, x + half_x), at_most(x - half_x, fill(view.width - 0.5f))));
    drawn = both(drawn, both(at_most(row0, row1), both(within(x, kMaxScreenPx), within(y, kMaxScreenPx))));
    Floats depth_u = zero, depth_v = zero;
    if (slanted) {
        const Floats inv_k = fill(1.0f / kHalfLog2E);
        depth_u = inv_k * a * (in.zx - slope * in.zy), depth_v = inv_k * c * in.zy;
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

// A pair's or a splat's moments: sums over pixels of s = dL/d(ln alpha), times powers of (u, v); of |s u| and
// |s (b u + c v)|; and of the last channel's terms, times (u, v).
struct Moments {
    float s, su, sv, suu, suv, svv, size_x, size_y, slant_u, slant_v;
};

// dL/d(a splat's place, covariance and slant).
struct PlaceGradient {
    float x, y, xx, xy, yy, size_x, size_y, zx, zy;
};

// From the moments of (u, v), which splat_math.h's rows_gradient and slant_gradient explain, with the splat's whitening
// a, b, c; of one splat. `last`: dL/d(the last channel); zx, zy: its slant.
SPLAT_INLINE PlaceGradient place_gradient(const Moments& m, float a, float b, float c, bool slanted, float last,
                                          float zx, float zy) {
    constexpr float inv_k = 1.0f / kHalfLog2E, half = 0.5f * inv_k * inv_k;
    PlaceGradient g = {};
    g.x = inv_k * a * m.su, g.y = inv_k * (b * m.su + c * m.sv);
    g.xx = half * a * a * m.suu, g.xy = 2.0f * half * a * (b * m.suu + c * m.suv);
    g.yy = half * (b * b * m.suu + 2.0f * b * c * m.suv + c * c * m.svv);
    g.size_x = inv_k * a * m.size_x, g.size_y = inv_k * m.size_y;
    if (!slanted) return g;
    const float y_x = inv_k * a * m.slant_u, y_y = inv_k * (b * m.slant_u + c * m.slant_v);
    const float u = inv_k * (a * zx + b * zy), v = inv_k * c * zy, q_x = a * u, q_y = b * u + c * v;
    g.xx -= q_x * y_x, g.yy -= q_y * y_y, g.xy -= q_x * y_y + q_y * y_x;
    g.x -= last * q_x, g.y -= last * q_y;
    g.zx = y_x, g.zy = y_y;
    return g;
}

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
