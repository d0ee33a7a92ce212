// Blending a tile, forward and backward, with SIMD over its pixels (see tile.h). Compiled once per ISA (see isa.h for
// what that forbids).
#include "raster/tile.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

// A tile's pixels on their way from front to back.
struct Canvas : Light {
    alignas(64) float red[kTilePixels], green[kTilePixels], blue[kTilePixels];
    alignas(64) float depth[kTilePixels], depth_square[kTilePixels], median[kTilePixels];
    float depth_origin;
};

void start(const TilePlace& at, int pairs, Canvas* canvas) {
    const Floats zero = fill(0.0f);
    for (int p = 0; p < kTilePixels; p += kLanes) {
        store(canvas->red + p, zero), store(canvas->green + p, zero), store(canvas->blue + p, zero);
        store(canvas->depth + p, zero), store(canvas->depth_square + p, zero), store(canvas->median + p, zero);
    }
    start_light(at, pairs, canvas);
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
        if (__builtin_expect(any(ended), 0)) end_pixels(canvas, block[k], ended, pair);
    }
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
