// Applying an affine map to an image's colours, forward and backward. Compiled once per ISA: internal linkage, no std
// templates.
#include "base/rgb.h"
#include "loss/colour.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

SPLAT_INLINE Colours mapped(const float* map, const Colours& in) {
    Colours out;
    for (int i = 0; i < 3; ++i) {
        const float* row = map + 4 * i;
        out.channel[i] = fma(fill(row[0]), in.channel[0],
                             fma(fill(row[1]), in.channel[1], fma(fill(row[2]), in.channel[2], fill(row[3]))));
    }
    return out;
}

// The linear part's transpose.
SPLAT_INLINE Colours mapped_back(const float* map, const Colours& up) {
    Colours in;
    for (int j = 0; j < 3; ++j)
        in.channel[j] =
            fma(fill(map[j]), up.channel[0], fma(fill(map[4 + j]), up.channel[1], fill(map[8 + j]) * up.channel[2]));
    return in;
}

struct Sums {
    Floats of[kAffine];
};

SPLAT_INLINE void add_products(const Colours& in, const Colours& up, Sums* sums) {
    for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) sums->of[4 * i + j] = fma(up.channel[i], in.channel[j], sums->of[4 * i + j]);
        sums->of[4 * i + 3] = sums->of[4 * i + 3] + up.channel[i];
    }
}

void forward(const float* map, const float* in, int64_t pixels, float* out) {
    int64_t i = 0;
    for (; i + kLanes <= pixels; i += kLanes) put(out + 3 * i, mapped(map, get(in + 3 * i)));
    if (i == pixels) return;
    Ragged last(in + 3 * i, pixels - i);
    put(last.pixels, mapped(map, get(last.pixels)));
    last.to(out + 3 * i, pixels - i);
}

void backward(const float* map, const float* in, const float* upstream, int64_t pixels, float* gradient,
              float* map_gradient) {
    Sums sums;
    for (int k = 0; k < kAffine; ++k) sums.of[k] = fill(0.0f);
    int64_t i = 0;
    for (; i + kLanes <= pixels; i += kLanes) {
        const Colours up = get(upstream + 3 * i);
        add_products(get(in + 3 * i), up, &sums);
        put(gradient + 3 * i, mapped_back(map, up));
    }
    if (i < pixels) {
        const Ragged last(in + 3 * i, pixels - i);
        Ragged up(upstream + 3 * i, pixels - i);
        const Colours colours = get(up.pixels);
        add_products(get(last.pixels), colours, &sums);
        put(up.pixels, mapped_back(map, colours));
        up.to(gradient + 3 * i, pixels - i);
    }
    for (int k = 0; k < kAffine; k += 4)
        sum_lanes(sums.of[k], sums.of[k + 1], sums.of[k + 2], sums.of[k + 3], map_gradient + k);
}

}  // namespace

extern const ColourKernels colour_kernels = {forward, backward};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
