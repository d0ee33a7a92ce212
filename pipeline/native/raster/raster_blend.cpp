// Blending a tile, forward and backward, with SIMD over its pixels. Compiled once per ISA (see isa.h for what that
// forbids).
//
// A tile's pixels are kept in blocks of kLanes: 4 x 4 pixels with 16 lanes, 4 x 2 with 8, 4 x 1 with 4. Pair by pair,
// the blocks that the splat touches are found from the chord of its ellipse in every row, and only these are processed.
#include "base/simd.h"
#include "raster/raster.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kBlockWidth = 4;
constexpr int kBlockHeight = kLanes / kBlockWidth;
constexpr int kBlockRows = kTile / kBlockHeight;  // rows of blocks
constexpr int kBlockColumns = kTile / kBlockWidth;
constexpr int kBlocks = kBlockRows * kBlockColumns;  // block = column * kBlockRows + row; at most 64
using BlockMask = uint64_t;
constexpr BlockMask kAllBlocks = kBlocks == 64 ? ~BlockMask{0} : (BlockMask{1} << kBlocks) - 1;
constexpr int kMaskBytes = kBlocks / 8;  // of a BlockMask in memory

// Where pixel p of a tile, counted block by block, lies in it.
constexpr int column_of(int p) { return p / kLanes / kBlockRows * kBlockWidth + p % kBlockWidth; }
constexpr int row_of(int p) { return p / kLanes % kBlockRows * kBlockHeight + p % kLanes / kBlockWidth; }

// Offsets of pixel centres from the tile's first: a pixel's is that of its lane in block 0 and that of its block.
struct Offsets {
    alignas(64) float lane_x[kLanes], lane_y[kLanes], block_x[kBlocks], block_y[kBlocks];
    // Rows in the order of touched_blocks: the first row of each block row, then the second ones, and so on.
    alignas(64) float rows[kTile];
};

constexpr Offsets make_offsets() {
    Offsets o{};
    for (int p = 0; p < kLanes; ++p) o.lane_x[p] = column_of(p), o.lane_y[p] = row_of(p);
    for (int b = 0; b < kBlocks; ++b) o.block_x[b] = column_of(b * kLanes), o.block_y[b] = row_of(b * kLanes);
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

// A splat as seen by a tile. (u, v) of a pixel is a sum, because most of a CPU's multipliers are needed elsewhere.
struct TileSplat {
    Floats b, c, u, v, log2_opacity;  // u, v: of the lanes in block 0
    alignas(64) float block_u[kBlocks], block_v[kBlocks];

    SPLAT_METHOD TileSplat(const Splat& s, const TilePlace& at) {
        const float dx = at.left + 0.5f - s.x, dy = at.top + 0.5f - s.y;
        const Floats a = fill(s.a);
        b = fill(s.b), c = fill(s.c), log2_opacity = fill(s.log2_opacity);
        u = fma(a, load(kOffsets.lane_x), fma(b, load(kOffsets.lane_y), fill(s.a * dx + s.b * dy)));
        v = fma(c, load(kOffsets.lane_y), fill(s.c * dy));
        for (int i = 0; i < kBlocks; i += kLanes) {
            const Floats y = load(kOffsets.block_y + i);
            store(block_u + i, fma(a, load(kOffsets.block_x + i), b * y));
            store(block_v + i, c * y);
        }
    }
    SPLAT_METHOD Floats u_of(int block) const { return u + fill(block_u[block]); }
    SPLAT_METHOD Floats v_of(int block) const { return v + fill(block_v[block]); }
    SPLAT_METHOD Floats log2_alpha(int block) const {
        const Floats u = u_of(block), v = v_of(block);
        return fnma(u, u, fnma(v, v, log2_opacity));
    }
    // Depths at which the pixels' rays peak in the Gaussian.
    SPLAT_METHOD Floats depth(const Splat& s, int block) const {
        return fma(fill(s.depth_u), u_of(block), fma(fill(s.depth_v), v_of(block), fill(s.depth)));
    }
};

// The chords of a splat's ellipse in the rows of a tile: columns first..last, where `crossed`.
struct Chords {
    Floats first, last;  // not rounded
    Mask crossed;
};

SPLAT_INLINE Chords chords(const Splat& s, const TilePlace& at, int row) {
    const Floats dy0 = fill(at.top + 0.5f - s.y), x0 = fill(s.x - at.left - 0.5f), zero = fill(0.0f);
    const Floats dy = load(kOffsets.rows + row) + dy0, v = fill(s.c) * dy, rest = fnma(v, v, fill(s.reach));
    const Floats half = fill(s.inv_a) * sqrt(max(rest, zero)), middle = fma(fill(s.slope), dy, x0);
    return {middle - half, middle + half, at_most(zero, rest)};
}

// Blocks with a pixel centre inside the ellipse.
#if SPLAT_ISA_AVX512
SPLAT_INLINE BlockMask touched_blocks(const Splat& s, const TilePlace& at) {
    const Chords rows = chords(s, at, 0);
    const __m512i first = ceil_to_ints(max(rows.first, fill(0.0f))), last = floor_to_ints(min(rows.last, fill(15.0f)));
    const __m512i all = _mm512_set1_epi32(0xffff), beyond = _mm512_sub_epi32(_mm512_set1_epi32(kTile - 1), last);
    // A row's columns as bits; then the rows of a block together, which lie in the vector's quarters.
    __m512i columns =
        _mm512_maskz_and_epi32(rows.crossed, _mm512_sllv_epi32(all, first), _mm512_srlv_epi32(all, beyond));
    columns = _mm512_or_epi32(columns, _mm512_shuffle_i32x4(columns, columns, 0x4e));
    columns = _mm512_or_epi32(columns, _mm512_shuffle_i32x4(columns, columns, 0xb1));
    const __m512i of_block = _mm512_sllv_epi32(_mm512_set1_epi32(0xf),
                                               _mm512_setr_epi32(0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12));
    return _mm512_test_epi32_mask(columns, of_block);
}
#else
SPLAT_INLINE BlockMask touched_blocks(const Splat& s, const TilePlace& at) {
    uint64_t rows_in[kBlockColumns] = {};
    for (int i = 0; i < kTile; i += kLanes) {
        const Chords rows = chords(s, at, i);
        const Floats first = ceil(rows.first), last = floor(rows.last);
        const Mask crossed = both(rows.crossed, at_most(first, last));
        for (int j = 0; j < kBlockColumns; ++j) {
            const Mask in = both(at_most(first, fill(j * kBlockWidth + kBlockWidth - 1.0f)),
                                 at_most(fill(static_cast<float>(j * kBlockWidth)), last));
            rows_in[j] |= static_cast<uint64_t>(bits(both(crossed, in))) << i;
        }
    }
    BlockMask mask = 0;
    for (int j = 0; j < kBlockColumns; ++j) {
        uint64_t rows = rows_in[j];
        for (int half = kTile / 2; half >= kBlockRows; half /= 2) rows |= rows >> half;
        mask |= (rows & ((1u << kBlockRows) - 1)) << (j * kBlockRows);
    }
    return mask;
}
#endif

// A tile's pixels on their way from front to back. The transmittance of a pixel that has ended is kept as its negative.
struct Canvas {
    alignas(64) float transmittance[kTilePixels], red[kTilePixels], green[kTilePixels], blue[kTilePixels];
    alignas(64) float depth[kTilePixels], depth_square[kTilePixels], median[kTilePixels];
    float depth_origin;
    int32_t* end;
    BlockMask alive;
};

SPLAT_INLINE bool inside(const TilePlace& at, int p) { return column_of(p) < at.width && row_of(p) < at.height; }

void start(const TilePlace& at, int pairs, Canvas* canvas) {
    const Floats zero = fill(0.0f);
    for (int p = 0; p < kTilePixels; p += kLanes) {
        store(canvas->red + p, zero), store(canvas->green + p, zero), store(canvas->blue + p, zero);
        store(canvas->depth + p, zero), store(canvas->depth_square + p, zero), store(canvas->median + p, zero);
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

// Takes the next kCount blocks out of a mask. Work on several of them is interleaved step by step: one block is a chain
// of about 25 dependent operations, and a CPU's scheduler holds too few to overlap it with the next block by itself.
template <int kCount>
SPLAT_INLINE void take_blocks(BlockMask* blocks, int (&block)[kCount]) {
    for (int& b : block) b = __builtin_ctzll(*blocks), *blocks &= *blocks - 1;
}

template <bool kDepth, int kCount>
SPLAT_INLINE void blend_blocks(const TileSplat& splat, const Splat& s, BlockMask* blocks, int32_t pair,
                               Canvas* canvas) {
    int block[kCount];
    take_blocks(blocks, block);
    Floats alpha[kCount], before[kCount], after[kCount], weight[kCount];
    Mask met[kCount], blended[kCount];
    for (int k = 0; k < kCount; ++k) alpha[k] = splat.log2_alpha(block[k]);
    for (int k = 0; k < kCount; ++k) before[k] = load(canvas->transmittance + block[k] * kLanes);
    for (int k = 0; k < kCount; ++k) met[k] = both(at_most(fill(kLog2AlphaMin), alpha[k]), less(fill(0.0f), before[k]));
    exp2_each(alpha);
    for (int k = 0; k < kCount; ++k) weight[k] = min(alpha[k], fill(kAlphaMax)) * before[k];
    for (int k = 0; k < kCount; ++k) after[k] = before[k] - weight[k];
    for (int k = 0; k < kCount; ++k) blended[k] = both(met[k], at_most(fill(kTransmittanceMin), after[k]));
    for (int k = 0; k < kCount; ++k) weight[k] = only(blended[k], weight[k]);
    for (int k = 0; k < kCount; ++k) {
        const int at = block[k] * kLanes;
        add_to(canvas->red + at, weight[k], fill(s.colour[0]));
        add_to(canvas->green + at, weight[k], fill(s.colour[1]));
        add_to(canvas->blue + at, weight[k], fill(s.colour[2]));
        store(canvas->transmittance + at, select(blended[k], after[k], before[k]));
        if (kDepth) {
            const Floats depth = splat.depth(s, block[k]), from_origin = depth - fill(canvas->depth_origin);
            add_to(canvas->depth + at, weight[k], depth);
            add_to(canvas->depth_square + at, weight[k], from_origin * from_origin);
            const Floats half = fill(kMedianTransmittance);
            const Mask passes = both(blended[k], both(less(half, before[k]), at_most(after[k], half)));
            if (any(passes)) {  // a Gaussian so long that its depth is far from its centre's is not a surface
                const Floats least = fill((1.0f - kMedianShiftMax) * s.depth),
                             most = fill((1.0f + kMedianShiftMax) * s.depth);
                store(canvas->median + at, select(passes, min(max(depth, least), most), load(canvas->median + at)));
            }
        }
        const Mask ended = without(met[k], blended[k]);
        if (__builtin_expect(any(ended), 0)) end_pixels(canvas, block[k], bits(ended), pair);
    }
}

// Pixels column..column+kLanes-1 of a row of a plane of blocks: pieces of kBlockWidth, a column of blocks apart.
constexpr int kPieceStep = kBlockRows * kLanes;

constexpr int piece(int row, int column) {
    return column / kBlockWidth * kPieceStep + row / kBlockHeight * kLanes + row % kBlockHeight * kBlockWidth;
}

SPLAT_INLINE Floats get_pixels(const float* plane, int row, int column) {
    return load_pieces(plane + piece(row, column), kPieceStep);
}

SPLAT_INLINE void put_pixels(float* plane, int row, int column, Floats v) {
    store_pieces(plane + piece(row, column), kPieceStep, v);
}

// A tile's rows of the pictures, 16 pixels each.
struct Row {
    float *colour, *alpha, *depth_sum, *depth_square_sum, *median_depth;
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
        store(out.depth_square_sum + x, get_pixels(canvas.depth_square, row, x));
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
                        depth ? out.depth_square_sum + pixel : nullptr, depth ? out.median_depth + pixel : nullptr};
        if (at.width == kTile) {
            put_row(view, canvas, row, to);
            continue;
        }
        float colour[3 * kTile], alpha[kTile], depth_sum[kTile], depth_square_sum[kTile], median_depth[kTile];
        put_row(view, canvas, row, {colour, alpha, depth ? depth_sum : nullptr, depth_square_sum, median_depth});
        copy(to.colour, colour, 3 * at.width), copy(to.alpha, alpha, at.width);
        if (!depth) continue;
        copy(to.depth_sum, depth_sum, at.width), copy(to.depth_square_sum, depth_square_sum, at.width);
        copy(to.median_depth, median_depth, at.width);
    }
}

constexpr int kAhead = 4;  // pairs whose splat is fetched in advance

// Masks of blocks as the backward pass reads them, little-endian.
SPLAT_INLINE void put_mask(uint8_t* masks, int64_t pair, BlockMask blocks) {
    __builtin_memcpy(masks + pair * kMaskBytes, &blocks, kMaskBytes);
}
SPLAT_INLINE BlockMask get_mask(const uint8_t* masks, int64_t pair) {
    BlockMask blocks = 0;
    __builtin_memcpy(&blocks, masks + pair * kMaskBytes, kMaskBytes);
    return blocks;
}

template <bool kDepth>
SPLAT_INLINE void walk(const FrameData& frame, const TilePlace& at, int32_t pairs, Canvas* canvas) {
    const int64_t first = frame.tile_begin[at.index];
    const int32_t* list = frame.pair_splat + first;
    uint8_t* masks = frame.pair_blocks + first * kMaskBytes;
    // A pair's blocks are found before the previous pair is blended: that pair's number of blocks is hard for the CPU
    // to predict, and it would otherwise wait for this long chain at every turn.
    BlockMask touched = pairs ? touched_blocks(frame.splats[list[0]], at) : 0;
    for (int32_t pair = 0; pair < pairs && canvas->alive; ++pair) {
        if (pair + kAhead < pairs) __builtin_prefetch(frame.splats + list[pair + kAhead]);
        const Splat& s = frame.splats[list[pair]];
        BlockMask blocks = touched & canvas->alive;
        put_mask(masks, pair, blocks);
        if (pair + 1 < pairs) touched = touched_blocks(frame.splats[list[pair + 1]], at);
        const TileSplat splat(s, at);
        while (blocks & (blocks - 1)) blend_blocks<kDepth, 2>(splat, s, &blocks, pair, canvas);
        if (blocks) blend_blocks<kDepth, 1>(splat, s, &blocks, pair, canvas);
    }
}

void blend_tile(const View& view, const FrameData& frame, int tile, const Pictures& out) {
    const TilePlace at = place_of(view, tile);
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
    Canvas canvas;
    canvas.end = frame.pixel_end + static_cast<int64_t>(tile) * kTilePixels;
    canvas.depth_origin = view.depth_origin;
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
    // Σ w (c . dL/dC + z dL/dD + (z - origin)² dL/dS) of the pairs behind, less T dL/dT of what is left behind all of
    // them.
    alignas(64) float behind[kTilePixels];
    alignas(64) float red[kTilePixels], green[kTilePixels], blue[kTilePixels];  // dL/d(pictures)
    alignas(64) float depth[kTilePixels], depth_square[kTilePixels];
    float depth_origin;
    const int32_t* end;
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
        put_pixels(canvas->depth_square, row, x, in.depth_square_sum ? load(in.depth_square_sum + pixel + x) : zero);
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
        float colour[3 * kTile] = {}, alpha[kTile] = {}, depth_sum[kTile] = {}, depth_square_sum[kTile] = {};
        if (row < at.height) {
            if (in.colour) copy(colour, in.colour + 3 * pixel, 3 * at.width);
            if (in.alpha) copy(alpha, in.alpha + pixel, at.width);
            if (in.depth_sum) copy(depth_sum, in.depth_sum + pixel, at.width);
            if (in.depth_square_sum) copy(depth_square_sum, in.depth_square_sum + pixel, at.width);
        }
        get_row(view, {colour, alpha, depth_sum, depth_square_sum}, 0, row, canvas);
    }
}

// Returns the largest number of pairs that a pixel processed.
int32_t start_back(const View& view, const FrameData& frame, const TilePlace& at, const PictureGradients& in,
                   BackCanvas* canvas) {
    const float* left = frame.transmittance + static_cast<int64_t>(at.index) * kTilePixels;
    canvas->end = frame.pixel_end + static_cast<int64_t>(at.index) * kTilePixels;
    canvas->depth_origin = view.depth_origin;
    get_gradients(view, at, in, canvas);
    int32_t last = 0;
    for (int b = 0; b < kBlocks; ++b) {
        const int p = b * kLanes;
        store(canvas->transmittance + p, load(left + p));
        store(canvas->behind + p, load(canvas->behind + p) * load(left + p));
        for (int lane = 0; lane < kLanes; ++lane) last = last > canvas->end[p + lane] ? last : canvas->end[p + lane];
    }
    return last;
}

// A pair's gradients, a lane a share.
struct Moments {
    Floats s, su, sv, suu, suv, svv, red, green, blue, depth, size_x, size_y, depth_u, depth_v;
};

template <bool kDepth, bool kMagnitudes, int kCount>
SPLAT_INLINE void blend_blocks_backward(const TileSplat& splat, const Splat& s, BlockMask* blocks, int32_t pair,
                                        BackCanvas* canvas, Moments* m) {
    int block[kCount];
    take_blocks(blocks, block);
    Floats alpha[kCount], rest[kCount], inv_rest[kCount], before[kCount], weight[kCount], value[kCount];
    Mask met[kCount], free[kCount];
    const Floats one = fill(1.0f);
    for (int k = 0; k < kCount; ++k) alpha[k] = splat.log2_alpha(block[k]);
    for (int k = 0; k < kCount; ++k)
        met[k] = both(at_most(fill(kLog2AlphaMin), alpha[k]), below(pair, canvas->end + block[k] * kLanes));
    for (int k = 0; k < kCount; ++k) free[k] = at_most(alpha[k], fill(kLog2AlphaMax));
    exp2_each(alpha);
    for (int k = 0; k < kCount; ++k) alpha[k] = only(met[k], min(alpha[k], fill(kAlphaMax)));  // 0 changes nothing
    for (int k = 0; k < kCount; ++k) rest[k] = one - alpha[k];
    for (int k = 0; k < kCount; ++k) inv_rest[k] = inverse(rest[k]);
    for (int k = 0; k < kCount; ++k) before[k] = load(canvas->transmittance + block[k] * kLanes) * inv_rest[k];
    for (int k = 0; k < kCount; ++k) weight[k] = alpha[k] * before[k];
    for (int k = 0; k < kCount; ++k) {
        const int at = block[k] * kLanes;
        const Floats red = load(canvas->red + at), green = load(canvas->green + at), blue = load(canvas->blue + at);
        value[k] = fma(fill(s.colour[0]), red, fma(fill(s.colour[1]), green, fill(s.colour[2]) * blue));
        m->red = fma(weight[k], red, m->red), m->green = fma(weight[k], green, m->green);
        m->blue = fma(weight[k], blue, m->blue);
        if (kDepth) {
            const Floats by_depth = load(canvas->depth + at), by_square = load(canvas->depth_square + at);
            const Floats depth = splat.depth(s, block[k]), from_origin = depth - fill(canvas->depth_origin);
            value[k] = fma(depth, by_depth, value[k]);
            value[k] = fma(from_origin * from_origin, by_square, value[k]);
            const Floats g = weight[k] * fma(from_origin + from_origin, by_square, by_depth);
            m->depth = m->depth + g;
            m->depth_u = fma(g, splat.u_of(block[k]), m->depth_u),
            m->depth_v = fma(g, splat.v_of(block[k]), m->depth_v);
        }
    }
    for (int k = 0; k < kCount; ++k) {
        const int at = block[k] * kLanes;
        const Floats behind = load(canvas->behind + at), light = weight[k] * value[k];
        store(canvas->transmittance + at, before[k]);
        store(canvas->behind + at, behind + light);
        const Floats share = alpha[k] * inv_rest[k];  // dL/d(ln alpha) = light - behind alpha / (1 - alpha)
        const Floats g = only(free[k], fnma(share, behind, light));  // no gradient where clamped
        const Floats u = splat.u_of(block[k]), v = splat.v_of(block[k]), gu = g * u, gv = g * v;
        m->s = m->s + g, m->su = m->su + gu, m->sv = m->sv + gv;
        m->suu = fma(gu, u, m->suu), m->suv = fma(gu, v, m->suv), m->svv = fma(gv, v, m->svv);
        if (kMagnitudes) {
            m->size_x = m->size_x + magnitude(gu);
            m->size_y = m->size_y + magnitude(fma(splat.b, gu, splat.c * gv));
        }
    }
}

template <bool kDepth, bool kMagnitudes>
SPLAT_INLINE void put_slot(const Moments& m, float* slot) {
    sum_lanes(m.s, m.su, m.sv, m.suu, slot);
    sum_lanes(m.suv, m.svv, m.red, m.green, slot + 4);
    if (kDepth || kMagnitudes)
        sum_lanes(m.blue, m.depth, m.size_x, m.size_y, slot + 8);
    else
        slot[8] = sum_lanes(m.blue), slot[9] = slot[10] = slot[11] = 0.0f;
    if (kDepth) sum_lanes(m.depth_u, m.depth_v, fill(0.0f), fill(0.0f), slot + 12);
}

template <bool kDepth, bool kMagnitudes>
SPLAT_INLINE void walk_back(const FrameData& frame, const TilePlace& at, int32_t last, BackCanvas* canvas) {
    constexpr int kFloats = kDepth ? kDepthSlotFloats : kSlotFloats;
    const int64_t first = frame.tile_begin[at.index];
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[at.index + 1] - first);
    const int32_t *list = frame.pair_splat + first, *slots = frame.pair_slot + first;
    for (int32_t pair = last; pair < pairs; ++pair)
        for (int f = 0; f < kFloats; ++f) frame.slots[int64_t{slots[pair]} * kFloats + f] = 0.0f;
    const uint8_t* masks = frame.pair_blocks + first * kMaskBytes;
    for (int32_t pair = last - 1; pair >= 0; --pair) {
        if (pair >= kAhead) {
            __builtin_prefetch(frame.splats + list[pair - kAhead]);
            __builtin_prefetch(frame.slots + int64_t{slots[pair - kAhead]} * kFloats, 1);
        }
        const Splat& s = frame.splats[list[pair]];
        BlockMask blocks = get_mask(masks, pair);
        const TileSplat splat(s, at);
        const Floats zero = fill(0.0f);
        Moments m = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero};
        while (blocks & (blocks - 1))
            blend_blocks_backward<kDepth, kMagnitudes, 2>(splat, s, &blocks, pair, canvas, &m);
        if (blocks) blend_blocks_backward<kDepth, kMagnitudes, 1>(splat, s, &blocks, pair, canvas, &m);
        put_slot<kDepth, kMagnitudes>(m, frame.slots + int64_t{slots[pair]} * kFloats);
    }
}

void blend_tile_backward(const View& view, const FrameData& frame, int tile, const PictureGradients& in,
                         bool magnitudes) {
    const TilePlace at = place_of(view, tile);
    BackCanvas canvas;
    const int32_t last = start_back(view, frame, at, in, &canvas);
    const bool depth = in.depth_sum || in.depth_square_sum;
    if (depth && magnitudes)
        walk_back<true, true>(frame, at, last, &canvas);
    else if (depth)
        walk_back<true, false>(frame, at, last, &canvas);
    else if (magnitudes)
        walk_back<false, true>(frame, at, last, &canvas);
    else
        walk_back<false, false>(frame, at, last, &canvas);
}

int64_t count_contributions(const View& view, const FrameData& frame, int tile) {
    const TilePlace at = place_of(view, tile);
    const int64_t first = frame.tile_begin[tile];
    const int32_t* ends = frame.pixel_end + static_cast<int64_t>(tile) * kTilePixels;
    int32_t last = 0;  // no pair behind it was processed or has a mask
    for (int p = 0; p < kTilePixels; ++p) last = last > ends[p] ? last : ends[p];
    int64_t count = 0;
    for (int32_t pair = 0; pair < last; ++pair) {
        const TileSplat splat(frame.splats[frame.pair_splat[first + pair]], at);
        BlockMask blocks = get_mask(frame.pair_blocks + first * kMaskBytes, pair);
        for (; blocks; blocks &= blocks - 1) {
            const int block = __builtin_ctzll(blocks);
            const Mask met =
                both(at_most(fill(kLog2AlphaMin), splat.log2_alpha(block)), below(pair, ends + block * kLanes));
            count += __builtin_popcount(bits(met));
        }
    }
    return count;
}

}  // namespace

extern const BlendKernels blend_kernels = {blend_tile, blend_tile_backward, count_contributions, kMaskBytes};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
