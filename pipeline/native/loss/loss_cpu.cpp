// A tile of the photometric loss and its gradient. Compiled once per ISA: internal linkage, no std templates.
// The formulas are loss_math.h's.
//
// A tile is processed in bands of rows; each blur goes down the columns first, for a band at once with the sums in
// registers, then along the rows. RGB stays interleaved: a row's taps are 3 floats apart. In all rows of the scratch a
// column is at the same place, so that loads are aligned: one that crosses a cache line costs as much as four.
//
// Beyond the image a row shows its reflection. With that, the transposed blur is the blur itself between two scalings:
// B^T = D B D^-1, D = 1/2 in the first and last row and column, 1 elsewhere.

#include "base/simd.h"
#include "loss/loss.h"
#include "loss/loss_math.h"

namespace splat::SPLAT_ISA_NAMESPACE {
namespace {

#if SPLAT_ISA_AVX512
constexpr int kRegisterRows = 8;
#else
constexpr int kRegisterRows = 4;
#endif
constexpr int kRadius = kLossRadius, kTaps = kLossTaps, kChannels = 3;
constexpr int kReach = kRadius * kChannels;  // floats on each side of a window's centre
constexpr int kBand = 8;
// Rows kept, by row % kRing: those between a gradient's window and the one that the next band's means need.
constexpr int kRing = 28;
constexpr int kAlign = 16;         // floats in a cache line
constexpr int kLead = 2 * kAlign;  // of a row, before the tile's first column
static_assert(kLead >= 2 * kReach, "a window's means reach twice as far");
constexpr int kStride = (kLead + kLossTileCols * kChannels + 2 * kReach + kAlign - 1) / kAlign * kAlign + kAlign;

static_assert(kBand % kRegisterRows == 0, "a band is whole register blocks");
static_assert(kStride * (kRing * 5 + kBand * 4 + 4) <= int(kLossScratch), "scratch");
static_assert(kLossMinSide * kChannels >= kLanes, "a row has a whole vector");

SPLAT_INLINE int least(int a, int b) { return a < b ? a : b; }
SPLAT_INLINE int most(int a, int b) { return a > b ? a : b; }

// The window's weights, broadcast to all lanes: they stay in registers throughout a loop, whatever it stores.
struct Window {
    Floats at[kRadius + 1];
};

SPLAT_INLINE Window window_of(const float* taps) {
    Window window;
    for (int d = 0; d <= kRadius; ++d) window.at[d] = fill(taps[d]);
    return window;
}

// Rings of kRing rows, bands of kBand rows, and single rows, of kStride floats each. Vectors reach beside the columns:
// what is there, of whatever image, is processed, too, and never gets into a column.
struct Scratch {
    float *u, *v;     // rings
    float* maps[3];   // a, b_u, b_v, times 1/D: rings
    float* means[4];  // of u, u^2, v, v^2, or of the maps, down the columns: bands
    float *dissimilarity, *counts, *inside;
    float* share;  // D along a row
};

Scratch divide(float* memory) {
    const auto take = [&](int rows) {
        memory += rows * kStride;
        return memory - rows * kStride;
    };
    Scratch s;
    s.u = take(kRing), s.v = take(kRing);
    for (float*& ring : s.maps) ring = take(kRing);
    for (float*& band : s.means) band = take(kBand);
    s.dissimilarity = take(1), s.counts = take(1), s.inside = take(1), s.share = take(1);
    return s;
}

SPLAT_INLINE float* row_of(float* ring, int row) { return ring + row % kRing * kStride; }

// A tile's pixels, and those of the maps that its gradient needs: half a window more, within the image.
struct Span {
    LossTile own;
    int row0, row1, col0, col1;

    // Where a column is in a row of the scratch.
    int at(int col) const { return kLead + (col - own.col0) * kChannels; }
    // Where the vectors begin and end that cover the columns of the maps.
    int begin() const { return at(col0) / kAlign * kAlign; }
    int end() const { return at(col1); }
};

// Fill what lies beyond the image in a row by reflection, as far as half a window from the columns from..to-1.
void reflect_row(float* row, const Span& span, int from, int to, int width) {
    const auto copy = [&](int col) {
        for (int c = 0; c < kChannels; ++c) row[span.at(col) + c] = row[span.at(reflected(col, width)) + c];
    };
    for (int col = from - kRadius; col < 0; ++col) copy(col);
    for (int col = width; col < to + kRadius; ++col) copy(col);
}

SPLAT_INLINE void scale_pixel(float* pixel, float factor) {
    for (int c = 0; c < kChannels; ++c) pixel[c] *= factor;
}

// The first and the last column of the image in a row, if the span has them.
SPLAT_INLINE void scale_sides(float* row, const Span& span, int width, float factor) {
    if (span.col0 == 0) scale_pixel(row + span.at(0), factor);
    if (span.col1 == width) scale_pixel(row + span.at(width - 1), factor);
}

SPLAT_INLINE bool is_edge(int row, int height) { return row == 0 || row == height - 1; }

// u and v of an image's row.
void fill_row(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const int first = most(0, span.col0 - kRadius), n = (least(job.width, span.col1 + kRadius) - first) * kChannels;
    const std::ptrdiff_t offset = (std::ptrdiff_t(row) * job.width + first) * kChannels;
    float *const u = row_of(s.u, row), *const v = row_of(s.v, row);
    for (int i = 0; i < n; i += kLanes) {
        const int j = least(i, n - kLanes);
        const Floats x = load(job.render + offset + j), y = load(job.photo + offset + j);
        store(u + span.at(first) + j, x + y - 1.0f), store(v + span.at(first) + j, x - y);
    }
    reflect_row(u, span, span.col0, span.col1, job.width), reflect_row(v, span, span.col0, span.col1, job.width);
}

// Down the columns: windowed sums of kRegisterRows rows, and with kSquares of the squares, for n floats. rows: the
// kRegisterRows + 10 rows that they reach.
template <bool kSquares>
SPLAT_INLINE void blur_columns(const float* const* rows, const float* taps, int n, float* out, float* out_squares) {
    const Window window = window_of(taps);
    for (int j = 0; j < n; j += kLanes) {
        Floats sum[kRegisterRows] = {}, squares[kRegisterRows] = {};
#pragma GCC unroll 18
        for (int i = 0; i < kRegisterRows + kTaps - 1; ++i) {
            const Floats s = load(rows[i] + j), s2 = s * s;
#pragma GCC unroll 8
            for (int r = 0; r < kRegisterRows; ++r) {
                const int k = i - r - kRadius, distance = k < 0 ? -k : k;
                if (distance > kRadius) continue;
                sum[r] = fma(window.at[distance], s, sum[r]);
                if (kSquares) squares[r] = fma(window.at[distance], s2, squares[r]);
            }
        }
#pragma GCC unroll 8
        for (int r = 0; r < kRegisterRows; ++r) {
            store(out + r * kStride + j, sum[r]);
            if (kSquares) store(out_squares + r * kStride + j, squares[r]);
        }
    }
}

// The same for the kBand rows of a ring from `row` on: to bands.
template <bool kSquares>
void blur_band(const LossJob& job, float* ring, int row, int n, float* out, float* out_squares) {
    for (int block = 0; block < kBand; block += kRegisterRows) {
        const float* rows[kRegisterRows + kTaps - 1];
        for (int i = 0; i < kRegisterRows + kTaps - 1; ++i)
            rows[i] = row_of(ring, reflected(row + block + i - kRadius, job.height));
        const int at = block * kStride;
        blur_columns<kSquares>(rows, job.taps, n, out + at, kSquares ? out_squares + at : nullptr);
    }
}

// Along the row: windowed sums, centred on p[0], p[1], ...
#if SPLAT_ISA_AVX512
template <int kFloats>
SPLAT_INLINE Floats shifted(Floats low, Floats high) {  // the floats from kFloats on
    return _mm512_castsi512_ps(_mm512_alignr_epi32(_mm512_castps_si512(high), _mm512_castps_si512(low), kFloats));
}
template <int kDistance>
SPLAT_INLINE Floats both_sides(Floats before, Floats here, Floats after) {
    constexpr int kShift = kDistance * kChannels;
    return shifted<kLanes - kShift>(before, here) + shifted<kShift>(here, after);
}
SPLAT_INLINE Floats blur_along(const float* p, const Window& window) {
    const Floats before = load(p - kLanes), here = load(p), after = load(p + kLanes);
    Floats sum = window.at[0] * here;
    sum = fma(window.at[1], both_sides<1>(before, here, after), sum);
    sum = fma(window.at[2], both_sides<2>(before, here, after), sum);
    sum = fma(window.at[3], both_sides<3>(before, here, after), sum);
    sum = fma(window.at[4], both_sides<4>(before, here, after), sum);
    return fma(window.at[5], both_sides<5>(before, here, after), sum);
}
#else
SPLAT_INLINE Floats blur_along(const float* p, const Window& window) {
    Floats sum = window.at[0] * load(p);
#pragma GCC unroll 5
    for (int d = 1; d <= kRadius; ++d) sum = fma(window.at[d], load(p - d * kChannels) + load(p + d * kChannels), sum);
    return sum;
}
#endif

// Each pixel's 0 or 1 for its three channels, in out; null if every pixel counts, as in most rows of most masks.
const float* expand_mask(const std::uint8_t* mask, int pixels, float* out) {
    int masked = 0;
    for (int i = 0; i < pixels; ++i) masked += mask[i] == 0;
    if (!masked) return nullptr;
    for (int i = 0; i < pixels; ++i)
        for (int c = 0; c < kChannels; ++c) out[i * kChannels + c] = mask[i] ? 1.0f : 0.0f;
    return out;
}

// Which of n pixels of a row, starting at a column, are in the inner rectangle: [from, to).
struct Part {
    int from, to;
};

SPLAT_INLINE Part inner_part(const LossTile& inner, int row, int col, int n) {
    if (row < inner.row0 || row >= inner.row1) return {0, 0};
    const int from = most(0, least(inner.col0 - col, n));
    return {from, most(from, least(inner.col1 - col, n))};
}

// `counts` (null: all ones) zeroed outside the inner rectangle: in out, or `counts` itself if nothing is outside.
const float* confine(const Part& part, const float* counts, int pixels, float* out) {
    if (part.from == 0 && part.to == pixels) return counts;
    for (int i = 0; i < pixels * kChannels; ++i)
        out[i] = i < part.from * kChannels || i >= part.to * kChannels ? 0.0f : (counts ? counts[i] : 1.0f);
    return out;
}

// The sum of n values, or of their magnitudes.
template <bool kMagnitudes>
double sum_of(const float* p, int n) {
    Floats lanes = {};
    int j = 0;
    for (; j + kLanes <= n; j += kLanes) lanes += kMagnitudes ? magnitude(load(p + j)) : load(p + j);
    double sum = 0.0;
    for (int l = 0; l < kLanes; ++l) sum += lanes[l];
    for (; j < n; ++j) sum += kMagnitudes ? __builtin_fabsf(p[j]) : p[j];
    return sum;
}

// 1 - SSIM at each value of a row from the column means, and its derivatives with respect to the windowed means.
SPLAT_INLINE void similarity_row(const float* const* means, const float* taps, const float* counts, int begin, int end,
                                 float* const* maps, float* out) {
    const Window window = window_of(taps);
    for (int j = begin; j < end; j += kLanes) {
        Floats by_means, by_u2, by_v2;
        Floats dissimilarity = dissimilarity_of(blur_along(means[0] + j, window), blur_along(means[1] + j, window),
                                                blur_along(means[2] + j, window), blur_along(means[3] + j, window),
                                                &by_means, &by_u2, &by_v2);
        if (counts) {
            const Floats count = load(counts + j);
            by_means *= count, by_u2 *= count, by_v2 *= count, dissimilarity *= count;
        }
        store(out + j, dissimilarity);
        store(maps[0] + j, by_means), store(maps[1] + j, by_u2), store(maps[2] + j, by_v2);
    }
}

// From a row of a map, as computed, to what its blurs read.
void end_map(float* map, const LossJob& job, const Span& span, int row) {
    if (is_edge(row, job.height))
        for (int i = span.at(span.col0); i < span.at(span.col1); ++i) map[i] *= 2.0f;
    scale_sides(map, span, job.width, 2.0f);
    reflect_row(map, span, span.own.col0, span.own.col1, job.width);
}

// The maps of rows [row, row + kBand), as many as the span has; returns the sum over the tile's own pixels.
double similarity_band(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const int n = span.end() + kReach;
    blur_band<true>(job, s.u, row, n, s.means[0], s.means[1]);
    blur_band<true>(job, s.v, row, n, s.means[2], s.means[3]);
    double sum = 0.0;
    for (int r = row; r < least(row + kBand, span.row1); ++r) {
        const float* means[4];
        float* maps[3];
        for (int p = 0; p < 4; ++p) means[p] = s.means[p] + (r - row) * kStride;
        for (int p = 0; p < 3; ++p) maps[p] = row_of(s.maps[p], r);
        const int pixels = span.col1 - span.col0, at = span.at(span.col0);
        const float* counts = nullptr;
        if (job.mask) counts = expand_mask(job.mask + std::ptrdiff_t(r) * job.width + span.col0, pixels, s.counts + at);
        counts = confine(inner_part(job.inner, r, span.col0, pixels), counts, pixels, s.counts + at);
        similarity_row(means, job.taps, counts ? s.counts : nullptr, span.begin(), span.end(), maps, s.dissimilarity);
        for (float* map : maps) end_map(map, job, span, r);
        if (r >= span.own.row0 && r < span.own.row1)
            sum += sum_of<false>(s.dissimilarity + kLead, (span.own.col1 - span.own.col0) * kChannels);
    }
    return sum;
}

// What multiplies the values of a row, from the tile's first column on: of the blurred maps; 0 where a pixel is masked;
// of the absolute difference, where it is not inside.
struct Factors {
    const float *share, *counts, *inside;  // the last two null: 1
};

// The gradient of n values of a row, from its u, v and the maps, blurred down the columns.
SPLAT_INLINE void gradient_row(const LossJob& job, const float* u, const float* v, const float* const* maps,
                               const Factors& factors, float ssim_scale, int n, float* out) {
    const Window window = window_of(job.taps);
    for (int i = 0; i < n; i += kLanes) {
        const int j = least(i, n - kLanes);
        const Floats a = blur_along(maps[0] + j, window);
        const Floats b_u = blur_along(maps[1] + j, window), b_v = blur_along(maps[2] + j, window);
        const Floats difference = load(v + j), zero = fill(0.0f), one = fill(1.0f);
        Floats sign = only(less(zero, difference), one) - only(less(difference, zero), one);
        if (factors.inside) sign *= load(factors.inside + j);
        const Floats similarity = load(factors.share + j) * (a + 2.0f * (load(u + j) * b_u + difference * b_v));
        Floats gradient = job.l1_scale * sign + ssim_scale * similarity;
        if (factors.counts) gradient *= load(factors.counts + j);
        store(out + j, gradient);
    }
}

// The gradient of rows [row, row + kBand), as many as the tile has.
void gradient_band(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const LossTile& own = span.own;
    const int pixels = own.col1 - own.col0, n = pixels * kChannels;
    for (int p = 0; p < 3; ++p) blur_band<false>(job, s.maps[p], row, kLead + n + kReach, s.means[p], nullptr);
    for (int r = row; r < least(row + kBand, own.row1); ++r) {
        const float* maps[3];
        for (int p = 0; p < 3; ++p) maps[p] = s.means[p] + (r - row) * kStride + kLead;
        const std::ptrdiff_t start = std::ptrdiff_t(r) * job.width + own.col0;
        Factors factors{s.share + kLead, nullptr, nullptr};
        if (job.mask) factors.counts = expand_mask(job.mask + start, pixels, s.counts + kLead);
        factors.inside = confine(inner_part(job.inner, r, own.col0, pixels), nullptr, pixels, s.inside + kLead);
        gradient_row(job, row_of(s.u, r) + kLead, row_of(s.v, r) + kLead, maps, factors,
                     is_edge(r, job.height) ? 0.5f * job.ssim_scale : job.ssim_scale, n,
                     job.gradient + start * kChannels);
    }
}

// The sum of absolute differences of a row's pixels that are the tile's own and inside.
double differences(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const LossTile& own = span.own;
    if (row < own.row0 || row >= own.row1) return 0.0;
    const Part part = inner_part(job.inner, row, own.col0, own.col1 - own.col0);
    return sum_of<true>(row_of(s.v, row) + kLead + part.from * kChannels, (part.to - part.from) * kChannels);
}

LossSums loss_tile(const LossJob& job, const LossTile& own, float* memory) {
    const Scratch scratch = divide(memory);
    const Span span{own, most(0, own.row0 - kRadius), least(job.height, own.row1 + kRadius),
                    most(0, own.col0 - kRadius), least(job.width, own.col1 + kRadius)};
    for (int i = 0; i < kStride; ++i) scratch.share[i] = 1.0f;
    scale_sides(scratch.share, span, job.width, 0.5f);
    LossSums sums{0.0, 0.0};
    int filled = most(0, span.row0 - kRadius), done = own.row0;
    for (int row = span.row0; row < span.row1; row += kBand) {
        for (; filled < least(job.height, row + kBand + kRadius); ++filled) {
            fill_row(job, span, scratch, filled);
            sums.l1 += differences(job, span, scratch, filled);
        }
        sums.dissimilarity += similarity_band(job, span, scratch, row);
        const int known = least(row + kBand, span.row1);
        for (; done < own.row1 && (done + kBand + kRadius <= known || known == span.row1); done += kBand)
            gradient_band(job, span, scratch, done);
    }
    return sums;
}

}  // namespace

extern const LossKernels loss_kernels = {loss_tile};

}  // namespace splat::SPLAT_ISA_NAMESPACE
