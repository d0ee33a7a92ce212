// Shared by the rasterizer's kernels (compiled per ISA) and its driver (raster_cpu.cpp). Plain structs, no std.
//
// Terms: a Gaussian is in space, a splat is its image on the screen. Candidates are the Gaussians that a cheap test
// does not rule out; a frame stores data only for these. A pair is a splat in a tile that it touches; a slot holds the
// gradient of a pair. Pixel (i, j) has its centre at (i + 0.5, j + 0.5).
#pragma once

#include <stdint.h>

#include "base/isa.h"

namespace splat {

// The definition's constants; definitions.py gives the reasons.
constexpr float kAlphaMax = 0.99f;
constexpr float kAlphaMin = 1.0f / 255.0f;
constexpr float kLog2AlphaMax = -0.014499569695115089f;
constexpr float kLog2AlphaMin = -7.994353436858858f;
constexpr float kTransmittanceMin = 1e-4f;
constexpr float kMedianTransmittance = 0.5f;
constexpr float kMedianShiftMax = 0.5f;
constexpr float kBlurPx2 = 0.3f;
constexpr float kFrustumMargin = 0.3f;
constexpr float kPlaneSigmas = 2.0f;
constexpr float kCompensationMin = 2.5e-5f;
constexpr float kQuatEpsilon = 1e-12f;
constexpr float kRadiusSigmas = 3.0f;
constexpr float kMaxScreenPx = 1e7f;
constexpr float kMaxVariancePx2 = 1e12f;
constexpr float kMaxQuatNorm2 = 1e36f;
constexpr float kMaxColour = 1e6f;
constexpr float kMaxDepth = 1e9f;

constexpr int kTile = 16;  // pixels along a tile's side
constexpr int kTilePixels = kTile * kTile;
constexpr float kHalfLog2E = 0.72134752044448170f;  // exp(-x/2) = 2^(-kHalfLog2E x)
constexpr uint32_t kCulled = 0xffffffffu;           // sort key of a Gaussian that is not visible
constexpr int kSlotFloats = 12;       // a pair's gradients: SplatGradient's fields in order, without those of depth
constexpr int kDepthSlotFloats = 16;  // with depth_u and depth_v, and padding

// A camera and render settings, in the kernels' precision.
struct View {
    int width, height, tiles_x, tiles_y;
    float fx, fy, cx, cy;
    float rotation[9], translation[3];  // cam_from_world, row-major
    float centre[3];                    // centre of projection, world
    float ratio_min[2], ratio_max[2];   // x/z and y/z are clamped to these in the Jacobian
    float near_z;
    float depth_origin;  // squared depths are measured from it, along the view axis
    float background[3];
    int sh_degree;  // that is evaluated
    int sh_count;   // stored coefficients per channel, >= (sh_degree + 1)^2
    bool antialias;
};

// Raw parameters, contiguous rows.
struct Parameters {
    int64_t count;
    const float *means, *log_scales, *quats, *opacity_logits, *sh;
};

// Their gradients, in the same layout.
struct ParameterGradients {
    float *means, *log_scales, *quats, *opacity_logits, *sh;
    float* means2d;  // (n, 2), pixels; with magnitudes the sum of each pixel's |dL/d(mean2D)|, not of dL/d(mean2D)
};

constexpr int kBackRows = 32;  // candidates per gradient batch, whole vectors: they stay in the cache

// A Gaussian on the screen. With the whitened offset from its centre,
//   u = a dx + b dy,   v = c dy,   alpha = 2^(log2_opacity - u^2 - v^2):
// sums of squares have no cancellation in long thin splats, unlike the quadratic form.
struct alignas(64) Splat {
    float x, y;  // centre, pixels
    float a, b, c;
    float log2_opacity;
    float colour[3];
    float depth;
    float slope;             // -b / a: the ellipse's chord in row dy has its middle at slope dy
    float inv_a;             // and the half-length inv_a sqrt(reach - v^2)
    float reach;             // u^2 + v^2 <= reach is where alpha >= 1/255
    float rows_dy;           // dy of the ellipse's rightmost point; the leftmost's is its negative
    float depth_u, depth_v;  // change with u and v of the depth at which a pixel's ray peaks in the Gaussian
};
static_assert(sizeof(Splat) == 64, "one cache line");

// Tiles first..last-1 of a tile row.
struct Span {
    uint16_t first, last;
};

// Tiles that a splat touches, kept apart from the splat because binning reads this in random order.
struct Touched {
    uint32_t spans;            // index of its first span; it has one per tile row
    int32_t slots;             // index of its first slot; the next Gaussian's slots begin where these end
    uint16_t first_row, rows;  // tile rows; none if the Gaussian is not visible
};

// A frame's arrays, all owned by the driver.
struct FrameData {
    const int32_t* rows;  // (candidates): their Gaussians, ascending
    Splat* splats;        // (candidates); meaningful where visible
    uint32_t* keys;       // (candidates): bits of the depth, or kCulled
    Touched* touched;     // (candidates + 1)
    Span* spans;
    int64_t* tile_begin;  // (tiles + 1): each tile's pairs, near to far
    int32_t* pair_splat;  // (pairs): index of the splat
    int32_t* pair_slot;   // (pairs): where the pair's gradient goes
    uint8_t*
        pair_blocks;  // (pairs, mask_bytes): the blocks of pixels that a pair was blended into, in the kernels' format
    float* slots;     // (pairs, slot_floats); only for the backward pass
    int slot_floats;  // kDepthSlotFloats if depths have a gradient, else kSlotFloats
    float* transmittance;  // (tiles, 256): remaining behind everything
    int32_t* pixel_end;    // (tiles, 256): number of the tile's pairs that the pixel processed before it ended
};

// Images, row-major: (h, w, 3) and (h, w). All depths, or none (null).
struct Pictures {
    float *colour, *alpha, *depth_sum, *depth_square_sum, *median_depth;
};
// Gradients of the images; null for zero.
struct PictureGradients {
    const float *colour, *alpha, *depth_sum, *depth_square_sum;
};

struct ProjectKernels {
    // Appends the possibly visible Gaussians of begin..end-1 to `rows`; returns their number.
    int64_t (*find_candidates)(const View&, const Parameters&, int64_t begin, int64_t end, int32_t* rows);
    // Candidates begin..end-1: fills splats, keys, rows of touched, and radii and visible of the visible ones.
    void (*project)(const View&, const Parameters&, int64_t begin, int64_t end, const FrameData&, float* radii,
                    uint8_t* visible);
    // Writes the exact tiles that each splat touches in each tile row, to the spans from `first_span` on. Returns their
    // number; slots are counted from 0.
    int64_t (*find_spans)(const View&, int64_t begin, int64_t end, const FrameData&, int64_t first_span);
    // Sums the slots of candidates begin..end-1, at most kBackRows, and propagates them to the parameters: row by row
    // from the first row of `out`, which has room for whole vectors.
    void (*project_backward)(const View&, const Parameters&, int64_t begin, int64_t end, const FrameData&,
                             bool magnitudes, const ParameterGradients& out);
};

struct BlendKernels {
    void (*blend_tile)(const View&, const FrameData&, int tile, const Pictures&);
    // Writes every slot of the tile; magnitudes are zero if not requested.
    void (*blend_tile_backward)(const View&, const FrameData&, int tile, const PictureGradients&, bool magnitudes);
    // Pixels that the tile's pairs were blended into, summed over the pairs.
    int64_t (*count_contributions)(const View&, const FrameData&, int tile);
    int mask_bytes;  // of pair_blocks
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(splat::ProjectKernels, project_kernels)
SPLAT_DECLARE_KERNELS(splat::BlendKernels, blend_kernels)
