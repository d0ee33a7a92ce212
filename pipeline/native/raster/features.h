// Kernels that take activated values and plain features (compiled per ISA), and their driver (features_cpu.cpp). Plain
// structs, no std.
//
// What the line's own kernels (raster.h) do in one pass is done in steps here, each with its gradient: Gaussians are
// projected to the screen; spherical harmonics are evaluated; features of any number of channels are blended. Gradients
// are added to what the arrays hold, so that views can share them; rows that are not visible are left alone.
#pragma once

#include <stdint.h>

#include "base/isa.h"
#include "raster/raster.h"

namespace splat {

// Of a projection. rasterization.py says which values gsplat and the line have.
struct ProjectOptions {
    float far_z;
    float blur_px2;          // added to the variances on screen
    float plane_sigmas;      // skips Gaussians that reach the camera plane within so many deviations; 0: none
    float compensation_min;  // floor of det(Σ') / det(Σ' + blur)
    float radius_clip;       // skips Gaussians whose radii are at most this, pixels
};

// Contiguous rows.
struct ActivatedGaussians {
    int64_t count;
    const float *means, *quats, *scales, *opacities;
};
struct ActivatedGradients {
    float *means, *quats, *scales;
};

// Gaussians projected to one view; zeros where not visible.
struct Projected {
    float* means2d;        // (n, 2), pixels
    float* depths;         // (n): z of the centre
    float* covariances;    // (n, 3): xx, xy, yy of Σ', with the blur
    float* determinants;   // (n): of Σ', without the cancellation of xx yy - xy²
    float* compensations;  // (n): √(det Σ' / det(Σ' + blur)), floored; null if not wanted
    float* slants;         // (n, 2): covariances of the depth and the place on the screen; null if not wanted
    int32_t* radii;        // (n, 2): half the size of the box around alpha ≥ 1/255, whole pixels; 0 where not visible
};
// Gradients by the same; null for zero.
struct ProjectedGradients {
    const float *means2d, *depths, *covariances, *compensations, *slants;
};

struct ShRows {
    int64_t count;
    const float *means, *sh;  // (n, 3), (n, sh_count, 3)
    const int32_t* radii;     // (n, 2): rows with zeros are left out
};

// What is blended in one view; opacities with the compensation.
struct ScreenSplats {
    int64_t count;
    const float *means2d, *depths, *covariances, *determinants, *opacities;
    const float* features;  // (n, channels)
    const float* slants;    // null: the last channel is the same all over a splat
    const int32_t* radii;
};
struct ScreenGradients {
    float *means2d, *covariances, *opacities, *features;
    float* slants;      // null without slants
    float* magnitudes;  // (n, 2): sums of each pixel's |dL/d(means2d)|; null if not wanted
};

// How features are blended, and the arrays that the kernels of a tile share.
struct Features {
    int channels;
    float alpha_max, log2_alpha_max;
    const float* background;  // (channels); null for zeros
    const float* rows;        // (n, channels)
    bool slanted;
};

// Up to this many channels are stored in the splat itself, in place of `colour` and `depth`.
constexpr int kInlineChannels = 4;
constexpr int kInlineAt = 6;  // of Splat's floats, the first of them

// A pair's gradients: s, su, sv, suu, suv, svv and two magnitudes; two slants and padding; the channels, padded.
constexpr int kMomentFloats = 8, kSlantFloats = 4;
static constexpr int feature_slot_floats(int channels, bool slanted) {
    return kMomentFloats + (slanted ? kSlantFloats : 0) + (channels + 3) / 4 * 4;
}

// Floats of scratch memory that blending a tile needs, aligned to a cache line.
static constexpr int64_t feature_scratch_floats(int channels) { return int64_t{channels} * (kTilePixels + kTile); }

struct FeaturePictures {
    float *features, *alpha;  // (h, w, channels), (h, w)
};
struct FeaturePictureGradients {
    const float *features, *alpha;  // null for zero
};

struct FeatureKernels {
    // Rows begin..end-1 of all.
    void (*project)(const View&, const ProjectOptions&, const ActivatedGaussians&, int64_t begin, int64_t end,
                    const Projected& out);
    void (*project_backward)(const View&, const ProjectOptions&, const ActivatedGaussians&, int64_t begin, int64_t end,
                             const int32_t* radii, const ProjectedGradients& in, const ActivatedGradients& out);
    // Colours (n, 3) clamped at 0; zeros where not visible.
    void (*colours)(const View&, const ShRows&, int64_t begin, int64_t end, float* out);
    void (*colours_backward)(const View&, const ShRows&, int64_t begin, int64_t end, const float* gradients,
                             float* means, float* sh);
    // Fills splats, keys and touched rows.
    void (*place)(const View&, const Features&, const ScreenSplats&, int64_t begin, int64_t end, const FrameData&);
    // Sums the slots of splats begin..end-1.
    void (*finish)(const Features&, const ScreenSplats&, int64_t begin, int64_t end, const FrameData&,
                   const ScreenGradients& out);
};

struct FeatureBlendKernels {
    void (*blend_tile)(const View&, const FrameData&, const Features&, int tile, const FeaturePictures&,
                       float* scratch);
    // Writes every slot of the tile; magnitudes are zero if not requested.
    void (*blend_tile_backward)(const View&, const FrameData&, const Features&, int tile,
                                const FeaturePictureGradients&, bool magnitudes, float* scratch);
    int mask_bytes;  // of pair_blocks
};

}  // namespace splat

SPLAT_DECLARE_KERNELS(splat::FeatureKernels, feature_kernels)
SPLAT_DECLARE_KERNELS(splat::FeatureBlendKernels, feature_blend_kernels)
