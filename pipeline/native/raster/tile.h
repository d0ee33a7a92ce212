// A tile's pixels, for the kernels that blend them, with SIMD over pixels.
//
// A tile's pixels are kept in blocks of kLanes: 4 x 4 pixels with 16 lanes, 4 x 2 with 8, 4 x 1 with 4. Pair by pair,
// the blocks that the splat touches are found from the chord of its ellipse in every row, and only these are processed.
#pragma once

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

SPLAT_INLINE bool inside(const TilePlace& at, int p) { return column_of(p) < at.width && row_of(p) < at.height; }

// The light left of a tile's pixels on their way from front to back.
struct Light {
    alignas(64) float transmittance[kTilePixels];  // negative where the pixel has ended
    int32_t* end;                                  // pairs that the pixels processed
    BlockMask alive;                               // blocks with a pixel that has not ended
};

void start_light(const TilePlace& at, int pairs, Light* light) {
    for (int p = 0; p < kTilePixels; ++p) light->transmittance[p] = 1.0f, light->end[p] = pairs;
    light->alive = kAllBlocks;
    if (at.width == kTile && at.height == kTile) return;
    light->alive = 0;
    for (int p = 0; p < kTilePixels; ++p) {
        if (inside(at, p))
            light->alive |= BlockMask{1} << (p / kLanes);
        else
            light->transmittance[p] = -1.0f, light->end[p] = 0;
    }
}

// Pixels of a block that end at this pair. Rare.
__attribute__((noinline)) void end_pixels(Light* light, int block, Mask which, int32_t pair) {
    float* const at = light->transmittance + block * kLanes;
    const Floats zero = fill(0.0f), before = load(at), left = select(which, zero - before, before);
    store(at, left);
    for (uint32_t lanes = bits(which); lanes; lanes &= lanes - 1)
        light->end[block * kLanes + __builtin_ctz(lanes)] = pair;
    if (!any(less(zero, left))) light->alive &= ~(BlockMask{1} << block);
}

SPLAT_INLINE void add_to(float* sum, Floats weight, Floats value) { store(sum, fma(weight, value, load(sum))); }

// Takes the next kCount blocks out of a mask. Work on several of them is interleaved step by step: one block is a chain
// of about 25 dependent operations, and a CPU's scheduler holds too few to overlap it with the next block by itself.
template <int kCount>
SPLAT_INLINE void take_blocks(BlockMask* blocks, int (&block)[kCount]) {
    for (int& b : block) b = __builtin_ctzll(*blocks), *blocks &= *blocks - 1;
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

SPLAT_INLINE void copy(float* to, const float* from, int floats) {
    __builtin_memcpy(to, from, static_cast<size_t>(floats) * sizeof(float));
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

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
