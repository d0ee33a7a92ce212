// The mathematics of a Gaussian's projection and colour and their derivatives, one Gaussian per lane. For kernel files:
// on the CPU, where values are vectors, and on CUDA, where a lane is a float.
//
// Σ' = B Bᵀ + 0.3 I with the 2 x 3 matrix B = J W R S: only its rows are kept, and det(B Bᵀ) = |row0 x row1|²
// (Cauchy-Binet) has no cancellation.
#pragma once

#include "raster/raster.h"
#if defined(__CUDACC__) || SPLAT_ON_CPU
#include "base/lane.h"
#else
#include "base/simd.h"
#endif

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

struct Vec3 {
    Floats x, y, z;
};

SPLAT_INLINE Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
SPLAT_INLINE Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
SPLAT_INLINE Vec3 operator*(Floats s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
SPLAT_INLINE Vec3 times(const Vec3& a, const Vec3& b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
SPLAT_INLINE Floats dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
SPLAT_INLINE Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
SPLAT_INLINE Vec3 fill3(const float* p) { return {fill(p[0]), fill(p[1]), fill(p[2])}; }

// The raw parameters of a vector of Gaussians, SH apart.
struct Lanes {
    Vec3 mean, log_scale;
    Floats qw, qx, qy, qz, logit;
};

// Intermediate values for the derivative.
struct Projection {
    Vec3 point;                      // camera frame
    Floats inv_z, ratio_x, ratio_y;  // ratios clamped
    Mask clamped_x, clamped_y;
    Vec3 r0, r1, r2;                  // rows of the rotation matrix
    Floats qw, qx, qy, qz, inv_norm;  // unit quaternion
    Vec3 jw0, jw1;                    // rows of J W
    Vec3 scale, row0, row1, row2;     // row0, row1: of B; row2: the same of the depth
    Floats xx, xy, yy;                // Σ', with the blur
    Floats zx, zy;                    // covariances of the depth and the place on the screen
    Vec3 normal;                      // row0 x row1
    Floats sharp, det;                // det without and with the blur
    Floats opacity;                   // without compensation
    Mask compensated;                 // anti-aliased and above the floor
    Floats log2_opacity;              // with compensation
    Mask usable;                      // of what is in here
};

SPLAT_INLINE Floats sigmoid_and_log2(Floats logit, Floats* log2_sigmoid) {
    const Floats one_plus = fill(1.0f) + exp2_wide(logit * fill(-1.44269504f));
    *log2_sigmoid = -log2(one_plus);
    return fill(1.0f) / one_plus;
}

SPLAT_INLINE void rotate(const Lanes& in, Projection* p) {
    const Floats norm2 = in.qw * in.qw + in.qx * in.qx + in.qy * in.qy + in.qz * in.qz;
    p->usable = both(p->usable, at_most(norm2, fill(kMaxQuatNorm2)));
    p->inv_norm = fill(1.0f) / sqrt(norm2 + fill(kQuatEpsilon));
    const Floats w = in.qw * p->inv_norm, x = in.qx * p->inv_norm, y = in.qy * p->inv_norm, z = in.qz * p->inv_norm;
    p->qw = w, p->qx = x, p->qy = y, p->qz = z;
    const Floats one = fill(1.0f), two = fill(2.0f);
    p->r0 = {one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)};
    p->r1 = {two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x)};
    p->r2 = {two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y)};
}

SPLAT_INLINE Projection project_lanes(const View& view, const Lanes& in) {
    Projection p;
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    p.point = {dot(w0, in.mean) + fill(view.translation[0]), dot(w1, in.mean) + fill(view.translation[1]),
               dot(w2, in.mean) + fill(view.translation[2])};
    p.usable = both(less(fill(view.near_z), p.point.z), at_most(p.point.z, fill(kMaxDepth)));
    p.inv_z = fill(1.0f) / select(p.usable, p.point.z, fill(1.0f));
    const Floats ratio_x = p.point.x * p.inv_z, ratio_y = p.point.y * p.inv_z;
    p.ratio_x = clamp(ratio_x, fill(view.ratio_min[0]), fill(view.ratio_max[0]));
    p.ratio_y = clamp(ratio_y, fill(view.ratio_min[1]), fill(view.ratio_max[1]));
    p.clamped_x = either(less(p.ratio_x, ratio_x), less(ratio_x, p.ratio_x));
    p.clamped_y = either(less(p.ratio_y, ratio_y), less(ratio_y, p.ratio_y));
    p.jw0 = (fill(view.fx) * p.inv_z) * (w0 - p.ratio_x * w2);
    p.jw1 = (fill(view.fy) * p.inv_z) * (w1 - p.ratio_y * w2);

    rotate(in, &p);
    const Floats log2e = fill(1.44269504f);
    p.scale = {exp2_wide(in.log_scale.x * log2e), exp2_wide(in.log_scale.y * log2e), exp2_wide(in.log_scale.z * log2e)};
    p.row0 = times(p.jw0.x * p.r0 + p.jw0.y * p.r1 + p.jw0.z * p.r2, p.scale);
    p.row1 = times(p.jw1.x * p.r0 + p.jw1.y * p.r1 + p.jw1.z * p.r2, p.scale);
    const Floats xx = dot(p.row0, p.row0), yy = dot(p.row1, p.row1), blur = fill(kBlurPx2);
    p.xx = xx + blur, p.xy = dot(p.row0, p.row1), p.yy = yy + blur;
    p.row2 = times(w2.x * p.r0 + w2.y * p.r1 + w2.z * p.r2, p.scale);
    const Vec3 reach = fill(kPlaneSigmas) * p.row2;  // of the depth
    p.usable = both(p.usable, less(dot(reach, reach), p.point.z * p.point.z));
    p.zx = dot(p.row2, p.row0), p.zy = dot(p.row2, p.row1);
    p.normal = cross(p.row0, p.row1);
    p.sharp = dot(p.normal, p.normal);
    p.det = p.sharp + blur * (xx + yy) + fill(kBlurPx2 * kBlurPx2);

    p.opacity = sigmoid_and_log2(in.logit, &p.log2_opacity);
    p.compensated = none();
    if (view.antialias) {
        const Floats ratio = p.sharp / p.det, floor = fill(kCompensationMin);
        p.compensated = at_most(floor, ratio);
        p.log2_opacity = p.log2_opacity + fill(0.5f) * log2(select(p.compensated, ratio, floor));
    }
    const Floats limit = fill(kMaxVariancePx2);
    p.usable = both(p.usable, both(at_most(p.xx, limit), at_most(p.yy, limit)));
    p.usable = both(p.usable, at_most(fill(kLog2AlphaMin), p.log2_opacity));
    // 0 x is NaN where x is not finite.
    const Floats zero = fill(0.0f);
    const Floats sum = zero * in.mean.x + zero * in.mean.y + zero * in.mean.z + zero * in.log_scale.x +
                       zero * in.log_scale.y + zero * in.log_scale.z + zero * in.qw + zero * in.qx + zero * in.qy +
                       zero * in.qz + zero * in.logit;
    p.usable = both(p.usable, at_most(sum, zero));
    return p;
}

// The basis of splat/model/sh.py at unit directions, degree 0..3. With slopes: its derivatives by x, y, z.
constexpr float kSh0 = 0.28209479177387814f;
constexpr float kSh1 = 0.4886025119029199f;
SPLAT_TABLE float kSh2[3] = {1.0925484305920792f, 0.31539156525252005f, 0.5462742152960396f};
SPLAT_TABLE float kSh3[5] = {0.5900435899266435f, 2.890611442640554f, 0.4570457994644658f, 0.3731763325901154f,
                             1.445305721320277f};

SPLAT_INLINE void sh_basis(int degree, const Vec3& d, Floats* basis) {
    const Floats x = d.x, y = d.y, z = d.z;
    basis[0] = fill(kSh0);
    if (degree < 1) return;
    basis[1] = fill(-kSh1) * y, basis[2] = fill(kSh1) * z, basis[3] = fill(-kSh1) * x;
    if (degree < 2) return;
    const Floats xx = x * x, yy = y * y, zz = z * z, two = fill(2.0f), three = fill(3.0f), four = fill(4.0f);
    basis[4] = fill(kSh2[0]) * x * y, basis[5] = fill(-kSh2[0]) * y * z;
    basis[6] = fill(kSh2[1]) * (two * zz - xx - yy);
    basis[7] = fill(-kSh2[0]) * x * z, basis[8] = fill(kSh2[2]) * (xx - yy);
    if (degree < 3) return;
    basis[9] = fill(-kSh3[0]) * y * (three * xx - yy);
    basis[10] = fill(kSh3[1]) * x * y * z;
    basis[11] = fill(-kSh3[2]) * y * (four * zz - xx - yy);
    basis[12] = fill(kSh3[3]) * z * (two * zz - three * xx - three * yy);
    basis[13] = fill(-kSh3[2]) * x * (four * zz - xx - yy);
    basis[14] = fill(kSh3[4]) * z * (xx - yy);
    basis[15] = fill(-kSh3[0]) * x * (xx - three * yy);
}

// weights[k]: dL/d(basis k). Returns dL/d(direction), before it is confined to the sphere.
SPLAT_INLINE Vec3 sh_direction_gradient(int degree, const Vec3& d, const Floats* weights) {
    const Floats x = d.x, y = d.y, z = d.z, zero = fill(0.0f);
    Vec3 g = {zero, zero, zero};
    if (degree < 1) return g;
    g = {fill(-kSh1) * weights[3], fill(-kSh1) * weights[1], fill(kSh1) * weights[2]};
    if (degree < 2) return g;
    const Floats w4 = fill(kSh2[0]) * weights[4], w5 = fill(-kSh2[0]) * weights[5], w6 = fill(2 * kSh2[1]) * weights[6];
    const Floats w7 = fill(-kSh2[0]) * weights[7], w8 = fill(2 * kSh2[2]) * weights[8], two = fill(2.0f);
    g = g + Vec3{w4 * y - w6 * x + w7 * z + w8 * x, w4 * x + w5 * z - w6 * y - w8 * y, w5 * y + two * w6 * z + w7 * x};
    if (degree < 3) return g;
    const Floats xx = x * x, yy = y * y, zz = z * z, three = fill(3.0f), four = fill(4.0f), six = fill(6.0f);
    const Floats w9 = fill(-kSh3[0]) * weights[9], w10 = fill(kSh3[1]) * weights[10],
                 w11 = fill(-kSh3[2]) * weights[11];
    const Floats w12 = fill(kSh3[3]) * weights[12], w13 = fill(-kSh3[2]) * weights[13];
    const Floats w14 = fill(kSh3[4]) * weights[14], w15 = fill(-kSh3[0]) * weights[15];
    const Floats eight = fill(8.0f);
    g.x = g.x + w9 * (six * x * y) + w10 * (y * z) - w11 * (two * x * y) - w12 * (six * x * z) +
          w13 * (four * zz - three * xx - yy) + w14 * (two * x * z) + w15 * (three * xx - three * yy);
    g.y = g.y + w9 * (three * xx - three * yy) + w10 * (x * z) + w11 * (four * zz - xx - three * yy) -
          w12 * (six * y * z) - w13 * (two * x * y) - w14 * (two * y * z) - w15 * (six * x * y);
    g.z = g.z + w10 * (x * y) + w11 * (eight * y * z) + w12 * (six * zz - three * xx - three * yy) +
          w13 * (eight * x * z) + w14 * (xx - yy);
    return g;
}

// Screen-space gradients of a splat, per lane.
struct SplatGradient {
    Floats s, su, sv, suu, suv, svv;  // sums over pixels of s = dL/d(ln alpha), times moments of (u, v)
    Vec3 colour;
    Floats depth;             // sum over pixels of dL/d(the depth there)
    Floats size_x, size_y;    // sums over pixels of |s u| and |s (b u + c v)|
    Floats depth_u, depth_v;  // of depth's terms times (u, v)
};

// dL/d(raw parameters), SH apart.
struct LanesGradient {
    Vec3 mean, log_scale;
    Floats qw, qx, qy, qz, logit, mean2d_x, mean2d_y;
};

SPLAT_INLINE void quat_gradient(const Projection& p, const Vec3& g0, const Vec3& g1, const Vec3& g2,
                                LanesGradient* out) {
    const Floats w = p.qw, x = p.qx, y = p.qy, z = p.qz, two = fill(2.0f);  // g0, g1, g2: rows of dL/dR
    const Floats dw = two * (z * (g1.x - g0.y) + y * (g0.z - g2.x) + x * (g2.y - g1.z));
    const Floats dx = two * (y * (g0.y + g1.x) + z * (g0.z + g2.x) - two * x * (g1.y + g2.z) + w * (g2.y - g1.z));
    const Floats dy = two * (x * (g0.y + g1.x) + z * (g1.z + g2.y) - two * y * (g0.x + g2.z) + w * (g0.z - g2.x));
    const Floats dz = two * (x * (g0.z + g2.x) + y * (g1.z + g2.y) - two * z * (g0.x + g1.y) + w * (g1.x - g0.y));
    const Floats along = w * dw + x * dx + y * dy + z * dz;
    out->qw = p.inv_norm * (dw - w * along), out->qx = p.inv_norm * (dx - x * along);
    out->qy = p.inv_norm * (dy - y * along), out->qz = p.inv_norm * (dz - z * along);
}

// dL/dB from the sums: dL/dΣ' = 1/2 Σ s (Q d)(Q d)ᵀ with Q = Σ'⁻¹ = AᵀA / k, A = [[a, b], [0, c]], k = kHalfLog2E.
SPLAT_INLINE void rows_gradient(const Projection& p, const SplatGradient& in, Floats a, Floats b, Floats c, Vec3* drow0,
                                Vec3* drow1) {
    const Floats half = fill(0.5f / (kHalfLog2E * kHalfLog2E));
    Floats gxx = half * a * a * in.suu;
    Floats gxy = half * a * (b * in.suu + c * in.suv);
    Floats gyy = half * (b * b * in.suu + fill(2.0f) * b * c * in.suv + c * c * in.svv);
    const Floats s = only(p.compensated, in.s);  // through ln of the compensation, 1/2 ln(sharp / det)
    const Floats s_det = fill(0.5f) * s / p.det;
    gxx = gxx - s_det * p.yy, gyy = gyy - s_det * p.xx, gxy = gxy + s_det * p.xy;
    const Floats two = fill(2.0f), s_sharp = s / select(p.compensated, p.sharp, fill(1.0f));
    *drow0 = two * (gxx * p.row0 + gxy * p.row1) + s_sharp * cross(p.row1, p.normal);
    *drow1 = two * (gxy * p.row0 + gyy * p.row1) + s_sharp * cross(p.normal, p.row0);
}

// Contribution of the depth slope: at offset d from the centre the depth is z + cᵀ Q d, Q = Σ'⁻¹, c = (zx, zy). With
// y = Q Σ g d = Aᵀ Σ g (u, v) / k and the slope q = Q c: dL/dc = y, dL/d(centre) = -q Σ g, dL/dΣ' = -(q yᵀ + y qᵀ) / 2.
struct SlantGradient {
    Vec3 row0, row1, row2;
    Floats x, y;  // by the centre on the screen
};

SPLAT_INLINE SlantGradient slant_gradient(const Projection& p, const SplatGradient& in, Floats a, Floats b, Floats c) {
    const Floats inv_k = fill(1.0f / kHalfLog2E), two = fill(2.0f), zero = fill(0.0f);
    const Floats y_x = inv_k * a * in.depth_u, y_y = inv_k * (b * in.depth_u + c * in.depth_v);
    const Floats u = inv_k * (a * p.zx + b * p.zy), v = inv_k * c * p.zy;
    const Floats q_x = a * u, q_y = b * u + c * v;
    const Floats gxx = zero - q_x * y_x, gyy = zero - q_y * y_y, gxy = fill(-0.5f) * (q_x * y_y + q_y * y_x);
    return {two * (gxx * p.row0 + gxy * p.row1) + y_x * p.row2, two * (gxy * p.row0 + gyy * p.row1) + y_y * p.row2,
            y_x * p.row0 + y_y * p.row1, zero - in.depth * q_x, zero - in.depth * q_y};
}

// The derivative of project_lanes, without the mean's share through the colour. `magnitudes`: as in ParameterGradients.
template <bool kDepth>
SPLAT_INLINE LanesGradient project_lanes_backward(const View& view, const Projection& p, const SplatGradient& in,
                                                  bool magnitudes) {
    LanesGradient out;
    const Floats a = sqrt(fill(kHalfLog2E) * p.yy / p.det), b = -a * p.xy / p.yy, c = sqrt(fill(kHalfLog2E) / p.yy);
    Vec3 drow0, drow1;
    rows_gradient(p, in, a, b, c, &drow0, &drow1);
    SlantGradient slant;
    if (kDepth) {
        slant = slant_gradient(p, in, a, b, c);
        drow0 = drow0 + slant.row0, drow1 = drow1 + slant.row1;
    }
    out.log_scale = times(drow0, p.row0) + times(drow1, p.row1);
    const Vec3 du0 = times(drow0, p.scale), du1 = times(drow1, p.scale);  // of J W R
    Vec3 dr0 = p.jw0.x * du0 + p.jw1.x * du1, dr1 = p.jw0.y * du0 + p.jw1.y * du1;
    Vec3 dr2 = p.jw0.z * du0 + p.jw1.z * du1;
    if (kDepth) {
        const Vec3 du2 = times(slant.row2, p.scale);
        out.log_scale = out.log_scale + times(slant.row2, p.row2);
        dr0 = dr0 + fill(view.rotation[6]) * du2, dr1 = dr1 + fill(view.rotation[7]) * du2;
        dr2 = dr2 + fill(view.rotation[8]) * du2;
    }
    quat_gradient(p, dr0, dr1, dr2, &out);
    out.logit = in.s * (fill(1.0f) - p.opacity);

    const Floats inv_k = fill(1.0f / kHalfLog2E);
    out.mean2d_x = inv_k * a * in.su;
    out.mean2d_y = inv_k * (b * in.su + c * in.sv);
    const Vec3 w0 = fill3(view.rotation), w1 = fill3(view.rotation + 3), w2 = fill3(view.rotation + 6);
    const Vec3 djw0 = {dot(du0, p.r0), dot(du0, p.r1), dot(du0, p.r2)};
    const Vec3 djw1 = {dot(du1, p.r0), dot(du1, p.r1), dot(du1, p.r2)};
    const Floats fx = fill(view.fx), fy = fill(view.fy), zero = fill(0.0f);
    Floats dinv_z = fx * dot(djw0, w0 - p.ratio_x * w2) + fy * dot(djw1, w1 - p.ratio_y * w2);
    const Floats pixel_x = kDepth ? out.mean2d_x + slant.x : out.mean2d_x;
    const Floats pixel_y = kDepth ? out.mean2d_y + slant.y : out.mean2d_y;
    const Floats dratio_x = fx * pixel_x + select(p.clamped_x, zero, -fx * p.inv_z * dot(djw0, w2));
    const Floats dratio_y = fy * pixel_y + select(p.clamped_y, zero, -fy * p.inv_z * dot(djw1, w2));
    dinv_z = dinv_z + dratio_x * p.point.x + dratio_y * p.point.y;
    const Floats dz = in.depth - p.inv_z * p.inv_z * dinv_z;
    out.mean = (dratio_x * p.inv_z) * w0 + (dratio_y * p.inv_z) * w1 + dz * w2;
    if (magnitudes) out.mean2d_x = inv_k * a * in.size_x, out.mean2d_y = inv_k * in.size_y;
    return out;
}

constexpr int kMaxSh = 16;  // coefficients a channel

SPLAT_INLINE int sh_basis_size(int degree) { return (degree + 1) * (degree + 1); }

SPLAT_INLINE Vec3 direction(const View& view, const Vec3& mean, Floats* inv_length) {
    const Vec3 towards = mean - fill3(view.centre);
    *inv_length = fill(1.0f) / sqrt(dot(towards, towards));
    return *inv_length * towards;
}

SPLAT_INLINE Vec3 coefficient(const Floats* sh, int k) { return {sh[3 * k], sh[3 * k + 1], sh[3 * k + 2]}; }

// The colour before it is clamped, and the basis it was made with.
SPLAT_INLINE Vec3 colour_of(int degree, const Floats* sh, const Vec3& dir, Floats* basis) {
    sh_basis(degree, dir, basis);
    const int count = sh_basis_size(degree);
    Vec3 colour = {fill(0.5f), fill(0.5f), fill(0.5f)};
    SPLAT_UNROLL
    for (int k = 0; k < count; ++k) colour = colour + basis[k] * coefficient(sh, k);
    return colour;
}

// dL/d(mean) through the direction from dL/d(colour), which becomes zero where the colour was clamped; dL/d(SH) is then
// the outer product of the basis and that.
SPLAT_INLINE Vec3 colour_backward(const View& view, int degree, const Vec3& mean, const Floats* sh, Vec3* dcolour,
                                  Floats* basis) {
    Floats inv_length, weights[kMaxSh];
    const Vec3 dir = direction(view, mean, &inv_length);
    const Vec3 colour = colour_of(degree, sh, dir, basis);
    const Floats zero = fill(0.0f);
    *dcolour = {only(less(zero, colour.x), dcolour->x), only(less(zero, colour.y), dcolour->y),
                only(less(zero, colour.z), dcolour->z)};
    const int count = sh_basis_size(degree);
    SPLAT_UNROLL
    for (int k = 0; k < count; ++k) weights[k] = dot(*dcolour, coefficient(sh, k));
    const Vec3 ddir = sh_direction_gradient(degree, dir, weights);
    return inv_length * (ddir - dot(dir, ddir) * dir);
}

// A splat on the screen: Splat's fields in order of the struct, and other results of the projection.
struct SplatLanes {
    Floats x, y, a, b, c, log2_opacity;
    Vec3 colour;
    Floats depth, slope, inv_a, reach, rows_dy, depth_u, depth_v;
    Floats first_row, last_row;  // of tiles; 1 and 0 where its ellipse passes between the pixels' centres
    Floats radius;
    Mask visible;
};

SPLAT_INLINE Mask within(Floats x, float limit) { return both(at_most(x, fill(limit)), at_most(fill(-limit), x)); }

SPLAT_INLINE SplatLanes make_splats(const View& view, const Projection& p, const Vec3& colour) {
    const Floats x = fill(view.fx) * p.point.x * p.inv_z + fill(view.cx);
    const Floats y = fill(view.fy) * p.point.y * p.inv_z + fill(view.cy);
    const Floats k = fill(kHalfLog2E), reach = p.log2_opacity - fill(kLog2AlphaMin), zero = fill(0.0f);
    const Floats a = sqrt(k * p.yy / p.det), slope = p.xy / p.yy, c = sqrt(k / p.yy), inv_k = fill(1.0f / kHalfLog2E);
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
    const Floats mean_variance = half * (p.xx + p.yy), half_difference = half * (p.xx - p.yy);
    const Floats largest = mean_variance + sqrt(half_difference * half_difference + p.xy * p.xy);
    return {x,
            y,
            a,
            -a * slope,
            c,
            p.log2_opacity,
            {max(colour.x, zero), max(colour.y, zero), max(colour.z, zero)},
            p.point.z,
            slope,
            fill(1.0f) / a,
            reach,
            spread * p.xy / sqrt(p.xx),
            inv_k * a * (p.zx - slope * p.zy),
            inv_k * c * p.zy,
            select(no_row, fill(1.0f), floor(row0 * tile)),
            select(no_row, zero, floor(row1 * tile)),
            only(visible, fill(kRadiusSigmas) * sqrt(largest)),
            visible};
}

SPLAT_INLINE float least(float a, float b) { return a < b ? a : b; }
SPLAT_INLINE float most(float a, float b) { return a > b ? a : b; }

// From the centre to the last row of the ellipse, pixels.
SPLAT_INLINE float half_height(const Splat& s) { return root(s.reach) / s.c; }

// The tiles that a splat touches in a tile row. The chord of the ellipse between rows dy_first and dy_last reaches
// furthest right where dy is nearest to the ellipse's own rightmost point, for the ellipse is convex; and to the left
// alike.
SPLAT_INLINE Span find_span(const View& view, const Splat& s, int row, float half_y) {
    const int last_y = row * kTile + kTile < view.height ? row * kTile + kTile : view.height;
    const float dy_first = most(row * kTile + 0.5f - s.y, -half_y), dy_last = least(last_y - 0.5f - s.y, half_y);
    const float dy_right = least(most(s.rows_dy, dy_first), dy_last), v_right = s.c * dy_right;
    const float dy_left = least(most(-s.rows_dy, dy_first), dy_last), v_left = s.c * dy_left;
    const float chord_right = root(fused(-v_right, v_right, s.reach)),
                chord_left = root(fused(-v_left, v_left, s.reach));
    const float right = fused(s.inv_a, chord_right, fused(s.slope, dy_right, s.x)) - 0.5f;
    const float left = fused(-s.inv_a, chord_left, fused(s.slope, dy_left, s.x)) - 0.5f;
    const float first_px = most(__builtin_ceilf(left), 0.0f);
    const float last_px = least(__builtin_floorf(right), static_cast<float>(view.width - 1));
    if (!(dy_first <= dy_last && first_px <= last_px)) return {0, 0};
    return {static_cast<uint16_t>(static_cast<int>(first_px) / kTile),
            static_cast<uint16_t>(static_cast<int>(last_px) / kTile + 1)};
}

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
