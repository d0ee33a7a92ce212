// Blending a tile's features, forward and backward, as raster_blend.cpp blends colours. Compiled once per ISA (see
// isa.h for what that forbids).
#include "raster/features.h"
#include "raster/tile.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

// What is read while a tile is walked. kChannels is 0 where it is not known when this is compiled.
struct Walk {
    const FrameData& frame;
    const Features& features;
    TilePlace at;
    float* planes;   // (channels, kTilePixels): the pictures, or their gradients
    float* channel;  // (channels, kLanes): the backward pass's sums, if they are not in registers
};

template <int kChannels>
SPLAT_INLINE int channels_of(const Walk& walk) {
    return kChannels ? kChannels : walk.features.channels;
}

template <int kChannels>
SPLAT_INLINE const float* features_of(const Walk& walk, int32_t i) {
    constexpr bool kInline = kChannels > 0 && kChannels <= kInlineChannels;
    return kInline ? &walk.frame.splats[i].x + kInlineAt : walk.features.rows + int64_t{i} * walk.features.channels;
}

template <int kChannels>
SPLAT_INLINE void fetch(const Walk& walk, int32_t i) {
    __builtin_prefetch(walk.frame.splats + i);
    if (!kChannels) __builtin_prefetch(features_of<kChannels>(walk, i));
}

// The last channel of a slanted splat, less its value at the centre.
SPLAT_INLINE Floats slant_of(const TileSplat& splat, const Splat& s, int block) {
    return fma(fill(s.depth_u), splat.u_of(block), fill(s.depth_v) * splat.v_of(block));
}

template <int kChannels, bool kSlanted, int kCount>
SPLAT_INLINE void blend_blocks(const Walk& walk, const TileSplat& splat, const Splat& s, const float* features,
                               BlockMask* blocks, int32_t pair, Light* light) {
    int block[kCount];
    take_blocks(blocks, block);
    Floats alpha[kCount], before[kCount], after[kCount], weight[kCount];
    Mask met[kCount], blended[kCount];
    for (int k = 0; k < kCount; ++k) alpha[k] = splat.log2_alpha(block[k]);
    for (int k = 0; k < kCount; ++k) before[k] = load(light->transmittance + block[k] * kLanes);
    for (int k = 0; k < kCount; ++k) met[k] = both(at_most(fill(kLog2AlphaMin), alpha[k]), less(fill(0.0f), before[k]));
    exp2_each(alpha);
    for (int k = 0; k < kCount; ++k) weight[k] = min(alpha[k], fill(walk.features.alpha_max)) * before[k];
    for (int k = 0; k < kCount; ++k) after[k] = before[k] - weight[k];
    for (int k = 0; k < kCount; ++k) blended[k] = both(met[k], at_most(fill(kTransmittanceMin), after[k]));
    for (int k = 0; k < kCount; ++k) weight[k] = only(blended[k], weight[k]);
    const int channels = channels_of<kChannels>(walk);
    for (int k = 0; k < kCount; ++k) {
        const int at = block[k] * kLanes;
        for (int c = 0; c < channels; ++c) add_to(walk.planes + c * kTilePixels + at, weight[k], fill(features[c]));
        if (kSlanted) add_to(walk.planes + (channels - 1) * kTilePixels + at, weight[k], slant_of(splat, s, block[k]));
        store(light->transmittance + at, select(blended[k], after[k], before[k]));
        const Mask ended = without(met[k], blended[k]);
        if (__builtin_expect(any(ended), 0)) end_pixels(light, block[k], ended, pair);
    }
}

template <int kChannels, bool kSlanted>
void walk_forward(const Walk& walk, int32_t pairs, Light* light) {
    const FrameData& frame = walk.frame;
    const int64_t first = frame.tile_begin[walk.at.index];
    const int32_t* list = frame.pair_splat + first;
    uint8_t* masks = frame.pair_blocks + first * kMaskBytes;
    BlockMask touched = pairs ? touched_blocks(frame.splats[list[0]], walk.at) : 0;  // one ahead: see raster_blend.cpp
    for (int32_t pair = 0; pair < pairs && light->alive; ++pair) {
        if (pair + kAhead < pairs) fetch<kChannels>(walk, list[pair + kAhead]);
        const Splat& s = frame.splats[list[pair]];
        const float* features = features_of<kChannels>(walk, list[pair]);
        BlockMask blocks = touched & light->alive;
        put_mask(masks, pair, blocks);
        if (pair + 1 < pairs) touched = touched_blocks(frame.splats[list[pair + 1]], walk.at);
        const TileSplat splat(s, walk.at);
        while (blocks & (blocks - 1))
            blend_blocks<kChannels, kSlanted, 2>(walk, splat, s, features, &blocks, pair, light);
        if (blocks) blend_blocks<kChannels, kSlanted, 1>(walk, splat, s, features, &blocks, pair, light);
    }
}

// Where pixel (x, y) of a tile is in a plane of blocks.
SPLAT_INLINE int place_in_plane(int x, int y) { return piece(y, x / kBlockWidth * kBlockWidth) + x % kBlockWidth; }

void put_pictures(const View& view, const Walk& walk, const Light& light, const FeaturePictures& out) {
    const int channels = walk.features.channels;
    const float* background = walk.features.background;
    for (int y = 0; y < walk.at.height; ++y)
        for (int x = 0; x < walk.at.width; ++x) {
            const int p = place_in_plane(x, y);
            const int64_t pixel = static_cast<int64_t>(walk.at.top + y) * view.width + walk.at.left + x;
            const float left = light.transmittance[p];
            out.alpha[pixel] = 1.0f - left;
            float* to = out.features + pixel * channels;
            for (int c = 0; c < channels; ++c)
                to[c] = fused(left, background ? background[c] : 0.0f, walk.planes[c * kTilePixels + p]);
        }
}

void blend_tile(const View& view, const FrameData& frame, const Features& features, int tile,
                const FeaturePictures& out, float* scratch) {
    const Walk walk = {frame, features, place_of(view, tile), scratch, nullptr};
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[tile + 1] - frame.tile_begin[tile]);
    Light light;
    light.end = frame.pixel_end + static_cast<int64_t>(tile) * kTilePixels;
    start_light(walk.at, pairs, &light);
    __builtin_memset(walk.planes, 0, static_cast<size_t>(features.channels) * kTilePixels * sizeof(float));
    switch (features.slanted ? -features.channels : features.channels) {
        case 1:
            walk_forward<1, false>(walk, pairs, &light);
            break;
        case 3:
            walk_forward<3, false>(walk, pairs, &light);
            break;
        case 4:
            walk_forward<4, false>(walk, pairs, &light);
            break;
        case -1:
            walk_forward<1, true>(walk, pairs, &light);
            break;
        case -4:
            walk_forward<4, true>(walk, pairs, &light);
            break;
        default:
            if (features.slanted)
                walk_forward<0, true>(walk, pairs, &light);
            else
                walk_forward<0, false>(walk, pairs, &light);
    }
    float* left = frame.transmittance + static_cast<int64_t>(tile) * kTilePixels;
    for (int p = 0; p < kTilePixels; ++p) left[p] = light.transmittance[p] = __builtin_fabsf(light.transmittance[p]);
    put_pictures(view, walk, light, out);
}

// A tile's pixels on their way back.
struct BackLight {
    alignas(64) float transmittance[kTilePixels];  // behind the pair
    // Σ w (f . dL/dF) of the pairs behind, less T dL/dT of what is left behind all of them.
    alignas(64) float behind[kTilePixels];
    const int32_t* end;
};

// Returns the largest number of pairs that a pixel processed.
int32_t start_back(const View& view, const Walk& walk, const FeaturePictureGradients& in, BackLight* light) {
    const int channels = walk.features.channels;
    const float* background = walk.features.background;
    const float* left = walk.frame.transmittance + static_cast<int64_t>(walk.at.index) * kTilePixels;
    light->end = walk.frame.pixel_end + static_cast<int64_t>(walk.at.index) * kTilePixels;
    const auto size = static_cast<size_t>(channels) * kTilePixels * sizeof(float);
    __builtin_memset(walk.planes, 0, size);
    __builtin_memset(light->behind, 0, sizeof light->behind);
    __builtin_memcpy(light->transmittance, left, sizeof light->transmittance);
    int32_t last = 0;
    for (int y = 0; y < walk.at.height; ++y)
        for (int x = 0; x < walk.at.width; ++x) {
            const int p = place_in_plane(x, y);
            const int64_t pixel = static_cast<int64_t>(walk.at.top + y) * view.width + walk.at.left + x;
            float by_left = in.alpha ? -in.alpha[pixel] : 0.0f;
            for (int c = 0; in.features && c < channels; ++c) {
                const float by_channel = in.features[pixel * channels + c];
                walk.planes[c * kTilePixels + p] = by_channel;
                if (background) by_left += by_channel * background[c];
            }
            light->behind[p] = by_left * left[p];
            last = last > light->end[p] ? last : light->end[p];
        }
    return last;
}

// A pair's gradients, a lane a share. Channels are in registers if their number is known, else in memory.
template <int kChannels>
struct Moments {
    Floats s, su, sv, suu, suv, svv, size_x, size_y, slant_u, slant_v;
    Floats channel[kChannels ? kChannels : 1];
};

template <int kChannels, bool kSlanted, bool kMagnitudes, int kCount>
SPLAT_INLINE void blend_blocks_backward(const Walk& walk, const TileSplat& splat, const Splat& s, const float* features,
                                        BlockMask* blocks, int32_t pair, BackLight* light, Moments<kChannels>* m) {
    int block[kCount];
    take_blocks(blocks, block);
    Floats alpha[kCount], rest[kCount], inv_rest[kCount], before[kCount], weight[kCount], value[kCount];
    Mask met[kCount], free[kCount];
    const Floats one = fill(1.0f);
    for (int k = 0; k < kCount; ++k) alpha[k] = splat.log2_alpha(block[k]);
    for (int k = 0; k < kCount; ++k)
        met[k] = both(at_most(fill(kLog2AlphaMin), alpha[k]), below(pair, light->end + block[k] * kLanes));
    for (int k = 0; k < kCount; ++k) free[k] = at_most(alpha[k], fill(walk.features.log2_alpha_max));
    exp2_each(alpha);
    for (int k = 0; k < kCount; ++k)
        alpha[k] = only(met[k], min(alpha[k], fill(walk.features.alpha_max)));  // 0 changes nothing
    for (int k = 0; k < kCount; ++k) rest[k] = one - alpha[k];
    for (int k = 0; k < kCount; ++k) inv_rest[k] = inverse(rest[k]);
    for (int k = 0; k < kCount; ++k) before[k] = load(light->transmittance + block[k] * kLanes) * inv_rest[k];
    for (int k = 0; k < kCount; ++k) weight[k] = alpha[k] * before[k];
    const int channels = channels_of<kChannels>(walk);
    for (int k = 0; k < kCount; ++k) {
        const float* planes = walk.planes + block[k] * kLanes;
        value[k] = fill(0.0f);
        for (int c = 0; c < channels; ++c) {
            const Floats by_channel = load(planes + c * kTilePixels);
            value[k] = fma(fill(features[c]), by_channel, value[k]);
            if (kChannels)
                m->channel[c] = fma(weight[k], by_channel, m->channel[c]);
            else
                add_to(walk.channel + c * kLanes, weight[k], by_channel);
        }
        if (kSlanted) {
            const Floats by_last = load(planes + (channels - 1) * kTilePixels), g = weight[k] * by_last;
            value[k] = fma(slant_of(splat, s, block[k]), by_last, value[k]);
            m->slant_u = fma(g, splat.u_of(block[k]), m->slant_u);
            m->slant_v = fma(g, splat.v_of(block[k]), m->slant_v);
        }
    }
    for (int k = 0; k < kCount; ++k) {
        const int at = block[k] * kLanes;
        const Floats behind = load(light->behind + at), shine = weight[k] * value[k];
        store(light->transmittance + at, before[k]);
        store(light->behind + at, behind + shine);
        const Floats share = alpha[k] * inv_rest[k];  // dL/d(ln alpha) = shine - behind alpha / (1 - alpha)
        const Floats g = only(free[k], fnma(share, behind, shine));  // no gradient where clamped
        const Floats u = splat.u_of(block[k]), v = splat.v_of(block[k]), gu = g * u, gv = g * v;
        m->s = m->s + g, m->su = m->su + gu, m->sv = m->sv + gv;
        m->suu = fma(gu, u, m->suu), m->suv = fma(gu, v, m->suv), m->svv = fma(gv, v, m->svv);
        if (kMagnitudes) {
            m->size_x = m->size_x + magnitude(gu);
            m->size_y = m->size_y + magnitude(fma(splat.b, gu, splat.c * gv));
        }
    }
}

template <int kChannels, bool kSlanted>
SPLAT_INLINE void put_slot(const Walk& walk, const Moments<kChannels>& m, float* slot) {
    const int channels = channels_of<kChannels>(walk);
    const Floats zero = fill(0.0f);
    sum_lanes(m.s, m.su, m.sv, m.suu, slot);
    sum_lanes(m.suv, m.svv, m.size_x, m.size_y, slot + 4);
    if (kSlanted) sum_lanes(m.slant_u, m.slant_v, zero, zero, slot + kMomentFloats);
    slot += kMomentFloats + (kSlanted ? kSlantFloats : 0);
    const auto channel = [&](int c) {
        if (kChannels) return c < channels ? m.channel[c < kChannels ? c : 0] : zero;
        return c < channels ? load(walk.channel + c * kLanes) : zero;
    };
    for (int c = 0; c < channels; c += 4)
        sum_lanes(channel(c), channel(c + 1), channel(c + 2), channel(c + 3), slot + c);
}

template <int kChannels, bool kSlanted, bool kMagnitudes>
void walk_back(const Walk& walk, int32_t last, BackLight* light) {
    const FrameData& frame = walk.frame;
    const int floats = kChannels ? feature_slot_floats(kChannels, kSlanted) : frame.slot_floats;
    const int64_t first = frame.tile_begin[walk.at.index];
    const int32_t pairs = static_cast<int32_t>(frame.tile_begin[walk.at.index + 1] - first);
    const int32_t *list = frame.pair_splat + first, *slots = frame.pair_slot + first;
    for (int32_t pair = last; pair < pairs; ++pair)
        for (int f = 0; f < floats; ++f) frame.slots[int64_t{slots[pair]} * floats + f] = 0.0f;
    const uint8_t* masks = frame.pair_blocks + first * kMaskBytes;
    for (int32_t pair = last - 1; pair >= 0; --pair) {
        if (pair >= kAhead) {
            fetch<kChannels>(walk, list[pair - kAhead]);
            __builtin_prefetch(frame.slots + int64_t{slots[pair - kAhead]} * floats, 1);
        }
        const Splat& s = frame.splats[list[pair]];
        const float* features = features_of<kChannels>(walk, list[pair]);
        BlockMask blocks = get_mask(masks, pair);
        const TileSplat splat(s, walk.at);
        const Floats zero = fill(0.0f);
        Moments<kChannels> m = {zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, {}};
        if (!kChannels)
            for (int c = 0; c < walk.features.channels; ++c) store(walk.channel + c * kLanes, zero);
        while (blocks & (blocks - 1))
            blend_blocks_backward<kChannels, kSlanted, kMagnitudes, 2>(walk, splat, s, features, &blocks, pair, light,
                                                                       &m);
        if (blocks)
            blend_blocks_backward<kChannels, kSlanted, kMagnitudes, 1>(walk, splat, s, features, &blocks, pair, light,
                                                                       &m);
        put_slot<kChannels, kSlanted>(walk, m, frame.slots + int64_t{slots[pair]} * floats);
    }
}

template <bool kMagnitudes>
void walk_back_of(const Walk& walk, int32_t last, BackLight* light) {
    switch (walk.features.slanted ? -walk.features.channels : walk.features.channels) {
        case 1:
            return walk_back<1, false, kMagnitudes>(walk, last, light);
        case 3:
            return walk_back<3, false, kMagnitudes>(walk, last, light);
        case 4:
            return walk_back<4, false, kMagnitudes>(walk, last, light);
        case -1:
            return walk_back<1, true, kMagnitudes>(walk, last, light);
        case -4:
            return walk_back<4, true, kMagnitudes>(walk, last, light);
        default:
            return walk.features.slanted ? walk_back<0, true, kMagnitudes>(walk, last, light)
                                         : walk_back<0, false, kMagnitudes>(walk, last, light);
    }
}

void blend_tile_backward(const View& view, const FrameData& frame, const Features& features, int tile,
                         const FeaturePictureGradients& in, bool magnitudes, float* scratch) {
    float* channel = scratch + static_cast<int64_t>(features.channels) * kTilePixels;
    const Walk walk = {frame, features, place_of(view, tile), scratch, channel};
    BackLight light;
    const int32_t last = start_back(view, walk, in, &light);
    if (magnitudes)
        walk_back_of<true>(walk, last, &light);
    else
        walk_back_of<false>(walk, last, &light);
}

}  // namespace

extern const FeatureBlendKernels feature_blend_kernels = {blend_tile, blend_tile_backward, kMaskBytes};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
