// A tile of the photometric loss and its gradient. Compiled once per ISA: internal linkage, no std templates.
// The formulas are loss_math.h's.
//
// A tile is processed in bands of rows; each blur goes down the columns first, for a band at once with the sums in
// registers, then along the rows. RGB stays interleaved: a row's taps are 3 floats apart.

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
constexpr int kRadius = kLossRadius, kTaps = kLossTaps, kBorder = kLossBorder, kChannels = 3;
constexpr int kBand = 8;
constexpr int kRing = 32;   // rows of maps kept: a band, those of the next one, and the window's reach on both sides
constexpr int kAlign = 16;  // floats in a cache line
constexpr int kMapStride = ((kLossTileCols + 2 * kRadius) * kChannels + kAlign - 1) / kAlign * kAlign;
constexpr int kMeanStride = ((kLossTileCols + 4 * kRadius) * kChannels + kAlign - 1) / kAlign * kAlign;

static_assert(kBand % kRegisterRows == 0, "a band is whole register blocks");
static_assert(kMeanStride * kBand * 4 + kMapStride * (kRing * 3 + 4) <= int(kLossScratch), "scratch");

SPLAT_INLINE int least(int a, int b) { return a < b ? a : b; }
SPLAT_INLINE int most(int a, int b) { return a > b ? a : b; }

// What pixel i of n receives from pixel i + k - 5 in the transposed blur, k = 0..10.
void transposed_taps(const float* taps, int i, int n, float* out) {
    for (int k = 0; k < kTaps; ++k) out[k] = transposed_tap(taps, i, i + k - kRadius, n);
}

// The window's weights, broadcast to all lanes: they stay in registers throughout a loop, whatever it stores.
struct Window {
    Floats at[kRadius + 1];
};

SPLAT_INLINE Window window_of(const float* taps) {
    Window window;
    for (int d = 0; d <= kRadius; ++d) window.at[d] = fill(taps[d]);
    return window;
}

struct Scratch {
    float* means[4];  // of u, u^2, v, v^2 down the columns: kBand rows of kMeanStride each
    float* maps[3];   // a, b_u, b_v: rings of kRing rows of kMapStride
    float* dissimilarity;
    float* counts;
    float* inside;
    float* zeros;
};

Scratch divide(float* memory) {
    Scratch s;
    for (float*& plane : s.means) plane = memory, memory += kBand * kMeanStride;
    for (float*& plane : s.maps) plane = memory, memory += kRing * kMapStride;
    s.dissimilarity = memory, memory += kMapStride;
    s.counts = memory, memory += kMapStride;
    s.inside = memory, memory += kMapStride;
    s.zeros = memory;
    for (int i = 0; i < kMapStride; ++i) s.zeros[i] = 0.0f;
    return s;
}

// Down the columns: windowed sums of s and s^2, s = x + sign y + shift, for kRegisterRows rows; n >= kLanes floats.
// rows_x, rows_y: the kRegisterRows + 10 rows that they reach.
SPLAT_INLINE void blur_columns_pair(const float* const* rows_x, const float* const* rows_y, const float* taps,
                                    float sign, float shift, int n, float* out, float* out_squares) {
    const Window window = window_of(taps);
    for (int at = 0; at < n; at += kLanes) {
        const int j = least(at, n - kLanes);
        Floats sum[kRegisterRows] = {}, squares[kRegisterRows] = {};
#pragma GCC unroll 18
        for (int i = 0; i < kRegisterRows + kTaps - 1; ++i) {
            const Floats s = fma(fill(sign), load(rows_y[i] + j), load(rows_x[i] + j)) + shift, s2 = s * s;
#pragma GCC unroll 8
            for (int r = 0; r < kRegisterRows; ++r) {
                const int k = i - r - kRadius, distance = k < 0 ? -k : k;
                if (distance > kRadius) continue;
                sum[r] = fma(window.at[distance], s, sum[r]);
                squares[r] = fma(window.at[distance], s2, squares[r]);
            }
        }
#pragma GCC unroll 8
        for (int r = 0; r < kRegisterRows; ++r) {
            store(out + r * kMeanStride + j, sum[r]);
            store(out_squares + r * kMeanStride + j, squares[r]);
        }
    }
}

// Down the columns: the transposed blur of kRegisterRows rows away from the image's border.
SPLAT_INLINE void blur_columns(const float* const* rows, const float* taps, int n, float* out) {
    const Window window = window_of(taps);
    for (int at = 0; at < n; at += kLanes) {
        const int j = least(at, n - kLanes);
        Floats sum[kRegisterRows] = {};
#pragma GCC unroll 18
        for (int i = 0; i < kRegisterRows + kTaps - 1; ++i) {
            const Floats s = load(rows[i] + j);
#pragma GCC unroll 8
            for (int r = 0; r < kRegisterRows; ++r) {
                const int k = i - r - kRadius, distance = k < 0 ? -k : k;
                if (distance > kRadius) continue;
                sum[r] = fma(window.at[distance], s, sum[r]);
            }
        }
#pragma GCC unroll 8
        for (int r = 0; r < kRegisterRows; ++r) store(out + r * kMeanStride + j, sum[r]);
    }
}

// Down the columns: one row with its own taps.
void blur_columns_row(const float* const* rows, const float* own_taps, int n, float* out) {
    for (int at = 0; at < n; at += kLanes) {
        const int j = least(at, n - kLanes);
        Floats sum = {};
        for (int k = 0; k < kTaps; ++k) sum = fma(fill(own_taps[k]), load(rows[k] + j), sum);
        store(out + j, sum);
    }
}

// Along the row: the windowed sum centred kRadius pixels after p.
SPLAT_INLINE Floats blur_along(const float* p, const Window& window) {
    Floats sum = window.at[0] * load(p + kRadius * kChannels);
#pragma GCC unroll 5
    for (int d = 1; d <= kRadius; ++d)
        sum = fma(window.at[d], load(p + (kRadius - d) * kChannels) + load(p + (kRadius + d) * kChannels), sum);
    return sum;
}

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

double sum_of(const float* p, int n) {
    Floats lanes = {};
    int j = 0;
    for (; j + kLanes <= n; j += kLanes) lanes += load(p + j);
    double sum = 0.0;
    for (int l = 0; l < kLanes; ++l) sum += lanes[l];
    for (; j < n; ++j) sum += p[j];
    return sum;
}

double sum_of_differences(const float* x, const float* y, int n) {
    Floats lanes = {};
    int j = 0;
    for (; j + kLanes <= n; j += kLanes) {
        const Floats difference = load(x + j) - load(y + j);
        lanes += max(difference, -difference);
    }
    double sum = 0.0;
    for (int l = 0; l < kLanes; ++l) sum += lanes[l];
    for (; j < n; ++j) sum += x[j] < y[j] ? y[j] - x[j] : x[j] - y[j];
    return sum;
}

// A tile's pixels, and those of the maps that its gradient needs: half a window more, within the image.
struct Span {
    LossTile own;
    int row0, row1, col0, col1;
};

// 1 - SSIM at each value of a row, and its derivatives with respect to the windowed means, from the column means.
SPLAT_INLINE void similarity_row(const float* const* means, const float* taps, const float* counts, int n,
                                 float* const* maps, float* out) {
    const Window window = window_of(taps);
    for (int at = 0; at < n; at += kLanes) {
        const int j = least(at, n - kLanes);
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

// Fill what lies beyond the image left and right of a row of means (from column col0 - 5 to col1 + 5) by reflection.
void reflect_row(float* row, const Span& span, int width) {
    const int first = span.col0 - kRadius;
    for (int side = 0; side < 2; ++side) {
        const int from = side ? width : first, to = side ? span.col1 + kRadius : 0;
        for (int col = from; col < to; ++col)
            for (int c = 0; c < kChannels; ++c)
                row[(col - first) * kChannels + c] = row[(reflected(col, width) - first) * kChannels + c];
    }
}

// The maps of rows [row, row + kBand), as many as the span has; returns the sums over the tile's own pixels.
double similarity_band(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const int first = most(0, span.col0 - kRadius), last = least(job.width, span.col1 + kRadius);
    const int lead = (first - (span.col0 - kRadius)) * kChannels, n = (last - first) * kChannels;
    for (int block = 0; block < kBand; block += kRegisterRows) {
        const float *x[kRegisterRows + kTaps - 1], *y[kRegisterRows + kTaps - 1];
        for (int i = 0; i < kRegisterRows + kTaps - 1; ++i) {
            const std::ptrdiff_t from = reflected(row + block + i - kRadius, job.height);
            const std::ptrdiff_t offset = (from * job.width + first) * kChannels;
            x[i] = job.render + offset, y[i] = job.photo + offset;
        }
        const int at = block * kMeanStride + lead;
        blur_columns_pair(x, y, job.taps, 1.0f, -1.0f, n, s.means[0] + at, s.means[1] + at);
        blur_columns_pair(x, y, job.taps, -1.0f, 0.0f, n, s.means[2] + at, s.means[3] + at);
    }
    double sum = 0.0;
    for (int r = row; r < least(row + kBand, span.row1); ++r) {
        float *means[4], *maps[3];
        for (int p = 0; p < 4; ++p) reflect_row(means[p] = s.means[p] + (r - row) * kMeanStride, span, job.width);
        for (int p = 0; p < 3; ++p) maps[p] = s.maps[p] + (r % kRing) * kMapStride;
        const int pixels = span.col1 - span.col0;
        const float* counts = nullptr;
        if (job.mask) counts = expand_mask(job.mask + std::ptrdiff_t(r) * job.width + span.col0, pixels, s.counts);
        counts = confine(inner_part(job.inner, r, span.col0, pixels), counts, pixels, s.counts);
        similarity_row(means, job.taps, counts, pixels * kChannels, maps, s.dissimilarity);
        if (r >= span.own.row0 && r < span.own.row1)
            sum += sum_of(s.dissimilarity + (span.own.col0 - span.col0) * kChannels,
                          (span.own.col1 - span.own.col0) * kChannels);
    }
    return sum;
}

// What multiplies the values of a row: 0 where a pixel is masked; of the absolute difference, where it is not inside.
struct Factors {
    const float *counts, *inside;  // null: 1
};

// The gradient of n values of a row. maps: a, b_u, b_v blurred down the columns, from 5 pixels before the first value.
SPLAT_INLINE void gradient_row(const LossJob& job, const float* const* maps, std::ptrdiff_t offset,
                               const Factors& factors, int n) {
    const Window window = window_of(job.taps);
    for (int at = 0; at < n; at += kLanes) {
        const int j = least(at, n - kLanes);
        const Floats x = load(job.render + offset + j), y = load(job.photo + offset + j);
        const Floats u = x + y - 1.0f, v = x - y;
        const Floats zero = fill(0.0f), one = fill(1.0f);
        Floats sign = only(less(zero, v), one) - only(less(v, zero), one);
        if (factors.inside) sign *= load(factors.inside + j);
        const Floats a = blur_along(maps[0] + j, window);
        const Floats b_u = blur_along(maps[1] + j, window), b_v = blur_along(maps[2] + j, window);
        Floats gradient = job.l1_scale * sign + job.ssim_scale * (a + 2.0f * (u * b_u + v * b_v));
        if (factors.counts) gradient *= load(factors.counts + j);
        store(job.gradient + offset + j, gradient);
    }
}

// The same for one pixel near the left or right border. maps: from the span's first column.
void gradient_pixel(const LossJob& job, const Span& span, float* const* maps, int row, int col) {
    float own_taps[kTaps];
    transposed_taps(job.taps, col, job.width, own_taps);
    const std::ptrdiff_t pixel = std::ptrdiff_t(row) * job.width + col;
    const Part part = inner_part(job.inner, row, col, 1);
    const float l1_scale = part.from < part.to ? job.l1_scale : 0.0f;
    for (int c = 0; c < kChannels; ++c) {
        float blurred[3] = {};
        for (int k = 0; k < kTaps; ++k) {
            const int from = col + k - kRadius;
            if (from < 0 || from >= job.width) continue;
            for (int p = 0; p < 3; ++p) blurred[p] += own_taps[k] * maps[p][(from - span.col0) * kChannels + c];
        }
        const float x = job.render[pixel * kChannels + c], y = job.photo[pixel * kChannels + c];
        const float u = x + y - 1.0f, v = x - y;
        const float sign = v > 0.0f ? 1.0f : (v < 0.0f ? -1.0f : 0.0f);
        const float similarity = blurred[0] + 2.0f * (u * blurred[1] + v * blurred[2]);
        const bool counting = !job.mask || job.mask[pixel];
        job.gradient[pixel * kChannels + c] = counting ? l1_scale * sign + job.ssim_scale * similarity : 0.0f;
    }
}

// The maps of rows [row, row + kBand) blurred down the columns, into the means' memory.
void blur_maps(const LossJob& job, const Span& span, const Scratch& s, int row) {
    const int n = (span.col1 - span.col0) * kChannels;
    const bool inside = row >= kBorder && row + kBand <= job.height - kBorder;
    for (int p = 0; p < 3; ++p) {
        const float* rows[kBand + kTaps - 1];
        for (int i = 0; i < kBand + kTaps - 1; ++i) {
            const int from = row + i - kRadius;
            rows[i] = from < 0 || from >= job.height ? s.zeros : s.maps[p] + (from % kRing) * kMapStride;
        }
        for (int r = 0; r < kBand; r += inside ? kRegisterRows : 1) {
            float own_taps[kTaps];
            if (inside) {
                blur_columns(rows + r, job.taps, n, s.means[p] + r * kMeanStride);
            } else if (row + r < job.height) {
                transposed_taps(job.taps, row + r, job.height, own_taps);
                blur_columns_row(rows + r, own_taps, n, s.means[p] + r * kMeanStride);
            }
        }
    }
}

// The gradient of rows [row, row + kBand), as many as the tile has; returns their sum of absolute differences.
double gradient_band(const LossJob& job, const Span& span, const Scratch& s, int row) {
    blur_maps(job, span, s, row);
    const LossTile& own = span.own;
    int from = own.col0 == 0 ? kBorder : own.col0, to = own.col1 == job.width ? job.width - kBorder : own.col1;
    if ((to - from) * kChannels < kLanes) from = to = own.col1;  // too narrow for a vector
    double sum = 0.0;
    for (int r = row; r < least(row + kBand, own.row1); ++r) {
        float* maps[3];
        for (int p = 0; p < 3; ++p) maps[p] = s.means[p] + (r - row) * kMeanStride;
        const std::ptrdiff_t start = std::ptrdiff_t(r) * job.width;
        if (to > from) {
            const float* ahead[3];
            for (int p = 0; p < 3; ++p) ahead[p] = maps[p] + (from - kRadius - span.col0) * kChannels;
            Factors factors{};
            if (job.mask) factors.counts = expand_mask(job.mask + start + from, to - from, s.counts);
            factors.inside = confine(inner_part(job.inner, r, from, to - from), nullptr, to - from, s.inside);
            gradient_row(job, ahead, (start + from) * kChannels, factors, (to - from) * kChannels);
        }
        for (int col = own.col0; col < from; ++col) gradient_pixel(job, span, maps, r, col);
        for (int col = to; col < own.col1; ++col) gradient_pixel(job, span, maps, r, col);
        const Part part = inner_part(job.inner, r, own.col0, own.col1 - own.col0);
        const std::ptrdiff_t first = (start + own.col0 + part.from) * kChannels;
        sum += sum_of_differences(job.render + first, job.photo + first, (part.to - part.from) * kChannels);
    }
    return sum;
}

LossSums loss_tile(const LossJob& job, const LossTile& own, float* memory) {
    const Scratch scratch = divide(memory);
    const Span span{own, most(0, own.row0 - kRadius), least(job.height, own.row1 + kRadius),
                    most(0, own.col0 - kRadius), least(job.width, own.col1 + kRadius)};
    LossSums sums{0.0, 0.0};
    int done = own.row0;
    for (int row = span.row0; row < span.row1; row += kBand) {
        sums.dissimilarity += similarity_band(job, span, scratch, row);
        const int known = least(row + kBand, span.row1);
        while (done < own.row1 && (done + kBand + kRadius <= known || known == span.row1)) {
            sums.l1 += gradient_band(job, span, scratch, done);
            done += kBand;
        }
    }
    return sums;
}

}  // namespace

extern const LossKernels loss_kernels = {loss_tile};

}  // namespace splat::SPLAT_ISA_NAMESPACE
