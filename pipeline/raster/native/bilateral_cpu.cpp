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

constexpr int kLine = 16;      // floats of a cache line
constexpr int64_t kAhead = 4;  // rows: a row's vector is in lines, and mostly a page, of its own, which no CPU foresees

// A level's maps for a vector of columns, entry by entry, and dL/d(them). What is used together lies together: arrays
// of their own would be multiples of 4096 bytes apart, where a CPU takes a load for one of what was just stored.
struct Level {
    Floats above[kAffine], growth[kAffine];  // at the row of nodes above, and by what it grows down to the one below
    Floats upper[kAffine], lower[kAffine];   // dL/d(map of a pixel), all of it and the part that goes down the rows
};

SPLAT_INLINE void clear(Floats* entries) {
    for (int k = 0; k < kAffine; ++k) entries[k] = fill(0.0f);
}

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

SPLAT_INLINE void interpolate(const GridChunk& chunk, const Columns& columns, Level* levels) {
    for (int d = 0; d < chunk.levels; ++d) {
        Level& level = levels[d];
        clear(level.above), clear(level.growth), clear(level.upper), clear(level.lower);
        for (int node = columns.first; node <= columns.last; ++node) {
            const Floats weight = columns.weight(node);
            const float *top = map_at(chunk, d, chunk.cell, node), *bottom = map_at(chunk, d, chunk.cell + 1, node);
            for (int k = 0; k < kAffine; ++k) {
                level.above[k] = fma(weight, fill(top[k]), level.above[k]);
                level.growth[k] = fma(weight, fill(bottom[k] - top[k]), level.growth[k]);
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

SPLAT_INLINE Colours sliced(const Level* levels, int count, const Floats& down, const Colours& in) {
    const Floats place = level_of(luminance(in), count);
    Floats map[kAffine];
    for (int k = 0; k < kAffine; ++k) map[k] = fill(0.0f);
    for (int d = 0; d < count; ++d) {
        const Floats away = magnitude(place - fill(static_cast<float>(d)));
        if (!any(less(away, fill(1.0f)))) continue;
        const Floats weight = max(fill(1.0f) - away, fill(0.0f)), lower = weight * down;
        for (int k = 0; k < kAffine; ++k)
            map[k] = fma(weight, levels[d].above[k], fma(lower, levels[d].growth[k], map[k]));
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

// dL/d(in); adds dL/d(maps) to the levels.
SPLAT_INLINE Colours sliced_back(Level* levels, int count, const Floats& down, const Colours& in, const Colours& up) {
    const Floats brightness = luminance(in), place = level_of(brightness, count);
    const Floats cell = min(floor(place), fill(static_cast<float>(count - 2)));
    Floats products[kAffine], map[kAffine], by_place = fill(0.0f);  // dL/d(map of the pixel), that map
    for (int k = 0; k < kAffine; ++k) {
        products[k] = k % 4 == 3 ? up.channel[k / 4] : up.channel[k / 4] * in.channel[k % 4];
        map[k] = fill(0.0f);
    }
    for (int d = 0; d < count; ++d) {
        const Floats away = magnitude(place - fill(static_cast<float>(d)));
        if (!any(at_most(away, fill(1.0f)))) continue;
        const Floats weight = max(fill(1.0f) - away, fill(0.0f)), weight_down = weight * down;
        Level& level = levels[d];
        Floats change = fill(0.0f);
        for (int k = 0; k < kAffine; ++k) {
            const Floats entry = fma(down, level.growth[k], level.above[k]);
            if (k % 4 != 3) map[k] = fma(weight, entry, map[k]);
            change = fma(products[k], entry, change);
            level.upper[k] = fma(weight, products[k], level.upper[k]);
            level.lower[k] = fma(weight_down, products[k], level.lower[k]);
        }
        by_place = fma(slope_at(cell, d), change, by_place);
    }
    const Mask inside = both(at_most(fill(0.0f), brightness), at_most(brightness, fill(1.0f)));
    const Floats by_luminance = only(inside, by_place * fill(static_cast<float>(count - 1)));
    Colours by_in;
    for (int j = 0; j < 3; ++j)
        by_in.channel[j] =
            fma(map[j], up.channel[0],
                fma(map[4 + j], up.channel[1], fma(map[8 + j], up.channel[2], by_luminance * fill(kLuma[j]))));
    return by_in;
}

SPLAT_INLINE void prefetch(const float* colours) {
    for (int i = 0; i < 3 * kLanes; i += kLine) __builtin_prefetch(colours + i);
}

void forward(const GridChunk& chunk, const float* in, float* out) {
    Level levels[kGridLevels];
    for (int64_t x = chunk.first_x; x < chunk.last_x; x += kLanes) {
        interpolate(chunk, Columns(chunk, x), levels);
        const int64_t count = chunk.last_x - x, ahead = 3 * chunk.width * kAhead;
        for (int64_t y = chunk.first_y; y < chunk.last_y; ++y) {
            const int64_t at = 3 * (y * chunk.width + x);
            const Floats down = share_down(chunk, y);
            if (y + kAhead < chunk.last_y) prefetch(in + at + ahead), prefetch(out + at + ahead);
            if (count >= kLanes) {
                put(out + at, sliced(levels, chunk.levels, down, get(in + at)));
            } else {
                Ragged last(in + at, count);
                put(last.pixels, sliced(levels, chunk.levels, down, get(last.pixels)));
                last.to(out + at, count);
            }
        }
    }
}

// A block's dL/d(map) to the nodes left and right of its columns.
SPLAT_INLINE void add_to_nodes(const GridChunk& chunk, const Columns& columns, const Level* levels, float* sums) {
    for (int node = columns.first; node <= columns.last; ++node) {
        const Floats weight = columns.weight(node);
        for (int d = 0; d < chunk.levels; ++d) {
            float* top = sums + (d * chunk.nodes + node - chunk.first_node) * kAffine;
            float* bottom = top + chunk.levels * chunk.nodes * kAffine;
            for (int k = 0; k < kAffine; k += 4) {
                Floats rising[4], falling[4];
                for (int i = 0; i < 4; ++i) {
                    rising[i] = weight * levels[d].lower[k + i];
                    falling[i] = weight * (levels[d].upper[k + i] - levels[d].lower[k + i]);
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
    Level levels[kGridLevels];
    for (int64_t x = chunk.first_x; x < chunk.last_x; x += kLanes) {
        const Columns columns(chunk, x);
        interpolate(chunk, columns, levels);
        const int64_t count = chunk.last_x - x, ahead = 3 * chunk.width * kAhead;
        for (int64_t y = chunk.first_y; y < chunk.last_y; ++y) {
            const int64_t at = 3 * (y * chunk.width + x);
            const Floats down = share_down(chunk, y);
            if (y + kAhead < chunk.last_y)
                prefetch(in + at + ahead), prefetch(upstream + at + ahead), prefetch(gradient + at + ahead);
            if (count >= kLanes) {
                put(gradient + at, sliced_back(levels, chunk.levels, down, get(in + at), get(upstream + at)));
            } else {
                const Ragged last(in + at, count);
                Ragged up(upstream + at, count);
                const Colours colours = get(up.pixels);
                put(up.pixels, sliced_back(levels, chunk.levels, down, get(last.pixels), colours));
                up.to(gradient + at, count);
            }
        }
        add_to_nodes(chunk, columns, levels, sums);
    }
}

}  // namespace

extern const BilateralKernels bilateral_kernels = {forward, backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
