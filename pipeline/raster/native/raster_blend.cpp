// Blending a tile, forward and backward, with SIMD over its pixels. Compiled once per ISA (see isa.h for what that
// forbids).
//
// A tile's pixels are kept in blocks of kLanes: 8 x 2 pixels with 16 lanes, 8 x 1 with 8, 4 x 1 with 4. Pair by pair,
// the blocks that the splat touches are found from the chord of its ellipse in every row, and only they are worked on.
#include "raster.h"
#include "simd.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kBlockWidth = kLanes >= 8 ? 8 : 4;
constexpr int kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockRows = kTile / kBlockHeight;  // rows of blocks
constexpr int kBlockColumns = kTile / kBlockWidth;
constexpr int kBlocks = kBlockRows * kBlockColumns;  // block = column * kBlockRows + row; at most 64
using BlockMask = uint64_t;
constexpr BlockMask kAllBlocks = kBlocks == 64 ? ~BlockMask{0} : (BlockMask{1} << kBlocks) - 1;

// Where pixel p of a tile, counted block by block, lies in it.
constexpr int column_of(int p) { return p / kLanes / kBlockRows * kBlockWidth + p % kBlockWidth; }
constexpr int row_of(int p) { return p / kLanes % kBlockRows * kBlockHeight + p % kLanes / kBlockWidth; }

struct Offsets {
    alignas(64) float x[kTilePixels], y[kTilePixels];  // of pixel centres from the tile's first
    alignas(
        64) float rows[kTile];  // rows as the block mask wants them: of each block row the first, then the second ones
};

constexpr Offsets make_offsets() {
    Offsets o{};
    for (int p = 0; p < kTilePixels; ++p) o.x[p] = column_of(p), o.y[p] = row_of(p);
    for (int i = 0; i < kTile; ++i) o.rows[i] = i % kBlockRows * kBlockHeight + i / kBlockRows;
    return o;
}

constexpr Offsets kOffsets = make_offsets();

struct TilePlace {
    int index, left, top, width, height;  // pixels; width and height as far as they lie in the picture
};

SPLAT_INLINE TilePlace place_of(const View& view, int tile) {
    const int left = tile % view.tiles_x * kTile, top = tile / view.tiles_x * kTile;
    const int width = view.width - left, height = view.height - top;
    return {tile, left, top, width < kTile ? width : kTile, height < kTile ? height : kTile};
}

// A splat as a tile sees it, a vector a field.
struct TileSplat {
    Floats a, b, c, u0, v0, log2_opacity;

    SPLAT_METHOD TileSplat(const Splat& s, const TilePlace& at) {
        const float dx = at.left + 0.5f - s.x, dy = at.top + 0.5f - s.y;
        a = fill(s.a), b = fill(s.b), c = fill(s.c);
        u0 = fill(s.a * dx + s.b * dy), v0 = fill(s.c * dy), log2_opacity = fill(s.log2_opacity);
    }
    SPLAT_METHOD void offset(int block, Floats* u, Floats* v) const {
        const Floats dy = load(kOffsets.y + block * kLanes);
        *u = fma(a, load(kOffsets.x + block * kLanes), fma(b, dy, u0));
        *v = fma(c, dy, v0);
    }
    SPLAT_METHOD Floats log2_alpha(Floats u, Floats v) const { return fnma(u, u, fnma(v, v, log2_opacity)); }
};

// Blocks with a pixel centre inside the ellipse.
SPLAT_INLINE BlockMask touched_blocks(const Splat& s, const TilePlace& at) {
    const Floats dy0 = fill(at.top + 0.5f - s.y), x0 = fill(s.x - at.left - 0.5f), slope = fill(s.slope), c = fill(s.c);
    const Floats inv_a = fill(s.inv_a), reach = fill(s.reach), zero = fill(0.0f);
    uint64_t rows_in[kBlockColumns] = {};
    for (int i = 0; i < kTile; i += kLanes) {
        const Floats dy = load(kOffsets.rows + i) + dy0, v = c * dy, rest = fnma(v, v, reach);
        const Floats half = inv_a * sqrt(max(rest, zero)), middle = fma(slope, dy, x0);
        const Floats first = ceil(middle - half), last = floor(middle + half);  // columns
        const Mask crossed = both(at_most(zero, rest), at_most(first, last));
        for (int j = 0; j < kBlockColumns; ++j) {
            const Mask in = both(at_most(first, fill(j * kBlockWidth + kBlockWidth - 1.0f)),
                                 at_most(fill(static_cast<float>(j * kBlockWidth)), last));
            rows_in[j] |= static_cast<uint64_t>(bits(both(crossed, in))) << i;
        }
    }
    BlockMask mask = 0;
    for (int j = 0; j < kBlockColumns; ++j) {
        uint64_t rows = rows_in[j];
        if (kBlockHeight == 2) rows = (rows | rows >> kBlockRows) & ((1u << kBlockRows) - 1);
        mask |= rows << (j * kBlockRows);
    }
    return mask;
}

// A tile's pixels on their way from front to back. The transmittance of a pixel that has ended is kept as its negative.
struct Canvas {
    alignas(64) float transmittance[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
    alignas(64) float depth[kTilePixels], median[kTilePixels];
    int32_t* end;
    BlockMask alive;
};

SPLAT_INLINE bool inside(const TilePlace& at, int p) { return column_of(p) < at.width && row_of(p) < at.height; }

void start(const TilePlace& at, int pairs, Canvas* canvas) {
    const Floats zero = fill(0.0f);
    for (int p = 0; p < kTilePixels; p += kLanes) {
        store(canvas->red + p, zero), store(canvas->green + p, zero), store(canvas->blue + p, zero);
        store(canvas->depth + p, zero), store(canvas->median + p, zero);
        store(canvas->transmittance + p, fill(1.0f));
        for (int lane = 0; lane < kLanes; ++lane) canvas->end[p + lane] = pairs;
    }
    canvas->alive = kAllBlocks;
    if (at.width == kTile && at.height == kTile) return;
    canvas->alive = 0;
    for (int p = 0; p < kTilePixels; ++p) {
        if (inside(at, p))
            canvas->alive |= BlockMask{1} << (p / kLanes);
        else
            canvas->transmittance[p] = -1.0f, canvas->end[p] = 0;
    }
}

// Pixels of a block that end at this pair. Rare.
__attribute__((noinline)) void end_pixels(Canvas* canvas, int block, uint32_t which, int32_t pair) {
    bool alive = false;
    for (int lane = 0; lane < kLanes; ++lane) {
        float& left = canvas->transmittance[block * kLanes + lane];
        if (which >> lane & 1) canvas->end[block * kLanes + lane] = pair, left = -left;
        alive |= left > 0.0f;
    }
    if (!alive) canvas->alive &= ~(BlockMask{1} << block);
}

SPLAT_INLINE void add_to(float* sum, Floats weight, Floats value) { store(sum, fma(weight, value, load(sum))); }

template <bool kDepth>
SPLAT_INLINE void blend_block(const TileSplat& splat, const Splat& s, int block, int32_t pair, Canvas* canvas) {
    Floats u, v;
    splat.offset(block, &u, &v);
    const Floats log2_alpha = splat.log2_alpha(u, v), zero = fill(0.0f);
    const int at = block * kLanes;
    const Floats before = load(canvas->transmittance + at);
    const Mask met = both(at_most(fill(kLog2AlphaMin), log2_alpha), less(zero, before));
    const Floats alpha = min(exp2(log2_alpha), fill(kAlphaMax)), weighted = alpha * before, after = before - weighted;
    const Mask blended = both(met, at_most(fill(kTransmittanceMin), after));
    const Floats weight = only(blended, weighted);
    add_to(canvas->red + at, weight, fill(s.colour[0]));
    add_to(canvas->green + at, weight, fill(s.colour[1]));
    add_to(canvas->blue + at, weight, fill(s.colour[2]));
    store(canvas->transmittance + at, select(blended, after, before));
    if (kDepth) {
        const Floats depth = fill(s.depth), half = fill(kMedianTransmittance);
        add_to(canvas->depth + at, weight, depth);
        const Mask passes = both(blended, both(less(half, before), at_most(after, half)));
        if (any(passes)) store(canvas->median + at, select(passes, depth, load(canvas->median + at)));
    }
    const Mask ended = without(met, blended);
    if (__builtin_expect(any(ended), 0)) end_pixels(canvas, block, bits(ended), pair);
}

// Pixels column..column+kLanes-1 of a row of a plane of blocks.
SPLAT_INLINE const float* segment(const float* plane, int row, int column) {
    const int block = column / kBlockWidth * kBlockRows + row / kBlockHeight;
    return plane + block * kLanes + row % kBlockHeight * kBlockWidth;
}

SPLAT_INLINE Floats get_pixels(const float* plane, int row, [[maybe_unused]] int column) {
#if SPLAT_ISA_AVX512
    return load_halves(segment(plane, row, 0), segment(plane, row, kBlockWidth));
#else
    return load(segment(plane, row, column));
#endif
}

SPLAT_INLINE void put_pixels(float* plane, int row, [[maybe_unused]] int column, Floats v) {
#if SPLAT_ISA_AVX512
    store_halves(const_cast<float*>(segment(plane, row, 0)), const_cast<float*>(segment(plane, row, kBlockWidth)), v);
#else
    store(const_cast<float*>(segment(plane, row, column)), v);
#endif
}

// A tile's rows of the pictures, 16 pixels each.
struct Row {
    float *colour, *alpha, *depth_sum, *median_depth;
};

SPLAT_INLINE void put_row(const View& view, const Canvas& canvas, int row, const Row& out) {
    for (int x = 0; x < kTile; x += kLanes) {
        const Floats left = get_pixels(canvas.transmittance, row, x);  // by now without its sign
        store_rgb(out.colour + 3 * x, fma(left, fill(view.background[0]), get_pixels(canvas.red, row, x)),
                  fma(left, fill(view.background[1]), get_pixels(canvas.green, row, x)),
                  fma(left, fill(view.background[2]), get_pixels(canvas.blue, row, x)));
        store(out.alpha + x, fill(1.0f) - left);
        if (!out.depth_sum) continue;
        store(out.depth_sum + x, get_pixels(canvas.depth, row, x));
        store(out.median_depth + x, get_pixels(canvas.median, row, x));
    }
}

SPLAT_INLINE void copy(float* to, const float* from, int floats) {
    __builtin_memcpy(to, from, static_cast<size_t>(floats) * sizeof(float));
}

void put_pictures(const View& view, const TilePlace& at, const Canvas& canvas, const Pictures& out) {
    const bool depth = out.depth_sum;
    for (int row = 0; row < at.height; ++row) {
        const int64_t pixel = static_cast<int64_t>(at.top + row) * view.width + at.left;
        const Row to = {out.colour + 3 * pixel, out.alpha + pixel, depth ? out.depth_sum + pixel : nullptr,
                        depth ? out.median_depth + pixel : nullptr};
        if (at.width == kTile) {
            put_row(view, canvas, row, to);
            continue;
        }
        float colour[3 * kTile], alpha[kTile], depth_sum[kTile], median_depth[kTile];
        put_row(view, canvas, row, {colour, alpha, depth ? depth_sum : nullptr, median_depth});
        copy(to.colour, colour, 3 * at.width), copy(to.alpha, alpha, at.width);
        if (depth) copy(to.depth_sum, depth_sum, at.width), copy(to.median_depth, median_depth, at.width);
    }
}

constexpr int kAhead = 4;  // pairs whose splat is fetched in advance

template <bool kDepth>
SPLAT_INLINE void walk(const FrameData& frame, const TilePlace& at, int32_t pairs, Canvas* canvas) {
    const int32_t* list = frame.pair_splat + frame.tile_begin[at.index];
    for (int32_t pair = 0; pair < pairs && canvas->alive; ++pair) {
        if (pair + kAhead < pairs) __builtin_prefetch(frame.splats + list[pair + kAhead]);
        const Splat& s = frame.splats[list[pair]];
        BlockMask blocks = touched_blocks(s, at) & canvas->alive;
        const TileSplat splat(s, at);
        for (; blocks; blocks &= blocks - 1) blend_block<kDepth>(splat, s, __builtin_ctzll(blocks), pair, canvas);
    }
}

void blend_tile(const View& view, const FrameData& frame, int tile, const Pictures& out) {
    const TilePlace at = place_of(view, tile);
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
    Canvas canvas;
    canvas.end = frame.pixel_end + static_cast<int64_t>(tile) * kTilePixels;
    start(at, pairs, &canvas);
    if (out.depth_sum)
        walk<true>(frame, at, pairs, &canvas);
    else
        walk<false>(frame, at, pairs, &canvas);
    float* left = frame.transmittance + static_cast<int64_t>(tile) * kTilePixels;
    for (int p = 0; p < kTilePixels; ++p) left[p] = canvas.transmittance[p] = __builtin_fabsf(canvas.transmittance[p]);
    put_pictures(view, at, canvas, out);
}

// A tile's pixels on their way back.
struct BackCanvas {
    alignas(64) float transmittance[kTilePixels];  // behind the pair
    // Σ w (c . dL/dC + z dL/dD) of the pairs behind, less T dL/dT of what is left behind all of them.
    alignas(64) float behind[kTilePixels];
    alignas(64) float red[kTilePixels], green[kTilePixels], blue[kTilePixels], depth[kTilePixels];  // dL/d(pictures)
    const int32_t* end;
    int32_t block_end[kBlocks];  // the largest of the block
};

SPLAT_INLINE void get_row(const View& view, const PictureGradients& in, int64_t pixel, int row, BackCanvas* canvas) {
    for (int x = 0; x < kTile; x += kLanes) {
        const Floats zero = fill(0.0f);
        Floats red = zero, green = zero, blue = zero;
        if (in.colour) load_rgb(in.colour + 3 * (pixel + x), &red, &green, &blue);
        const Floats alpha = in.alpha ? load(in.alpha + pixel + x) : zero;
        put_pixels(canvas->red, row, x, red);
        put_pixels(canvas->green, row, x, green);
        put_pixels(canvas->blue, row, x, blue);
        put_pixels(canvas->depth, row, x, in.depth_sum ? load(in.depth_sum + pixel + x) : zero);
        const Floats background =
            red * fill(view.background[0]) + green * fill(view.background[1]) + blue * fill(view.background[2]);
        put_pixels(canvas->behind, row, x, background - alpha);
    }
}

void get_gradients(const View& view, const TilePlace& at, const PictureGradients& in, BackCanvas* canvas) {
    for (int row = 0; row < kTile; ++row) {
        const int64_t pixel = static_cast<int64_t>(at.top + row) * view.width + at.left;
        if (at.width == kTile && row < at.height) {
            get_row(view, in, pixel, row, canvas);
            continue;
        }
        float colour[3 * kTile] = {}, alpha[kTile] = {}, depth_sum[kTile] = {};
        if (row < at.height) {
            if (in.colour) copy(colour, in.colour + 3 * pixel, 3 * at.width);
            if (in.alpha) copy(alpha, in.alpha + pixel, at.width);
            if (in.depth_sum) copy(depth_sum, in.depth_sum + pixel, at.width);
        }
        get_row(view, {colour, alpha, depth_sum}, 0, row, canvas);
    }
}

// Returns the largest number of pairs that a pixel looked at.
int32_t start_back(const View& view, const FrameData& frame, const TilePlace& at, const PictureGradients& in,
                   BackCanvas* canvas) {
    const float* left = frame.transmittance + static_cast<int64_t>(at.index) * kTilePixels;
    canvas->end = frame.pixel_end + static_cast<int64_t>(at.index) * kTilePixels;
    get_gradients(view, at, in, canvas);
    int32_t last = 0;
    for (int b = 0; b < kBlocks; ++b) {
        const int p = b * kLanes;
        store(canvas->transmittance + p, load(left + p));
        store(canvas->behind + p, load(canvas->behind + p) * load(left + p));
        int32_t end = 0;
        for (int lane = 0; lane < kLanes; ++lane) end = end > canvas->end[p + lane] ? end : canvas->end[p + lane];
        canvas->block_end[b] = end;
        last = last > end ? last : end;
    }
    return last;
}

// A pair's gradients, a lane a share.
struct Moments {
    Floats s, su, sv, suu, suv, svv, red, green, blue, depth;
};

template <bool kDepth>
SPLAT_INLINE void blend_block_backward(const TileSplat& splat, const Splat& s, int block, int32_t pair,
                                       BackCanvas* canvas, Moments* m) {
    Floats u, v;
    splat.offset(block, &u, &v);
    const Floats log2_alpha = splat.log2_alpha(u, v), one = fill(1.0f);
    const int at = block * kLanes;
    const Mask met = both(at_most(fill(kLog2AlphaMin), log2_alpha), below(pair, canvas->end + at));
    const Floats alpha = only(met, min(exp2(log2_alpha), fill(kAlphaMax)));  // with 0, nothing below changes anything
    const Floats inv_rest = inverse(one - alpha);
    const Floats before = load(canvas->transmittance + at) * inv_rest, weight = alpha * before;
    const Floats red = load(canvas->red + at), green = load(canvas->green + at), blue = load(canvas->blue + at);
    Floats value = fma(fill(s.colour[0]), red, fma(fill(s.colour[1]), green, fill(s.colour[2]) * blue));
    m->red = fma(weight, red, m->red), m->green = fma(weight, green, m->green), m->blue = fma(weight, blue, m->blue);
    if (kDepth) {
        const Floats depth = load(canvas->depth + at);
        value = fma(fill(s.depth), depth, value), m->depth = fma(weight, depth, m->depth);
    }
    const Floats behind = load(canvas->behind + at);
    const Floats dalpha = fnma(behind, inv_rest, before * value);
    store(canvas->transmittance + at, before);
    store(canvas->behind + at, fma(weight, value, behind));
    const Floats g = only(at_most(log2_alpha, fill(kLog2AlphaMax)), alpha * dalpha);  // no gradient where clamped
    const Floats gu = g * u, gv = g * v;
    m->s = m->s + g, m->su = m->su + gu, m->sv = m->sv + gv;
    m->suu = fma(gu, u, m->suu), m->suv = fma(gu, v, m->suv), m->svv = fma(gv, v, m->svv);
}

SPLAT_INLINE void put_slot(const Moments& m, float* slot) {
    const Floats zero = fill(0.0f);
    sum_lanes(m.s, m.su, m.sv, m.suu, slot);
    sum_lanes(m.suv, m.svv, m.red, m.green, slot + 4);
    sum_lanes(m.blue, m.depth, zero, zero, slot + 8);
}

template <bool kDepth>
SPLAT_INLINE void walk_back(const FrameData& frame, const TilePlace& at, int32_t last, BackCanvas* canvas) {
    const int64_t first = frame.tile_begin[at.index];
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[at.index + 1] - first);
    const int32_t *list = frame.pair_splat + first, *slots = frame.pair_slot + first;
    for (int32_t pair = last; pair < pairs; ++pair)
        for (int f = 0; f < kSlotFloats; ++f) frame.slots[int64_t{slots[pair]} * kSlotFloats + f] = 0.0f;
    BlockMask reached = 0;  // blocks with a pixel that had not ended by this pair
    for (int32_t pair = last - 1; pair >= 0; --pair) {
        if (pair >= kAhead) {
            __builtin_prefetch(frame.splats + list[pair - kAhead]);
            __builtin_prefetch(frame.slots + int64_t{slots[pair - kAhead]} * kSlotFloats, 1);
        }
        if (reached != kAllBlocks)
            for (int b = 0; b < kBlocks; ++b) reached |= BlockMask{canvas->block_end[b] > pair} << b;
        const Splat& s = frame.splats[list[pair]];
        BlockMask blocks = touched_blocks(s, at) & reached;
        const TileSplat splat(s, at);
        const Floats zero = fill(0.0f);
        Moments m = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
        for (; blocks; blocks &= blocks - 1)
            blend_block_backward<kDepth>(splat, s, __builtin_ctzll(blocks), pair, canvas, &m);
        put_slot(m, frame.slots + int64_t{slots[pair]} * kSlotFloats);
    }
}

void blend_tile_backward(const View& view, const FrameData& frame, int tile, const PictureGradients& in) {
    const TilePlace at = place_of(view, tile);
    BackCanvas canvas;
    const int32_t last = start_back(view, frame, at, in, &canvas);
    if (in.depth_sum)
        walk_back<true>(frame, at, last, &canvas);
    else
        walk_back<false>(frame, at, last, &canvas);
}

}  // namespace

extern const BlendKernels blend_kernels = {blend_tile, blend_tile_backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
