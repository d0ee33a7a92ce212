// From activated Gaussians to the screen and back, one Gaussian per lane. Compiled once per ISA (see isa.h for what
// that forbids).
#include "raster/features_math.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

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

// Rows of activated values.
struct GaussianRows {
    WholeRows<3> means, scales;
    WholeRows<4> quats;

    SPLAT_METHOD GaussianRows(const ActivatedGaussians& in, int64_t first, int valid)
        : means(in.means, first, valid), scales(in.scales, first, valid), quats(in.quats, first, valid) {}
    SPLAT_METHOD ActivatedLanes lanes() const {
        return {means.vec3(), scales.vec3(), {quats.column(0), quats.column(1), quats.column(2), quats.column(3)}};
    }
};

void project(const View& view, const ProjectOptions& options, const ActivatedGaussians& in, int64_t begin, int64_t end,
             const Projected& out) {
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const GaussianRows rows(in, first, valid);
        const WholeRows<1> opacities(in.opacities, first, valid);
        const ProjectedLanes p =
            project_to_screen(view, options, rows.lanes(), load(opacities.rows), out.compensations != nullptr);
        const Mask seen = p.seen;
        put_columns({only(seen, p.x), only(seen, p.y)}, out.means2d, first, valid);
        put_columns({only(seen, p.depth)}, out.depths, first, valid);
        put_columns({only(seen, p.xx), only(seen, p.xy), only(seen, p.yy)}, out.covariances, first, valid);
        put_columns({only(seen, p.determinant)}, out.determinants, first, valid);
        if (out.compensations) put_columns({only(seen, p.compensation)}, out.compensations, first, valid);
        if (out.slants) put_columns({only(seen, p.zx), only(seen, p.zy)}, out.slants, first, valid);
        float radii[2][kLanes];
        store(radii[0], only(seen, p.radius_x)), store(radii[1], only(seen, p.radius_y));
        for (int lane = 0; lane < valid; ++lane)
            for (int k = 0; k < 2; ++k) out.radii[2 * (first + lane) + k] = static_cast<int32_t>(radii[k][lane]);
    }
}

void project_backward(const View& view, const ProjectOptions& options, const ActivatedGaussians& in, int64_t begin,
                      int64_t end, const int32_t* radii, const ProjectedGradients& upstream,
                      const ActivatedGradients& out) {
    for (int64_t first = begin; first < end; first += kLanes) {
        const int valid = static_cast<int>(end - first < kLanes ? end - first : kLanes);
        const uint32_t seen = visible_lanes(radii, first, valid);
        if (!seen) continue;
        const auto by = [&](const float* from, int width, int k) {
            return column_or_zero(from, width, first, valid, k);
        };
        const GaussianRows rows(in, first, valid);
        const ScreenLanes gradient = {
            by(upstream.means2d, 2, 0),
            by(upstream.means2d, 2, 1),
            by(upstream.depths, 1, 0),
            {by(upstream.covariances, 3, 0), by(upstream.covariances, 3, 1), by(upstream.covariances, 3, 2)},
            by(upstream.compensations, 1, 0),
            by(upstream.slants, 2, 0),
            by(upstream.slants, 2, 1)};
        const ActivatedLanes d = project_to_screen_backward(view, options, rows.lanes(), gradient);
        add_columns({d.mean.x, d.mean.y, d.mean.z}, seen, out.means, first);
        add_columns(d.quat, seen, out.quats, first);
        add_columns({d.scale.x, d.scale.y, d.scale.z}, seen, out.scales, first);
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

SPLAT_INLINE PlacedLanes place_lanes(const View& view, const Features& features, const ScreenSplats& in, int64_t first,
                                     int valid) {
    const WholeRows<2> means2d(in.means2d, first, valid);
    const WholeRows<3> covariances(in.covariances, first, valid);
    const WholeRows<1> determinants(in.determinants, first, valid), opacities(in.opacities, first, valid);
    const auto slant = [&](int k) {
        return features.slanted ? column_or_zero(in.slants, 2, first, valid, k) : fill(0.0f);
    };
    const ScreenSplatLanes lanes = {
        means2d.column(0), means2d.column(1), covariances.vec3(), load(determinants.rows), load(opacities.rows),
        slant(0),          slant(1)};
    return place_on_screen(view, lanes, features.slanted);
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

// From a splat's slots to the gradients of its place, covariance, opacity and features.
void finish(const Features& features, const ScreenSplats& in, int64_t begin, int64_t end, const FrameData& frame,
            const ScreenGradients& out) {
    const int channels_at = kMomentFloats + (features.slanted ? kSlantFloats : 0);
    for (int64_t i = begin; i < end; ++i) {
        if (frame.touched[i].slots == frame.touched[i + 1].slots) continue;
        float m[kMomentFloats + kSlantFloats] = {};
        sum_slots(frame, i, 0, channels_at, m);
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
        const Splat& splat = frame.splats[i];
        const Moments moments = {m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8], m[9]};
        const float zx = features.slanted ? in.slants[2 * i] : 0.0f,
                    zy = features.slanted ? in.slants[2 * i + 1] : 0.0f;
        const PlaceGradient g = place_gradient(moments, splat.a, splat.b, splat.c, features.slanted, last, zx, zy);
        if (out.magnitudes) out.magnitudes[2 * i] += g.size_x, out.magnitudes[2 * i + 1] += g.size_y;
        if (features.slanted) out.slants[2 * i] += g.zx, out.slants[2 * i + 1] += g.zy;
        out.means2d[2 * i] += g.x, out.means2d[2 * i + 1] += g.y;
        out.covariances[3 * i] += g.xx, out.covariances[3 * i + 1] += g.xy, out.covariances[3 * i + 2] += g.yy;
        out.opacities[i] += moments.s / in.opacities[i];
    }
}

}  // namespace

extern const FeatureKernels feature_kernels = {project, project_backward, colours, colours_backward, place, finish};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
