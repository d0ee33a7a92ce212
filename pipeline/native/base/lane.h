// The counterpart of simd.h for code in which a thread has one Gaussian: a lane is a float.
#pragma once

#include "base/device.h"

#define SPLAT_ISA_NAMESPACE lane
#define SPLAT_INLINE static __device__ __forceinline__
#define SPLAT_TABLE __device__ constexpr
#if SPLAT_ON_CPU
#define SPLAT_UNROLL
#else
#define SPLAT_UNROLL _Pragma("unroll")  // so that indexed arrays stay in registers
#endif

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

using Floats = float;
using Mask = bool;

SPLAT_INLINE Floats fill(float x) { return x; }
SPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) { return ::fmaf(a, b, c); }
SPLAT_INLINE Floats min(Floats a, Floats b) { return a < b ? a : b; }  // b where either is NaN
SPLAT_INLINE Floats max(Floats a, Floats b) { return a > b ? a : b; }  // b where either is NaN
SPLAT_INLINE Floats sqrt(Floats a) { return ::sqrtf(a); }
SPLAT_INLINE Floats ceil(Floats a) { return ::ceilf(a); }
SPLAT_INLINE Floats floor(Floats a) { return ::floorf(a); }
SPLAT_INLINE Floats log2(Floats a) { return ::log2f(a); }
SPLAT_INLINE Mask none() { return false; }
SPLAT_INLINE Mask less(Floats a, Floats b) { return a < b; }
SPLAT_INLINE Mask at_most(Floats a, Floats b) { return a <= b; }
SPLAT_INLINE Mask both(Mask a, Mask b) { return a && b; }
SPLAT_INLINE Mask either(Mask a, Mask b) { return a || b; }
SPLAT_INLINE Floats select(Mask m, Floats yes, Floats no) { return m ? yes : no; }
SPLAT_INLINE Floats only(Mask m, Floats v) { return m ? v : 0.0f; }
SPLAT_INLINE Floats clamp(Floats x, Floats low, Floats high) { return min(max(x, low), high); }
SPLAT_INLINE Floats exp2_wide(Floats x) { return ::exp2f(clamp(x, -126.0f, 127.0f)); }

// a b + c, rounded once wherever it is inlined: kernels that must agree to the bit share what is written with it.
SPLAT_INLINE float fused(float a, float b, float c) { return ::fmaf(a, b, c); }
SPLAT_INLINE float root(float x) { return ::sqrtf(x > 0.0f ? x : 0.0f); }

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
