// Compositing a render over the sky, forward and backward. Compiled once per ISA: internal linkage, no std templates.
//
// A band is processed in tiles of columns. Between two nodes of a row colours are interpolated once for the band's two
// rows of nodes; a pixel then mixes those of its column.
#include "base/rgb.h"
#include "sky/sky.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kCells = 32;                              // per tile
constexpr int kTile = kCells * kSkyMostStep;            // maximum number of columns
constexpr int kPadded = kTile + kLanes + kSkyMostStep;  // including what the last vector and the last cell may overrun

SPLAT_INLINE int least(int a, int b) { return a < b ? a : b; }

struct Tile {
    int first, last;   // columns [first, last)
    int row0, row1;    // rows [row0, row1)
    int above, below;  // rows of nodes
};

// By column of a tile: the colour at the upper row of nodes, and the difference to the lower one.
struct Lines {
    float top[3][kPadded];
    float slope[3][kPadded];
};

// Gradients of the columns of a tile, summed over its rows.
struct ColumnSums {
    float top[3][kPadded];
    float bottom[3][kPadded];
};

Tile tile_of(const SkyJob& job, int band, int first) {
    const int below = least(band + 1, job.rows - 1), row0 = band * job.step;
    return {first, least(first + kCells * job.step, job.width), row0, least(row0 + job.step, job.height), band, below};
}

void interpolate(const SkyJob& job, const float* nodes, const Tile& tile, Lines* lines) {
    const float* above = nodes + static_cast<int64_t>(tile.above) * job.columns * 3;
    const float* below = nodes + static_cast<int64_t>(tile.below) * job.columns * 3;
    const float part = 1.0f / static_cast<float>(job.step);
    const int end = tile.last - tile.first + kLanes - 1;
    for (int x = 0, left = tile.first / job.step; x < end; x += job.step, ++left) {
        const int a = least(left, job.columns - 1) * 3, b = least(left + 1, job.columns - 1) * 3;
        for (int k = 0; k < 3; ++k) {
            const float upper = above[a + k], along_upper = above[b + k] - upper;
            const float lower = below[a + k], along_lower = below[b + k] - lower;
            for (int i = 0; i < job.step; ++i) {
                const float right = static_cast<float>(i) * part, from = upper + right * along_upper;
                lines->top[k][x + i] = from - job.background[k];
                lines->slope[k][x + i] = (lower + right * along_lower) - from;
            }
        }
    }
}

SPLAT_INLINE Mask set_of(const uint8_t* bytes) {
    int32_t wide[kLanes];
    for (int i = 0; i < kLanes; ++i) wide[i] = bytes[i];
    return below(0, wide);
}

SPLAT_INLINE Floats mixed(const Lines& lines, int k, int x, Floats down) {
    return fma(down, load(lines.slope[k] + x), load(lines.top[k] + x));
}

// The colour behind a vector of a tile's pixels, minus the render's background.
SPLAT_INLINE Colours added(const Lines& nodes, const Lines& elsewhere, const uint8_t* around, int x, Floats down) {
    Colours c;
    for (int k = 0; k < 3; ++k) c.channel[k] = mixed(nodes, k, x, down);
    if (!around) return c;
    const Mask is_around = set_of(around);
    for (int k = 0; k < 3; ++k) c.channel[k] = select(is_around, c.channel[k], mixed(elsewhere, k, x, down));
    return c;
}

// The same of a row's last pixels, fewer than kLanes: their planes padded with zeros.
template <class T>
struct Padded {
    T values[kLanes];
    SPLAT_METHOD Padded(const T* p, int count) {
        for (int i = 0; i < kLanes; ++i) values[i] = p && i < count ? p[i] : T(0);
    }
};

SPLAT_INLINE Colours laid(const Colours& colour, Floats alpha, const Colours& behind) {
    Colours out;
    const Floats through = fill(1.0f) - alpha;
    for (int k = 0; k < 3; ++k) out.channel[k] = fma(through, behind.channel[k], colour.channel[k]);
    return out;
}

void forward(const SkyJob& job, int band, float* out) {
    Lines nodes, elsewhere;
    for (int first = 0; first < job.width; first += kCells * job.step) {
        const Tile tile = tile_of(job, band, first);
        interpolate(job, job.nodes, tile, &nodes);
        if (job.elsewhere) interpolate(job, job.elsewhere, tile, &elsewhere);
        for (int row = tile.row0; row < tile.row1; ++row) {
            const Floats down = fill(static_cast<float>(row - tile.row0) / static_cast<float>(job.step));
            const int64_t start = static_cast<int64_t>(row) * job.width + first;
            const uint8_t* around = job.elsewhere ? job.around + start : nullptr;
            const int count = tile.last - first;
            int x = 0;
            for (; x + kLanes <= count; x += kLanes) {
                const Colours behind = added(nodes, elsewhere, around ? around + x : nullptr, x, down);
                const float* colour = job.colour + 3 * (start + x);
                put(out + 3 * (start + x), laid(get(colour), load(job.alpha + start + x), behind));
            }
            if (x == count) continue;
            const Padded<uint8_t> last_around(around ? around + x : nullptr, count - x);
            const Padded<float> alpha(job.alpha + start + x, count - x);
            Ragged colour(job.colour + 3 * (start + x), count - x);
            const Colours behind = added(nodes, elsewhere, around ? last_around.values : nullptr, x, down);
            put(colour.pixels, laid(get(colour.pixels), load(alpha.values), behind));
            colour.to(out + 3 * (start + x), count - x);
        }
    }
}

SPLAT_INLINE Floats by_alpha(const Colours& up, const Colours& behind) {
    Floats sum = up.channel[0] * behind.channel[0];
    for (int k = 1; k < 3; ++k) sum = fma(up.channel[k], behind.channel[k], sum);
    return fill(0.0f) - sum;
}

SPLAT_INLINE void add_to(ColumnSums* sums, int x, const Colours& up, Mask is_sky, Floats through, Floats down) {
    const Floats bottom = through * down, top = through - bottom;
    for (int k = 0; k < 3; ++k) {
        store(sums->top[k] + x, load(sums->top[k] + x) + only(is_sky, top * up.channel[k]));
        store(sums->bottom[k] + x, load(sums->bottom[k] + x) + only(is_sky, bottom * up.channel[k]));
    }
}

// Adds the columns' gradients to those of the tile's nodes, in order.
void share_out(const SkyJob& job, const Tile& tile, const ColumnSums& sums, float* shares) {
    const float part = 1.0f / static_cast<float>(job.step);
    for (int x = 0, left = tile.first / job.step; x < tile.last - tile.first; x += job.step, ++left) {
        const int a = left * 3, b = least(left + 1, job.columns - 1) * 3;
        for (int k = 0; k < 3; ++k)
            for (int side = 0; side < 2; ++side) {
                const float* column = (side ? sums.bottom[k] : sums.top[k]) + x;
                float whole = 0.0f, to_right = 0.0f;
                for (int i = 0; i < job.step; ++i) {
                    whole += column[i];
                    to_right += static_cast<float>(i) * part * column[i];
                }
                shares[side * job.columns * 3 + a + k] += whole - to_right;
                shares[side * job.columns * 3 + b + k] += to_right;
            }
    }
}

void backward(const SkyJob& job, int band, const float* upstream, float* alpha_gradient, float* shares) {
    Lines nodes, elsewhere;
    ColumnSums sums;
    if (shares)
        for (int i = 0; i < 2 * 3 * job.columns; ++i) shares[i] = 0.0f;
    for (int first = 0; first < job.width; first += kCells * job.step) {
        const Tile tile = tile_of(job, band, first);
        interpolate(job, job.nodes, tile, &nodes);
        if (job.elsewhere) interpolate(job, job.elsewhere, tile, &elsewhere);
        bool counts = false;
        for (int row = tile.row0; row < tile.row1; ++row) {
            const Floats down = fill(static_cast<float>(row - tile.row0) / static_cast<float>(job.step));
            const int64_t start = static_cast<int64_t>(row) * job.width + first;
            const int count = tile.last - first;
            for (int x = 0; x < count; x += kLanes) {
                const int left = count - x;
                const int64_t pixel = start + x;
                const auto with = [&](const uint8_t* around, const uint8_t* mask, const float* alpha,
                                      const float* given, float* gradient) {
                    const Colours up = get(given), behind = added(nodes, elsewhere, around, x, down);
                    store(gradient, by_alpha(up, behind));
                    if (!shares) return;
                    const Mask is_sky = set_of(mask);
                    if (!any(is_sky)) return;
                    if (!counts) sums = ColumnSums{}, counts = true;
                    add_to(&sums, x, up, is_sky, fill(1.0f) - load(alpha), down);
                };
                const uint8_t* around = job.elsewhere ? job.around + pixel : nullptr;
                const uint8_t* mask = shares ? job.mask + pixel : nullptr;
                if (left >= kLanes) {
                    with(around, mask, job.alpha + pixel, upstream + 3 * pixel, alpha_gradient + pixel);
                    continue;
                }
                const Padded<uint8_t> last_around(around, left), last_mask(mask, left);
                const Padded<float> alpha(job.alpha + pixel, left);
                const Ragged given(upstream + 3 * pixel, left);
                float gradient[kLanes];
                with(around ? last_around.values : nullptr, last_mask.values, alpha.values, given.pixels, gradient);
                for (int i = 0; i < left; ++i) alpha_gradient[pixel + i] = gradient[i];
            }
        }
        if (counts) share_out(job, tile, sums, shares);
    }
}

}  // namespace

extern const SkyKernels sky_kernels = {forward, backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
