/* The CUDA backend as plain C: raw pointers into device memory, sizes, and the caller's stream.
 *
 * No torch, no C++ and no CUDA header in here, so that one binary serves every version of torch. Nothing is allocated
 * and nothing synchronizes: the caller queries sizes, provides the memory, and calls. Everything runs in order on the
 * stream; array pointers are to device memory, structures are on the host. Arrays are contiguous rows of float32 unless
 * stated otherwise. The formulas and their constants are those of raster.h and splat_math.h.
 *
 * Each call returns 0, a negative SPLAT_... code for an invalid argument, or a positive cudaError_t. */
#ifndef SPLAT_CUDA_API_H
#define SPLAT_CUDA_API_H

#include <stdint.h>

#include "raster/shot.h"

#if defined(__cplusplus)
extern "C" {
#endif

#define SPLAT_CUDA_ABI 5 /* raised with every change of the interface; the caller rejects other versions */
#define SPLAT_API __attribute__((visibility("default")))

enum {
    SPLAT_OK = 0,
    SPLAT_BAD_ARGUMENT = -1, /* invalid size, count or degree */
    SPLAT_TOO_LITTLE = -2,   /* less memory than the size query returned */
    SPLAT_NO_KERNEL = -3     /* this binary has no kernel for the device */
};

/* Where a call's kernels run; a null pointer is the default stream of the calling thread's current device. The device
 * stays the thread's current one for this library. */
typedef struct {
    void* stream; /* cudaStream_t, null for the default one */
    int32_t device;
    int32_t reserved;
} SplatStream;

/* The device and the versions. */
typedef struct {
    int32_t architecture;    /* 10 * major + minor of the device */
    int32_t driver, runtime; /* CUDA versions, 1000 * major + 10 * minor: supported by the driver, and built with */
    int32_t multiprocessors;
    int64_t memory_bytes;
    char name[256];
} SplatDevice;

/* Raw parameters: means (n, 3), log_scales (n, 3), quats (n, 4), opacity_logits (n), sh (n, sh_count, 3). */
typedef struct {
    float *means, *log_scales, *quats, *opacity_logits, *sh;
} SplatRows;

/* Images (h, w, 3) and (h, w). All depths, or none (null). */
typedef struct {
    float *colour, *alpha, *depth_sum, *depth_square_sum, *median_depth;
} SplatPictures;

/* Gradients of the images; null for zero. */
typedef struct {
    const float *colour, *alpha, *depth_sum, *depth_square_sum;
} SplatPictureGradients;

/* Columns left to right - 1, rows top to bottom - 1. */
typedef struct {
    int32_t left, top, right, bottom;
} SplatRectangle;

/* A frame's memory, owned by the caller. */
typedef struct {
    void* memory;       /* aligned to 256 bytes; must stay until the backward pass is done */
    int64_t bytes;      /* at least splat_frame_bytes */
    void* back;         /* aligned to 256 bytes; only for the backward pass, otherwise null */
    int64_t back_bytes; /* at least splat_back_bytes */
    int64_t count;      /* number of Gaussians */
    int64_t capacity;   /* Gaussian-tile pairs held at a time, at least `count` */
    int32_t passes;     /* chunks of tiles forecast, at least 1; if the view has more, one more launch does the rest:
                               the same bits, a little slower */
    int32_t reserved;
} SplatFrame;

/* The first bytes of a frame's memory after forward; may be copied at any time. */
typedef struct {
    int64_t pairs;   /* total Gaussian-tile pairs */
    int64_t visible; /* visible Gaussians */
    int64_t chunks;  /* chunks that the pairs took at this capacity */
} SplatFrameFacts;

/* A step of Adam fused with the backward pass of the projection. */
typedef struct {
    SplatRows values;         /* the rendered rows, except for opacity_logits' gain; stepped in place */
    SplatRows means, squares; /* moments (rows), in the same layout */
    int64_t rows;             /* the first of the rendered rows; the others are left as they are */
    float rates[5];           /* of means, log_scales, quats, opacity_logits and SH degree 0; bias-corrected here */
    float rate_sh_rest;       /* of the higher SH degrees */
    double beta1, beta2, epsilon;
    int64_t step;   /* counted from 1 */
    int32_t sparse; /* only the visible of these rows are stepped; else all */
    int32_t reserved;
    float log_scale_min, log_scale_max; /* log_scales are clamped to these after the step */
    const float* logit_gain;            /* (rows) d(rendered logit) / d(logit), null for 1 */
    const float* logits;                /* (n) as rendered, null for values.opacity_logits */
    int64_t* skipped;                   /* counter, added to: visible rows skipped for non-finite gradients */
} SplatStep;

/* Rows of several tensors stepped together, for the side models. */
#define SPLAT_ADAM_TENSORS 8
typedef struct {
    int32_t tensors;
    int32_t widths[SPLAT_ADAM_TENSORS]; /* values per row */
    float* values[SPLAT_ADAM_TENSORS];
    const float* gradients[SPLAT_ADAM_TENSORS];
    float* means[SPLAT_ADAM_TENSORS];
    float* squares[SPLAT_ADAM_TENSORS];
    const float* rates[SPLAT_ADAM_TENSORS]; /* (width) of each */
    int64_t rows;
    const uint8_t* visible; /* (rows), null for all */
    double beta1, beta2, epsilon;
    int64_t step;
    int64_t* skipped;
} SplatAdam;

/* A render and the layer behind it, interpolated bilinearly from nodes `step` pixels apart, at most 8; the first node
 * is at the first pixel, the last at or beyond the last pixel. */
typedef struct {
    int32_t width, height;
    int32_t rows, columns, step; /* numbers of nodes, and their spacing */
    float background[3];         /* background of the render */
    const float *colour, *alpha; /* the render, (h, w, 3) and (h, w) */
    const float* nodes;          /* (rows, columns, 3) */
    const float* elsewhere;      /* (rows, columns, 3): used instead where `around` is zero; null for nowhere */
    const uint8_t* around;       /* (h, w), null without `elsewhere` */
    const uint8_t* mask;         /* (h, w): where the nodes have a gradient, null for nowhere */
} SplatSky;

/* Activated Gaussians; scales of either sign. The next structures are those of raster/features.h. */
typedef struct {
    int64_t count;
    const float *means, *quats, *scales, *opacities;
} SplatActivated;

typedef struct {
    float *means, *quats, *scales;
} SplatActivatedGradients;

typedef struct {
    float far_z, blur_px2, plane_sigmas, compensation_min, radius_clip;
    int32_t reserved;
} SplatProjectOptions;

/* Compensations and slants may be null. */
typedef struct {
    float *means2d, *depths, *covariances, *determinants, *compensations, *slants;
    int32_t* radii;
} SplatProjected;

/* Null for zero. */
typedef struct {
    const float *means2d, *depths, *covariances, *compensations, *slants;
} SplatProjectedGradients;

typedef struct {
    int64_t count;
    const float *means, *sh;
    const int32_t* radii;
    double centre[3]; /* of projection, world: the inverse pose's translation, also of a pose that scales */
} SplatShRows;

/* What is blended in one view. */
typedef struct {
    const float *means2d, *depths, *covariances, *determinants, *opacities;
    const float* slants; /* null: the last channel is the same all over a splat */
    const int32_t* radii;
    const float* features;   /* (n, stride): the channels, then zeros */
    const float* background; /* (channels), null for zeros */
    int32_t channels;
    int32_t stride; /* up to SPLAT_INLINE_CHANNELS the number of channels; of more, that rounded up to a multiple of
                       four, of rows aligned to 16 bytes */
    float alpha_max;
    int32_t reserved;
} SplatFeatures;
#define SPLAT_INLINE_CHANNELS 4

/* (h, w, channels) and (h, w). */
typedef struct {
    float *features, *alpha;
} SplatFeaturePictures;

/* (channels, h, w), so that neighbouring threads read neighbouring values, and (h, w). Null for zero. */
typedef struct {
    const float *features, *alpha;
} SplatFeaturePictureGradients;

typedef struct {
    float *means2d, *covariances, *opacities;
    float* features;   /* (n, channels) */
    float* slants;     /* null without slants */
    float* magnitudes; /* (n, 2): sums of each pixel's |dL/d(means2d)|; null if not needed */
} SplatFeatureGradients;

SPLAT_API int32_t splat_abi(void);
SPLAT_API const char* splat_error(int32_t code);
SPLAT_API int32_t splat_device(int32_t device, SplatDevice* out); /* the current CUDA version and device; host only */

/* The rasterizer. */
SPLAT_API int64_t splat_frame_bytes(const SplatShot* shot, int64_t count, int64_t capacity);
SPLAT_API int64_t splat_back_bytes(const SplatShot* shot, int64_t count, int64_t capacity);
/* Renders. radii (n) and visible (n) uint8 are written whole. */
SPLAT_API int32_t splat_forward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                const SplatPictures* pictures, float* radii, uint8_t* visible, const SplatStream* on);
/* From images to each Gaussian's screen-space gradients, kept in `back` for one of the next two calls. */
SPLAT_API int32_t splat_blend_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                       const SplatPictureGradients* gradients, const SplatStream* on);
/* From there to the parameters: writes every row of `gradients` and of means2d (n, 2). */
SPLAT_API int32_t splat_project_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                         const SplatRows* gradients, float* means2d, const SplatStream* on);
/* The same, fused with a step of Adam; stores no gradient except means2d (rows, 2), null if not needed. */
SPLAT_API int32_t splat_step(const SplatShot* shot, const SplatFrame* frame, const SplatStep* step, float* means2d,
                             const SplatStream* on);

/* Activated Gaussians and features of any number of channels, in steps: projection, spherical harmonics, blending. Of
 * the shot, only what the step needs is read. Backward passes add to what the arrays hold, so that views can share
 * them, and leave rows alone that are not visible. */
SPLAT_API int32_t splat_project_activated(const SplatShot* shot, const SplatProjectOptions* options,
                                          const SplatActivated* gaussians, const SplatProjected* out,
                                          const SplatStream* on);
SPLAT_API int32_t splat_project_activated_backward(const SplatShot* shot, const SplatProjectOptions* options,
                                                   const SplatActivated* gaussians, const int32_t* radii,
                                                   const SplatProjectedGradients* gradients,
                                                   const SplatActivatedGradients* out, const SplatStream* on);
/* Colours (n, 3), clamped at 0; zeros where not visible. */
SPLAT_API int32_t splat_sh_colours(const SplatShot* shot, const SplatShRows* rows, float* out, const SplatStream* on);
SPLAT_API int32_t splat_sh_colours_backward(const SplatShot* shot, const SplatShRows* rows, const float* gradients,
                                            float* means, float* sh, const SplatStream* on);
/* A frame as of splat_forward, with memory of splat_frame_bytes; back_bytes at least splat_feature_back_bytes. */
SPLAT_API int64_t splat_feature_back_bytes(const SplatShot* shot, int64_t count, int64_t capacity, int32_t channels);
SPLAT_API int32_t splat_blend_features(const SplatShot* shot, const SplatFeatures* features, const SplatFrame* frame,
                                       const SplatFeaturePictures* pictures, const SplatStream* on);
SPLAT_API int32_t splat_blend_features_backward(const SplatShot* shot, const SplatFeatures* features,
                                                const SplatFrame* frame, const SplatFeaturePictureGradients* gradients,
                                                const SplatFeatureGradients* out, const SplatStream* on);

/* Loss: (1 - w) L1 + w (1 - SSIM) of (h, w, 3) images, masked where `mask` (h, w) uint8 is zero, null for nowhere. Of
 * the unmasked pixels those in `inner` count, null for all; SSIM windows see everything. Writes its gradient for the
 * render, and its value as one double. */
SPLAT_API int64_t splat_loss_bytes(int32_t width, int32_t height);
SPLAT_API int32_t splat_photo_loss(const float* render, const float* photo, const uint8_t* mask, int32_t width,
                                   int32_t height, const SplatRectangle* inner, double ssim_weight, float* gradient,
                                   double* value, void* memory, int64_t bytes, const SplatStream* on);

/* Applies a (3, 4) affine map to the colours of `pixels` pixels; backward for the image and, to map_gradient, the map.
 */
SPLAT_API int64_t splat_affine_bytes(int64_t pixels);
SPLAT_API int32_t splat_affine_colour(const float* map, const float* in, int64_t pixels, float* out,
                                      const SplatStream* on);
SPLAT_API int32_t splat_affine_colour_backward(const float* map, const float* in, const float* upstream, int64_t pixels,
                                               float* gradient, float* map_gradient, void* memory, int64_t bytes,
                                               const SplatStream* on);

/* The render (h, w, 3) over the sky, and the gradients for its alpha and for the nodes (null: not needed); that for its
 * colour is `upstream`. */
SPLAT_API int32_t splat_sky(const SplatSky* sky, float* out, const SplatStream* on);
SPLAT_API int32_t splat_sky_backward(const SplatSky* sky, const float* upstream, float* alpha_gradient,
                                     float* node_gradient, const SplatStream* on);

SPLAT_API int32_t splat_adam(const SplatAdam* adam, const SplatStream* on);

/* Density control. Random numbers are those of train/random_numbers.py. */
SPLAT_API int32_t splat_uniform(uint64_t seed, uint64_t step, uint64_t stream_of_use, int64_t count, double* out,
                                const SplatStream* on);
/* Two positions within each parent, relative to its mean, (2 k, 3): all first ones, then all second ones. */
SPLAT_API int32_t splat_split_offsets(uint64_t seed, uint64_t step, uint64_t stream_of_use, const int64_t* rows,
                                      int64_t count, const float* log_scales, const float* quats, float* out,
                                      const SplatStream* on);
/* Morton codes in the box from `lowest` with sides of `size` (three floats on the host each). */
SPLAT_API int32_t splat_morton(const float* means, int64_t count, const float* lowest, const float* size, int64_t* keys,
                               const SplatStream* on);

#if defined(__cplusplus)
}
#endif
#endif
