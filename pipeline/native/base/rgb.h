// Vectors of pixels with interleaved colours, for kernel files. Everything has internal linkage (see isa.h).
#pragma once

#include "base/simd.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

struct Colours {
    Floats channel[3];
};

SPLAT_INLINE Colours get(const float* p) {
    Colours c;
    load_rgb(p, &c.channel[0], &c.channel[1], &c.channel[2]);
    return c;
}

SPLAT_INLINE void put(float* p, const Colours& c) { store_rgb(p, c.channel[0], c.channel[1], c.channel[2]); }

// The last pixels, fewer than kLanes, padded with zeros, which add nothing to a sum.
struct Ragged {
    float pixels[3 * kLanes];
    SPLAT_METHOD Ragged(const float* p, int64_t count) {
        for (int64_t i = 0; i < 3 * kLanes; ++i) pixels[i] = i < 3 * count ? p[i] : 0.0f;
    }
    SPLAT_METHOD void to(float* p, int64_t count) const {
        for (int64_t i = 0; i < 3 * count; ++i) p[i] = pixels[i];
    }
};

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
