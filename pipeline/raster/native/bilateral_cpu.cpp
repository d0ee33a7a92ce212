// A picture's colours through a bilateral grid of affine maps, and back. Compiled once per ISA: internal linkage, no
// std templates.
//
// A vector is of neighbouring pixels of a row. Its columns' maps, interpolated along the row, are made once for all
// rows between two rows of nodes; a pixel then interpolates down and by its luminance. Of the levels, only those that
// some pixel of a vector lies next to are visited: two or three, however many there are.
#include "bilateral.h"
#include "rgb.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kLuma[3] = {0.299f, 0.587f, 0.114f};  // ITU-R BT.601, of gamma-coded colours

// Twelve vectors a level: the entries of the columns' maps.
struct Maps {
    Floats of[kGridLevels][kAffine];
    SPLAT_METHOD void clear(int levels) {
        for (int d = 0; d < levels; ++d)
            for (int k = 0; k < kAffine; ++k) of[d][k] = fill(0.0f);
    }
};

SPLAT_INLINE int bounded(int x, int low, int high) { return x < low ? low : x > high ? high : x; }

// kLanes columns of pixels, from x on, before the nodes.
struct Columns {
    Floats place;  // along the row, in nodes
    int first, last;

    SPLAT_METHOD Columns(const GridChunk& chunk, int64_t x) {
        const float step = static_cast<float>(chunk.columns - 1) / static_cast<float>(chunk.width);
        float places[kLanes];
        for (int i = 0; i < kLanes; ++i) places[i] = (static_cast<float>(x + i) + 0.5f) * step;
        place = load(places);
        // Pixels past the picture's edge may lie past the chunk's nodes: they count nowhere.
        const int end = chunk.first_node + chunk.nodes - 1;
        first = bounded(static_cast<int>(places[0]), chunk.first_node, end - 1);
        last = bounded(static_cast<int>(places[kLanes - 1]) + 1, first + 1, end);
    }
    SPLAT_METHOD Floats weight(int node) const {
        return max(fill(1.0f) - magnitude(place - fill(static_cast<float>(node))), fill(0.0f));
    }
};

SPLAT_INLINE const float* map_at(const GridChunk& chunk, int level, int row, int column) {
    return chunk.maps + ((static_cast<int64_t>(level) * chunk.rows + row) * chunk.columns + column) * kAffine;
}

// The columns' maps at the row of nodes above, and what they grow by down to the one below.
SPLAT_INLINE void interpolate(const GridChunk& chunk, const Columns& columns, Maps* above, Maps* growth) {
    above->clear(chunk.levels), growth->clear(chunk.levels);
    for (int node = columns.first; node <= columns.last; ++node) {
        const Floats weight = columns.weight(node);
        for (int d = 0; d < chunk.levels; ++d) {
            const float *top = map_at(chunk, d, chunk.cell, node), *bottom = map_at(chunk, d, chunk.cell + 1, node);
            for (int k = 0; k < kAffine; ++k) {
                above->of[d][k] = fma(weight, fill(top[k]), above->of[d][k]);
                growth->of[d][k] = fma(weight, fill(bottom[k] - top[k]), growth->of[d][k]);
            }
        }
    }
}

// How far down between the rows of nodes a row of pixels is, 0..1.
SPLAT_INLINE Floats share_down(const GridChunk& chunk, int64_t y) {
    const float step = static_cast<float>(chunk.rows - 1) / static_cast<float>(chunk.height);
    return fill((static_cast<float>(y) + 0.5f) * step - static_cast<float>(chunk.cell));
}

SPLAT_INLINE Floats luminance(const Colours& c) {
    return fma(fill(kLuma[0]), c.channel[0], fma(fill(kLuma[1]), c.channel[1], fill(kLuma[2]) * c.channel[2]));
}

SPLAT_INLINE Floats level_of(const Floats& luminance, int levels) {
    return clamp(luminance, fill(0.0f), fill(1.0f)) * fill(static_cast<float>(levels - 1));
}

SPLAT_INLINE Colours sliced(const Maps& above, const Maps& growth, int levels, const Floats& down, const Colours& in) {
    const Floats place = level_of(luminance(in), levels);
    Floats map[kAffine];
    for (int k = 0; k < kAffine; ++k) map[k] = fill(0.0f);
    for (int d = 0; d < levels; ++d) {
        const Floats away = magnitude(place - fill(static_cast<float>(d)));
        if (!any(less(away, fill(1.0f)))) continue;
        const Floats weight = max(fill(1.0f) - away, fill(0.0f)), lower = weight * down;
        for (int k = 0; k < kAffine; ++k) map[k] = fma(weight, above.of[d][k], fma(lower, growth.of[d][k], map[k]));
    }
    Colours out;
    for (int i = 0; i < 3; ++i)
        out.channel[i] = fma(map[4 * i], in.channel[0],
                             fma(map[4 * i + 1], in.channel[1], fma(map[4 * i + 2], in.channel[2], map[4 * i + 3])));
    return out;
}

// A level's weight grows with the place up to it and falls past it. At a level, what is above counts, but at the last.
SPLAT_INLINE Floats slope_at(const Floats& cell, int level) {
    const Floats before = fill(static_cast<float>(level - 1)), at = fill(static_cast<float>(level));
    const Floats rising = only(both(at_most(before, cell), at_most(cell, before)), fill(1.0f));
    return rising - only(both(at_most(at, cell), at_most(cell, at)), fill(1.0f));
}

// dL/d(in); adds dL/d(map) to `upper`, and its part that goes down the rows to `lower`.
SPLAT_INLINE Colours sliced_back(const Maps& above, const Maps& growth, int levels, const Floats& down,
                                 const Colours& in, const Colours& up, Maps* upper, Maps* lower) {
    const Floats brightness = luminance(in), place = level_of(brightness, levels);
    const Floats cell = min(floor(place), fill(static_cast<float>(levels - 2)));
    Floats products[kAffine], map[kAffine], by_place = fill(0.0f);  // dL/d(map of the pixel), that map
    for (int k = 0; k < kAffine; ++k) {
        products[k] = k % 4 == 3 ? up.channel[k / 4] : up.channel[k / 4] * in.channel[k % 4];
        map[k] = fill(0.0f);
    }
    for (int d = 0; d < levels; ++d) {
        const Floats away = magnitude(place - fill(static_cast<float>(d)));
        if (!any(at_most(away, fill(1.0f)))) continue;
        const Floats weight = max(fill(1.0f) - away, fill(0.0f)), weight_down = weight * down;
        Floats change = fill(0.0f);
        for (int k = 0; k < kAffine; ++k) {
            const Floats entry = fma(down, growth.of[d][k], above.of[d][k]);
            if (k % 4 != 3) map[k] = fma(weight, entry, map[k]);
            change = fma(products[k], entry, change);
            upper->of[d][k] = fma(weight, products[k], upper->of[d][k]);
            lower->of[d][k] = fma(weight_down, products[k], lower->of[d][k]);
        }
        by_place = fma(slope_at(cell, d), change, by_place);
    }
    const Mask inside = both(at_most(fill(0.0f), brightness), at_most(brightness, fill(1.0f)));
    const Floats by_luminance = only(inside, by_place * fill(static_cast<float>(levels - 1)));
    Colours by_in;
    for (int j = 0; j < 3; ++j)
        by_in.channel[j] =
            fma(map[j], up.channel[0],
                fma(map[4 + j], up.channel[1], fma(map[8 + j], up.channel[2], by_luminance * fill(kLuma[j]))));
    return by_in;
}

void forward(const GridChunk& chunk, const float* in, float* out) {
    Maps above, growth;
    for (int64_t x = chunk.first_x; x < chunk.last_x; x += kLanes) {
        interpolate(chunk, Columns(chunk, x), &above, &growth);
        const int64_t count = chunk.last_x - x;
        for (int64_t y = chunk.first_y; y < chunk.last_y; ++y) {
            const int64_t at = 3 * (y * chunk.width + x);
            const Floats down = share_down(chunk, y);
            if (count >= kLanes) {
                put(out + at, sliced(above, growth, chunk.levels, down, get(in + at)));
            } else {
                Ragged last(in + at, count);
                put(last.pixels, sliced(above, growth, chunk.levels, down, get(last.pixels)));
                last.to(out + at, count);
            }
        }
    }
}

// A block's dL/d(map) to the nodes left and right of its columns.
SPLAT_INLINE void add_to_nodes(const GridChunk& chunk, const Columns& columns, const Maps& upper, const Maps& lower,
                               float* sums) {
    for (int node = columns.first; node <= columns.last; ++node) {
        const Floats weight = columns.weight(node);
        for (int d = 0; d < chunk.levels; ++d) {
            float* top = sums + (d * chunk.nodes + node - chunk.first_node) * kAffine;
            float* bottom = top + chunk.levels * chunk.nodes * kAffine;
            for (int k = 0; k < kAffine; k += 4) {
                Floats rising[4], falling[4];
                for (int i = 0; i < 4; ++i) {
                    rising[i] = weight * lower.of[d][k + i];
                    falling[i] = weight * (upper.of[d][k + i] - lower.of[d][k + i]);
                }
                float parts[8];
                sum_lanes(falling[0], falling[1], falling[2], falling[3], parts);
                sum_lanes(rising[0], rising[1], rising[2], rising[3], parts + 4);
                for (int i = 0; i < 4; ++i) top[k + i] += parts[i], bottom[k + i] += parts[4 + i];
            }
        }
    }
}

void backward(const GridChunk& chunk, const float* in, const float* upstream, float* gradient, float* sums) {
    Maps above, growth, upper, lower;
    for (int64_t x = chunk.first_x; x < chunk.last_x; x += kLanes) {
        const Columns columns(chunk, x);
        interpolate(chunk, columns, &above, &growth);
        upper.clear(chunk.levels), lower.clear(chunk.levels);
        const int64_t count = chunk.last_x - x;
        for (int64_t y = chunk.first_y; y < chunk.last_y; ++y) {
            const int64_t at = 3 * (y * chunk.width + x);
            const Floats down = share_down(chunk, y);
            if (count >= kLanes) {
                put(gradient + at,
                    sliced_back(above, growth, chunk.levels, down, get(in + at), get(upstream + at), &upper, &lower));
            } else {
                const Ragged last(in + at, count);
                Ragged up(upstream + at, count);
                const Colours colours = get(up.pixels);
                put(up.pixels,
                    sliced_back(above, growth, chunk.levels, down, get(last.pixels), colours, &upper, &lower));
                up.to(gradient + at, count);
            }
        }
        add_to_nodes(chunk, columns, upper, lower, sums);
    }
}

}  // namespace

extern const BilateralKernels bilateral_kernels = {forward, backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
