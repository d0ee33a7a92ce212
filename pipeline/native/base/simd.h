// Vectors of floats for kernel files: 16 lanes (AVX-512), 8 (AVX2) or 4 (baseline: SSE2, NEON). Arithmetic is written
// with operators; what the compilers' vector extensions lack is here. Everything has internal linkage (see isa.h).
#pragma once

#include <stddef.h>
#include <stdint.h>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

#define SPLAT_INLINE static inline __attribute__((always_inline))
#define SPLAT_METHOD inline __attribute__((always_inline))
#define SPLAT_UNROLL
#define SPLAT_TABLE constexpr

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

#if SPLAT_ISA_AVX512

constexpr int kLanes = 16;
using Floats = __m512;
using Mask = __mmask16;

SPLAT_INLINE Floats fill(float x) { return _mm512_set1_ps(x); }
SPLAT_INLINE Floats load(const float* p) { return _mm512_loadu_ps(p); }
SPLAT_INLINE void store(float* p, Floats v) { _mm512_storeu_ps(p, v); }
SPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm512_fmadd_ps(a, b, c); }    // ab + c
SPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm512_fnmadd_ps(a, b, c); }  // c - ab
SPLAT_INLINE Floats min(Floats a, Floats b) { return _mm512_min_ps(a, b); }                   // b where either is NaN
SPLAT_INLINE Floats max(Floats a, Floats b) { return _mm512_max_ps(a, b); }                   // b where either is NaN
SPLAT_INLINE Floats sqrt(Floats a) { return _mm512_sqrt_ps(a); }
SPLAT_INLINE Floats ceil(Floats a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC); }
SPLAT_INLINE Floats floor(Floats a) { return _mm512_roundscale_ps(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC); }
SPLAT_INLINE __m512i ceil_to_ints(Floats a) {
    return _mm512_cvt_roundps_epi32(a, _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC);
}
SPLAT_INLINE __m512i floor_to_ints(Floats a) {
    return _mm512_cvt_roundps_epi32(a, _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC);
}
SPLAT_INLINE Mask less(Floats a, Floats b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
SPLAT_INLINE Mask at_most(Floats a, Floats b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
SPLAT_INLINE Mask both(Mask a, Mask b) { return static_cast<Mask>(a & b); }
SPLAT_INLINE Mask either(Mask a, Mask b) { return static_cast<Mask>(a | b); }
SPLAT_INLINE Mask without(Mask a, Mask b) { return static_cast<Mask>(a & ~b); }
SPLAT_INLINE bool any(Mask m) { return m != 0; }
SPLAT_INLINE uint32_t bits(Mask m) { return m; }  // lane i is bit i
SPLAT_INLINE Floats select(Mask m, Floats yes, Floats no) { return _mm512_mask_blend_ps(m, no, yes); }
SPLAT_INLINE Floats only(Mask m, Floats v) { return _mm512_maskz_mov_ps(m, v); }  // 0 elsewhere
SPLAT_INLINE Floats gather(const float* p, int stride) {                          // p[lane * stride]
    const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    return _mm512_i32gather_ps(_mm512_mullo_epi32(lane, _mm512_set1_epi32(stride)), p, 4);
}
// The four bytes of p[y * width + x], lowest first; x and y are whole numbers.
SPLAT_INLINE void gather_bytes(const uint32_t* p, Floats x, Floats y, int width, Floats* out) {
    const __m512i rows = _mm512_mullo_epi32(_mm512_cvttps_epi32(y), _mm512_set1_epi32(width));
    const __m512i found = _mm512_i32gather_epi32(_mm512_add_epi32(rows, _mm512_cvttps_epi32(x)), p, 4);
    const __m512i byte = _mm512_set1_epi32(255);
    out[0] = _mm512_cvtepi32_ps(_mm512_and_si512(found, byte));
    out[1] = _mm512_cvtepi32_ps(_mm512_and_si512(_mm512_srli_epi32(found, 8), byte));
    out[2] = _mm512_cvtepi32_ps(_mm512_and_si512(_mm512_srli_epi32(found, 16), byte));
    out[3] = _mm512_cvtepi32_ps(_mm512_srli_epi32(found, 24));
}
// Lanes for which value < p[lane].
SPLAT_INLINE Mask below(int32_t value, const int32_t* p) {
    return _mm512_cmplt_epi32_mask(_mm512_set1_epi32(value), _mm512_loadu_si512(p));
}
// Interleaved colours of a vector of pixels.
SPLAT_INLINE void store_rgb(float* p, Floats red, Floats green, Floats blue) {
    const __m512i rg0 = _mm512_setr_epi32(0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5);
    const __m512i rg1 = _mm512_setr_epi32(21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26);
    const __m512i rg2 = _mm512_setr_epi32(0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0);
    const __m512i b0 = _mm512_setr_epi32(0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15);
    const __m512i b1 = _mm512_setr_epi32(0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15);
    const __m512i b2 = _mm512_setr_epi32(26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31);
    store(p, _mm512_permutex2var_ps(_mm512_permutex2var_ps(red, rg0, green), b0, blue));
    store(p + 16, _mm512_permutex2var_ps(_mm512_permutex2var_ps(red, rg1, green), b1, blue));
    store(p + 32, _mm512_permutex2var_ps(_mm512_permutex2var_ps(red, rg2, green), b2, blue));
}
SPLAT_INLINE Floats pick_third(Floats v0, Floats v1, Floats v2, __m512i from_01, __m512i from_2) {
    return _mm512_permutex2var_ps(_mm512_permutex2var_ps(v0, from_01, v1), from_2, v2);
}
SPLAT_INLINE void load_rgb(const float* p, Floats* red, Floats* green, Floats* blue) {
    const Floats v0 = load(p), v1 = load(p + 16), v2 = load(p + 32);
    *red = pick_third(v0, v1, v2, _mm512_setr_epi32(0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0),
                      _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29));
    *green = pick_third(v0, v1, v2, _mm512_setr_epi32(1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0),
                        _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30));
    *blue = pick_third(v0, v1, v2, _mm512_setr_epi32(2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0),
                       _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31));
}
// A 16 x 16 matrix: v[i][j] to v[j][i].
SPLAT_INLINE void transpose(Floats* v) {
    Floats pair[16], quad[16];
    for (int i = 0; i < 16; i += 2) {
        pair[i] = _mm512_unpacklo_ps(v[i], v[i + 1]);
        pair[i + 1] = _mm512_unpackhi_ps(v[i], v[i + 1]);
    }
    for (int i = 0; i < 16; i += 4)
        for (int j = 0; j < 2; ++j) {
            quad[i + 2 * j] = _mm512_shuffle_ps(pair[i + j], pair[i + j + 2], 0x44);
            quad[i + 2 * j + 1] = _mm512_shuffle_ps(pair[i + j], pair[i + j + 2], 0xee);
        }
    for (int j = 0; j < 4; ++j) {  // quad[4 i + j]: rows 4 i..4 i + 3 of columns j, j + 4, j + 8, j + 12
        const Floats even01 = _mm512_shuffle_f32x4(quad[j], quad[4 + j], 0x88);
        const Floats odd01 = _mm512_shuffle_f32x4(quad[j], quad[4 + j], 0xdd);
        const Floats even23 = _mm512_shuffle_f32x4(quad[8 + j], quad[12 + j], 0x88);
        const Floats odd23 = _mm512_shuffle_f32x4(quad[8 + j], quad[12 + j], 0xdd);
        v[j] = _mm512_shuffle_f32x4(even01, even23, 0x88);
        v[8 + j] = _mm512_shuffle_f32x4(even01, even23, 0xdd);
        v[4 + j] = _mm512_shuffle_f32x4(odd01, odd23, 0x88);
        v[12 + j] = _mm512_shuffle_f32x4(odd01, odd23, 0xdd);
    }
}
// Pieces of four floats that lie `step` apart.
SPLAT_INLINE Floats load_pieces(const float* p, int step) {
    Floats v = _mm512_castps128_ps512(_mm_loadu_ps(p));
    v = _mm512_insertf32x4(v, _mm_loadu_ps(p + step), 1);
    v = _mm512_insertf32x4(v, _mm_loadu_ps(p + 2 * step), 2);
    return _mm512_insertf32x4(v, _mm_loadu_ps(p + 3 * step), 3);
}
SPLAT_INLINE void store_pieces(float* p, int step, Floats v) {
    _mm_storeu_ps(p, _mm512_castps512_ps128(v));
    _mm_storeu_ps(p + step, _mm512_extractf32x4_ps(v, 1));
    _mm_storeu_ps(p + 2 * step, _mm512_extractf32x4_ps(v, 2));
    _mm_storeu_ps(p + 3 * step, _mm512_extractf32x4_ps(v, 3));
}
// 1/x within 1 ulp or so. The estimate is specified to the bit, unlike the older ones.
SPLAT_INLINE Floats inverse(Floats x) {
    const Floats estimate = _mm512_rcp14_ps(x);
    return fma(estimate, fnma(x, estimate, fill(1.0f)), estimate);
}
// Sums over the lanes of a, b, c, d to out[0..3].
SPLAT_INLINE void sum_lanes(Floats a, Floats b, Floats c, Floats d, float* out) {
    const Floats ab = _mm512_unpacklo_ps(a, b) + _mm512_unpackhi_ps(a, b);
    const Floats cd = _mm512_unpacklo_ps(c, d) + _mm512_unpackhi_ps(c, d);
    const Floats abcd = _mm512_shuffle_ps(ab, cd, 0x44) + _mm512_shuffle_ps(ab, cd, 0xee);
    const __m256 half = _mm512_castps512_ps256(abcd) + _mm512_extractf32x8_ps(abcd, 1);
    _mm_storeu_ps(out, _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1));
}
SPLAT_INLINE float sum_lanes(Floats a) {
    const __m256 half = _mm512_castps512_ps256(a) + _mm512_extractf32x8_ps(a, 1);
    const __m128 quarter = _mm256_castps256_ps128(half) + _mm256_extractf128_ps(half, 1);
    return (quarter[0] + quarter[2]) + (quarter[1] + quarter[3]);
}

#elif SPLAT_ISA_AVX2

constexpr int kLanes = 8;
using Floats = __m256;
using Mask = __m256;  // all bits of a lane, or none

SPLAT_INLINE Floats fill(float x) { return _mm256_set1_ps(x); }
SPLAT_INLINE Floats load(const float* p) { return _mm256_loadu_ps(p); }
SPLAT_INLINE void store(float* p, Floats v) { _mm256_storeu_ps(p, v); }
SPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) { return _mm256_fmadd_ps(a, b, c); }
SPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) { return _mm256_fnmadd_ps(a, b, c); }
SPLAT_INLINE Floats min(Floats a, Floats b) { return _mm256_min_ps(a, b); }
SPLAT_INLINE Floats max(Floats a, Floats b) { return _mm256_max_ps(a, b); }
SPLAT_INLINE Floats sqrt(Floats a) { return _mm256_sqrt_ps(a); }
SPLAT_INLINE Floats ceil(Floats a) { return _mm256_ceil_ps(a); }
SPLAT_INLINE Floats floor(Floats a) { return _mm256_floor_ps(a); }
SPLAT_INLINE Mask less(Floats a, Floats b) { return _mm256_cmp_ps(a, b, _CMP_LT_OQ); }
SPLAT_INLINE Mask at_most(Floats a, Floats b) { return _mm256_cmp_ps(a, b, _CMP_LE_OQ); }
SPLAT_INLINE Mask both(Mask a, Mask b) { return _mm256_and_ps(a, b); }
SPLAT_INLINE Mask either(Mask a, Mask b) { return _mm256_or_ps(a, b); }
SPLAT_INLINE Mask without(Mask a, Mask b) { return _mm256_andnot_ps(b, a); }
SPLAT_INLINE bool any(Mask m) { return _mm256_movemask_ps(m) != 0; }
SPLAT_INLINE uint32_t bits(Mask m) { return static_cast<uint32_t>(_mm256_movemask_ps(m)); }
SPLAT_INLINE Floats select(Mask m, Floats yes, Floats no) { return _mm256_blendv_ps(no, yes, m); }
SPLAT_INLINE Floats only(Mask m, Floats v) { return _mm256_and_ps(m, v); }
SPLAT_INLINE Floats gather(const float* p, int stride) {
    const __m256i lane = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
    return _mm256_i32gather_ps(p, _mm256_mullo_epi32(lane, _mm256_set1_epi32(stride)), 4);
}
SPLAT_INLINE void gather_bytes(const uint32_t* p, Floats x, Floats y, int width, Floats* out) {
    const __m256i rows = _mm256_mullo_epi32(_mm256_cvttps_epi32(y), _mm256_set1_epi32(width));
    const __m256i at = _mm256_add_epi32(rows, _mm256_cvttps_epi32(x)), byte = _mm256_set1_epi32(255);
    const __m256i found = _mm256_i32gather_epi32(reinterpret_cast<const int*>(p), at, 4);
    out[0] = _mm256_cvtepi32_ps(_mm256_and_si256(found, byte));
    out[1] = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srli_epi32(found, 8), byte));
    out[2] = _mm256_cvtepi32_ps(_mm256_and_si256(_mm256_srli_epi32(found, 16), byte));
    out[3] = _mm256_cvtepi32_ps(_mm256_srli_epi32(found, 24));
}
// An 8 x 8 matrix: v[i][j] to v[j][i].
SPLAT_INLINE void transpose(Floats* v) {
    Floats pair[8], quad[8];
    for (int i = 0; i < 8; i += 2) {
        pair[i] = _mm256_unpacklo_ps(v[i], v[i + 1]);
        pair[i + 1] = _mm256_unpackhi_ps(v[i], v[i + 1]);
    }
    for (int i = 0; i < 8; i += 4)
        for (int j = 0; j < 2; ++j) {
            quad[i + 2 * j] = _mm256_shuffle_ps(pair[i + j], pair[i + j + 2], 0x44);
            quad[i + 2 * j + 1] = _mm256_shuffle_ps(pair[i + j], pair[i + j + 2], 0xee);
        }
    for (int j = 0; j < 4; ++j) {
        v[j] = _mm256_permute2f128_ps(quad[j], quad[4 + j], 0x20);
        v[4 + j] = _mm256_permute2f128_ps(quad[j], quad[4 + j], 0x31);
    }
}
// Gathers are slow on many CPUs with AVX2, so colours and rows of four go through shuffles.
SPLAT_INLINE Floats load_halves(const float* lower, const float* upper) {
    return _mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(lower)), _mm_loadu_ps(upper), 1);
}
SPLAT_INLINE void store_halves(float* lower, float* upper, Floats v) {
    _mm_storeu_ps(lower, _mm256_castps256_ps128(v));
    _mm_storeu_ps(upper, _mm256_extractf128_ps(v, 1));
}
// Each half of a vector has four pixels' colours, in three pieces of four floats.
SPLAT_INLINE void store_rgb(float* p, Floats red, Floats green, Floats blue) {
    const Floats rg = _mm256_shuffle_ps(red, green, 0x88), gb = _mm256_shuffle_ps(green, blue, 0xdd);
    const Floats br = _mm256_shuffle_ps(blue, red, 0xd8);
    store_halves(p, p + 12, _mm256_shuffle_ps(rg, br, 0x88));
    store_halves(p + 4, p + 16, _mm256_shuffle_ps(gb, rg, 0xd8));
    store_halves(p + 8, p + 20, _mm256_shuffle_ps(br, gb, 0xdd));
}
SPLAT_INLINE void load_rgb(const float* p, Floats* red, Floats* green, Floats* blue) {
    const Floats v0 = load_halves(p, p + 12), v1 = load_halves(p + 4, p + 16), v2 = load_halves(p + 8, p + 20);
    const Floats rg = _mm256_shuffle_ps(v1, v2, 0x9e), gb = _mm256_shuffle_ps(v0, v1, 0x49);
    *red = _mm256_shuffle_ps(v0, rg, 0x8c);
    *green = _mm256_shuffle_ps(gb, rg, 0xd8);
    *blue = _mm256_shuffle_ps(gb, v2, 0xcd);
}
// A 4 x 4 matrix in each half.
SPLAT_INLINE void transpose_halves(Floats* v) {
    const Floats a = _mm256_unpacklo_ps(v[0], v[1]), b = _mm256_unpackhi_ps(v[0], v[1]);
    const Floats c = _mm256_unpacklo_ps(v[2], v[3]), d = _mm256_unpackhi_ps(v[2], v[3]);
    v[0] = _mm256_shuffle_ps(a, c, 0x44), v[1] = _mm256_shuffle_ps(a, c, 0xee);
    v[2] = _mm256_shuffle_ps(b, d, 0x44), v[3] = _mm256_shuffle_ps(b, d, 0xee);
}
SPLAT_INLINE void load_fours(const float* p, Floats* columns) {
    for (int i = 0; i < 4; ++i) columns[i] = load_halves(p + 4 * i, p + 4 * i + 16);
    transpose_halves(columns);
}
SPLAT_INLINE void store_fours(float* p, Floats* columns) {
    transpose_halves(columns);
    for (int i = 0; i < 4; ++i) store_halves(p + 4 * i, p + 4 * i + 16, columns[i]);
}
SPLAT_INLINE Mask below(int32_t value, const int32_t* p) {
    const __m256i loaded = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(p));
    return _mm256_castsi256_ps(_mm256_cmpgt_epi32(loaded, _mm256_set1_epi32(value)));
}
SPLAT_INLINE Floats load_pieces(const float* p, int step) { return load_halves(p, p + step); }
SPLAT_INLINE void store_pieces(float* p, int step, Floats v) { store_halves(p, p + step, v); }
SPLAT_INLINE Floats inverse(Floats x) { return fill(1.0f) / x; }  // rcpps differs between makes of CPU
SPLAT_INLINE void sum_lanes(Floats a, Floats b, Floats c, Floats d, float* out) {
    const Floats abcd = _mm256_hadd_ps(_mm256_hadd_ps(a, b), _mm256_hadd_ps(c, d));
    _mm_storeu_ps(out, _mm256_castps256_ps128(abcd) + _mm256_extractf128_ps(abcd, 1));
}
SPLAT_INLINE float sum_lanes(Floats a) {
    const __m128 half = _mm256_castps256_ps128(a) + _mm256_extractf128_ps(a, 1);
    return (half[0] + half[2]) + (half[1] + half[3]);
}

#else

constexpr int kLanes = 4;
using Floats = float __attribute__((vector_size(16)));
using Mask = int32_t __attribute__((vector_size(16)));

SPLAT_INLINE Floats fill(float x) { return Floats{x, x, x, x}; }
SPLAT_INLINE Floats load(const float* p) {
    Floats v;
    __builtin_memcpy(&v, p, sizeof v);
    return v;
}
SPLAT_INLINE void store(float* p, Floats v) { __builtin_memcpy(p, &v, sizeof v); }
SPLAT_INLINE Floats fma(Floats a, Floats b, Floats c) { return a * b + c; }
SPLAT_INLINE Floats fnma(Floats a, Floats b, Floats c) { return c - a * b; }
SPLAT_INLINE Mask less(Floats a, Floats b) { return a < b; }
SPLAT_INLINE Mask at_most(Floats a, Floats b) { return a <= b; }
SPLAT_INLINE Mask both(Mask a, Mask b) { return a & b; }
SPLAT_INLINE Mask either(Mask a, Mask b) { return a | b; }
SPLAT_INLINE Mask without(Mask a, Mask b) { return a & ~b; }
SPLAT_INLINE Floats select(Mask m, Floats yes, Floats no) {
    return reinterpret_cast<Floats>((m & reinterpret_cast<Mask>(yes)) | (~m & reinterpret_cast<Mask>(no)));
}
SPLAT_INLINE Floats only(Mask m, Floats v) { return reinterpret_cast<Floats>(m & reinterpret_cast<Mask>(v)); }
SPLAT_INLINE Floats min(Floats a, Floats b) { return select(a < b, a, b); }
SPLAT_INLINE Floats max(Floats a, Floats b) { return select(a > b, a, b); }
SPLAT_INLINE Floats gather(const float* p, int stride) { return Floats{p[0], p[stride], p[2 * stride], p[3 * stride]}; }
SPLAT_INLINE void gather_bytes(const uint32_t* p, Floats x, Floats y, int width, Floats* out) {
    for (int i = 0; i < kLanes; ++i) {
        const uint32_t found = p[static_cast<int32_t>(y[i]) * static_cast<int64_t>(width) + static_cast<int32_t>(x[i])];
        for (int k = 0; k < 4; ++k) out[k][i] = static_cast<float>((found >> (8 * k)) & 255U);
    }
}
// A 4 x 4 matrix: v[i][j] to v[j][i].
SPLAT_INLINE void transpose(Floats* v) {
    const Floats a = v[0], b = v[1], c = v[2], d = v[3];
    v[0] = Floats{a[0], b[0], c[0], d[0]}, v[1] = Floats{a[1], b[1], c[1], d[1]};
    v[2] = Floats{a[2], b[2], c[2], d[2]}, v[3] = Floats{a[3], b[3], c[3], d[3]};
}
SPLAT_INLINE Mask below(int32_t value, const int32_t* p) {
    Mask loaded;
    __builtin_memcpy(&loaded, p, sizeof loaded);
    return value < loaded;
}
SPLAT_INLINE Floats load_pieces(const float* p, int) { return load(p); }
SPLAT_INLINE void store_pieces(float* p, int, Floats v) { store(p, v); }
SPLAT_INLINE Floats inverse(Floats x) { return fill(1.0f) / x; }
SPLAT_INLINE void sum_lanes(Floats a, Floats b, Floats c, Floats d, float* out) {
    out[0] = (a[0] + a[2]) + (a[1] + a[3]);
    out[1] = (b[0] + b[2]) + (b[1] + b[3]);
    out[2] = (c[0] + c[2]) + (c[1] + c[3]);
    out[3] = (d[0] + d[2]) + (d[1] + d[3]);
}
SPLAT_INLINE float sum_lanes(Floats a) { return (a[0] + a[2]) + (a[1] + a[3]); }
// Rounds to whole numbers in ±2^22; larger values are returned unchanged.
SPLAT_INLINE Floats nearest(Floats a) {
    const Floats magic = fill(12582912.0f);  // 1.5 · 2^23
    const Floats size = select(a < 0.0f, -a, a);
    return select(size < 4194304.0f, (a + magic) - magic, a);
}
SPLAT_INLINE Floats floor(Floats a) {
    const Floats n = nearest(a);
    return n - only(n > a, fill(1.0f));
}
SPLAT_INLINE Floats ceil(Floats a) { return -floor(-a); }
#if defined(__x86_64__)
SPLAT_INLINE Floats sqrt(Floats a) { return _mm_sqrt_ps(a); }
SPLAT_INLINE uint32_t bits(Mask m) { return static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(m))); }
#else
SPLAT_INLINE Floats sqrt(Floats a) {
    return Floats{__builtin_sqrtf(a[0]), __builtin_sqrtf(a[1]), __builtin_sqrtf(a[2]), __builtin_sqrtf(a[3])};
}
SPLAT_INLINE uint32_t bits(Mask m) { return static_cast<uint32_t>((m[0] & 1) | (m[1] & 2) | (m[2] & 4) | (m[3] & 8)); }
#endif
SPLAT_INLINE bool any(Mask m) { return bits(m) != 0; }

#endif

#if !SPLAT_ISA_AVX512 && !SPLAT_ISA_AVX2
SPLAT_INLINE void store_rgb(float* p, Floats red, Floats green, Floats blue) {
    float r[kLanes], g[kLanes], b[kLanes];
    store(r, red), store(g, green), store(b, blue);
    for (int i = 0; i < kLanes; ++i) p[3 * i] = r[i], p[3 * i + 1] = g[i], p[3 * i + 2] = b[i];
}
SPLAT_INLINE void load_rgb(const float* p, Floats* red, Floats* green, Floats* blue) {
    *red = gather(p, 3), *green = gather(p + 1, 3), *blue = gather(p + 2, 3);
}
#endif

// Of kLanes rows of `width` floats, one behind the other, the first `count` columns, a lane a row.
SPLAT_INLINE void load_columns(const float* rows, int width, int count, Floats* columns) {
    int column = 0;
    for (; column < count && column + kLanes <= width; column += kLanes) {
        for (int i = 0; i < kLanes; ++i) columns[column + i] = load(rows + i * width + column);
        transpose(columns + column);
    }
    for (; column < count; ++column) columns[column] = gather(rows + column, width);
}
// The inverse, all columns; what is in them is lost.
SPLAT_INLINE void store_columns(float* rows, int width, Floats* columns) {
    int column = 0;
    for (; column + kLanes <= width; column += kLanes) {
        transpose(columns + column);
        for (int i = 0; i < kLanes; ++i) store(rows + i * width + column, columns[column + i]);
    }
    for (; column < width; ++column) {
        float lanes[kLanes];
        store(lanes, columns[column]);
        for (int i = 0; i < kLanes; ++i) rows[i * width + column] = lanes[i];
    }
}

#if !SPLAT_ISA_AVX2
// kLanes rows of four floats.
SPLAT_INLINE void load_fours(const float* p, Floats* columns) { load_columns(p, 4, 4, columns); }
SPLAT_INLINE void store_fours(float* p, Floats* columns) { store_columns(p, 4, columns); }
#endif

using Ints = int32_t __attribute__((vector_size(kLanes * 4)));

SPLAT_INLINE Mask none() { return less(fill(0.0f), fill(0.0f)); }
SPLAT_INLINE Floats as_floats(Ints v) { return reinterpret_cast<Floats>(v); }
SPLAT_INLINE Ints as_ints(Floats v) { return reinterpret_cast<Ints>(v); }
SPLAT_INLINE Ints fill_int(int32_t x) { return Ints{} + x; }
SPLAT_INLINE Floats magnitude(Floats x) { return as_floats(as_ints(x) & fill_int(0x7fffffff)); }
SPLAT_INLINE Floats clamp(Floats x, Floats low, Floats high) { return min(max(x, low), high); }

// 2^x for x in [-126, 127]; undefined elsewhere. The fraction of x goes into a polynomial, minimax in the relative
// error, and the whole number into the exponent. AVX-512 has instructions for both, but they occupy the multipliers;
// sums, integers and permutations do not.
#if SPLAT_ISA_AVX512
// x is the nearest sixteenth and a rest: 2^(i/16) from a table, 2^rest from a polynomial of degree 2 (4e-7).
template <int kCount>
SPLAT_INLINE void exp2_each(Floats (&x)[kCount]) {
    const Floats magic = fill(12582912.0f / 16.0f);  // 1.5 · 2^19: the sum's low bits are the nearest sixteenth
    // Bits of 2^(i/16) less those that i adds to the exponent's below, so that one sum does both.
    const __m512i powers = _mm512_setr_epi32(1065353216, 1065200323, 1065063874, 1064944595, 1064843248, 1064760626,
                                             1064697559, 1064654911, 1064633587, 1064634532, 1064658730, 1064707212,
                                             1064781053, 1064881375, 1065009351, 1065166205);
    Floats f[kCount], power[kCount];
    for (int k = 0; k < kCount; ++k) {
        const Floats shifted = x[k] + magic;
        const __m512i n = _mm512_castps_si512(shifted);
        f[k] = x[k] - (shifted - magic);  // in [-1/32, 1/32]
        power[k] = _mm512_castsi512_ps(_mm512_add_epi32(_mm512_permutexvar_epi32(n, powers), _mm512_slli_epi32(n, 19)));
    }
    for (int k = 0; k < kCount; ++k) x[k] = fma(f[k], fill(0.240226507f), fill(0.693187833f));
    for (int k = 0; k < kCount; ++k) x[k] = fma(f[k] * power[k], x[k], power[k]);
}
#else
template <int kCount>
SPLAT_INLINE void exp2_each(Floats (&x)[kCount]) {
    // Degree 5: 1e-7 with its rounding.
    constexpr float kPowers[] = {0.00967151299f, 0.0555073358f, 0.240222424f, 0.693147004f, 1.0f};
    const Floats magic = fill(12582912.0f);  // 1.5 · 2^23: the sum's low bits are the nearest whole number
    Floats shifted[kCount], f[kCount];
    for (int k = 0; k < kCount; ++k) shifted[k] = x[k] + magic;
    for (int k = 0; k < kCount; ++k) f[k] = x[k] - (shifted[k] - magic);  // in [-1/2, 1/2]
    for (int k = 0; k < kCount; ++k) x[k] = fill(0.00132647273f);
    for (float power : kPowers)
        for (int k = 0; k < kCount; ++k) x[k] = fma(x[k], f[k], fill(power));
    for (int k = 0; k < kCount; ++k) x[k] = as_floats(as_ints(x[k]) + (as_ints(shifted[k]) << 23));
}
#endif

SPLAT_INLINE Floats exp2(Floats x) {
    Floats one[1] = {x};
    exp2_each(one);
    return one[0];
}

// 2^x with overflow to a huge number and underflow to (nearly) 0.
SPLAT_INLINE Floats exp2_wide(Floats x) { return exp2(clamp(x, fill(-126.0f), fill(127.0f))); }

// log2(x), normal x > 0, within 2 ulp or so: x = m 2^e with m in [√½, √2), log m = 2 artanh((m - 1)/(m + 1)) by its
// series.
SPLAT_INLINE Floats log2(Floats x) {
    const Ints from_half_root = as_ints(x) - 0x3f3504f3;  // bits of √½
    const Ints exponent = from_half_root >> 23;
    const Floats m = as_floats(as_ints(x) - (exponent << 23));
    const Floats s = (m - fill(1.0f)) / (m + fill(1.0f)), s2 = s * s;
    Floats p = fill(2.885390082f / 9.0f);  // 2 / ln 2 over the odd numbers
    p = fma(p, s2, fill(2.885390082f / 7.0f));
    p = fma(p, s2, fill(2.885390082f / 5.0f));
    p = fma(p, s2, fill(2.885390082f / 3.0f));
    p = fma(p, s2, fill(2.885390082f));
    return fma(p, s, __builtin_convertvector(exponent, Floats));
}

// Of one float.
SPLAT_INLINE float fused(float a, float b, float c) { return a * b + c; }
SPLAT_INLINE float root(float x) { return __builtin_sqrtf(x > 0.0f ? x : 0.0f); }

}  // namespace
}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
