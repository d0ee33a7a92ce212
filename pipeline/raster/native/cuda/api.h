/* The CUDA backend as plain C: raw pointers into device memory, sizes, and the caller's stream.
 *
 * No torch, no C++ and no CUDA header in here, so that one binary serves every version of torch. Nothing is allocated
 * and nothing waits for the device: the caller asks for sizes, brings the memory, and calls. Everything runs in order
 * on the stream; pointers are to device memory and structures to the host's. Arrays are contiguous rows of float32
 * unless they say otherwise. The formulas and their constants are those of raster.h and splat_math.h.
 *
 * Each call returns 0, a negative SPLAT_... code for an argument that makes no sense, or a positive cudaError_t. */
#ifndef SPLAT_CUDA_API_H
#define SPLAT_CUDA_API_H

#include <stdint.h>

#if defined(__cplusplus)
extern "C" {
#endif

#define SPLAT_CUDA_ABI 3 /* raised with every change of this file; the caller refuses another */
#define SPLAT_API __attribute__((visibility("default")))

enum {
    SPLAT_OK = 0,
    SPLAT_BAD_ARGUMENT = -1, /* a size, a count or a degree */
    SPLAT_TOO_LITTLE = -2,   /* memory than the size query asked for */
    SPLAT_NO_KERNEL = -3     /* for this device in this binary */
};

typedef void* SplatStream; /* cudaStream_t; null is the default one */

/* What there is. */
typedef struct {
    int32_t architecture; /* 10 * major + minor of the device */
    int32_t driver,
        runtime; /* CUDA versions, 1000 * major + 10 * minor: what the driver knows, what this was built with */
    int32_t multiprocessors;
    int64_t memory_bytes;
    char name[256];
} SplatDevice;

/* A camera and what to render. */
typedef struct {
    double cam_from_world[12]; /* rotation and translation, 3 x 4, row-major */
    double fx, fy, cx, cy;     /* pixels; the first pixel's centre is (0.5, 0.5) */
    double near_z, depth_origin;
    double background[3];
    int32_t width, height;
    int32_t left, top; /* of this in the whole picture that it is a part of; 0 where it is that itself */
    int32_t whole_width, whole_height;
    int32_t sh_degree; /* that counts */
    int32_t sh_count;  /* coefficients a channel that are stored */
    int32_t antialias;
    int32_t depths;     /* whether depths are rendered, and have gradients */
    int32_t magnitudes; /* whether means2d sums the pixels' absolute values */
    int32_t reserved;
} SplatShot;

/* Raw parameters: means (n, 3), log_scales (n, 3), quats (n, 4), opacity_logits (n), sh (n, sh_count, 3). */
typedef struct {
    float *means, *log_scales, *quats, *opacity_logits, *sh;
} SplatRows;

/* Pictures (h, w, 3) and (h, w). All depths, or none (null). */
typedef struct {
    float *colour, *alpha, *depth_sum, *depth_square_sum, *median_depth;
} SplatPictures;

/* Null for zero. */
typedef struct {
    const float *colour, *alpha, *depth_sum, *depth_square_sum;
} SplatPictureGradients;

/* Columns left to right - 1 of rows top to bottom - 1. */
typedef struct {
    int32_t left, top, right, bottom;
} SplatRectangle;

/* A frame's memory, the caller's. */
typedef struct {
    void* memory;       /* aligned to 256 bytes; holds what the backward pass wants from forward on */
    int64_t bytes;      /* at least splat_frame_bytes */
    void* back;         /* aligned to 256 bytes; for the backward pass alone, null without */
    int64_t back_bytes; /* at least splat_back_bytes */
    int64_t count;      /* Gaussians */
    int64_t capacity;   /* pairs of a Gaussian and a tile that it holds at a time, at least `count` */
    int32_t passes;     /* chunks of tiles that are worked off by the whole device, at least 1; where the view has more,
                           one block does the rest: the same bits, slowly */
    int32_t reserved;
} SplatFrame;

/* The first bytes of a frame's memory once forward has run; to be copied when it suits. */
typedef struct {
    int64_t pairs;   /* of a Gaussian and a tile, in all */
    int64_t visible; /* Gaussians */
    int64_t chunks;  /* that the pairs took at this capacity */
} SplatFrameFacts;

/* Adam's step fused with the backward pass of the projection. */
typedef struct {
    SplatRows values;         /* stepped in place: the rows that were rendered, but for opacity_logits' gain */
    SplatRows means, squares; /* moments, laid out alike */
    float rates[5];     /* of means, log_scales, quats, opacity_logits and sh's constant band; bias-corrected here */
    float rate_sh_rest; /* of sh's other bands */
    double beta1, beta2, epsilon;
    int64_t step;   /* counted from 1 */
    int32_t sparse; /* only visible rows are stepped; else all */
    int32_t reserved;
    float log_scale_min, log_scale_max; /* log_scales are clamped to these after the step */
    const float* logit_gain;            /* (n) d(rendered logit) / d(logit), null for 1 */
    const float* logits;                /* (n) as they were rendered, null for values.opacity_logits */
    int64_t* skipped; /* one number, added to: visible rows left out for gradients that are not finite */
} SplatStep;

/* Rows of several tensors stepped together, for what is trained beside the Gaussians. */
#define SPLAT_ADAM_TENSORS 8
typedef struct {
    int32_t tensors;
    int32_t widths[SPLAT_ADAM_TENSORS]; /* values a row */
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

/* A render and what is to be behind it, interpolated bilinearly from nodes `step` pixels apart, at most 8; the first is
 * at the first pixel, the last at the last one or outside. */
typedef struct {
    int32_t width, height;
    int32_t rows, columns, step; /* of the nodes */
    float background[3];         /* that the render has behind it */
    const float *colour, *alpha; /* the render, (h, w, 3) and (h, w) */
    const float* nodes;          /* (rows, columns, 3) */
    const float* elsewhere;      /* (rows, columns, 3): seen instead where `around` is zero; null for nowhere */
    const uint8_t* around;       /* (h, w), null without `elsewhere` */
    const uint8_t* mask;         /* (h, w): where the nodes have a gradient, null for nowhere */
} SplatSky;

SPLAT_API int32_t splat_abi(void);
SPLAT_API const char* splat_error(int32_t code);
SPLAT_API int32_t splat_device(int32_t device, SplatDevice* out); /* the current CUDA version and device; host only */

/* The rasterizer. */
SPLAT_API int64_t splat_frame_bytes(const SplatShot* shot, int64_t count, int64_t capacity);
SPLAT_API int64_t splat_back_bytes(const SplatShot* shot, int64_t count, int64_t capacity);
/* Renders. radii (n) and visible (n) uint8 are written whole. */
SPLAT_API int32_t splat_forward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                const SplatPictures* pictures, float* radii, uint8_t* visible, SplatStream stream);
/* From pictures to what each Gaussian has on the screen, kept in `back` for one of the next two. */
SPLAT_API int32_t splat_blend_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                       const SplatPictureGradients* gradients, SplatStream stream);
/* From there to the parameters: every row of `gradients` and of means2d (n, 2) is written. */
SPLAT_API int32_t splat_project_backward(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame,
                                         const SplatRows* gradients, float* means2d, SplatStream stream);
/* The same, and at once a step of Adam; no gradient is stored but means2d (n, 2), null where nobody asks. */
SPLAT_API int32_t splat_step(const SplatShot* shot, const SplatFrame* frame, const SplatStep* step, float* means2d,
                             SplatStream stream);

/* Loss: (1 - w) L1 + w (1 - SSIM) of (h, w, 3) pictures, masked where `mask` (h, w) uint8 is zero, null for nowhere. Of
 * what is not masked the pixels of `inner` count, null for all; windows look at everything. Its gradient by the render,
 * and its value to one double. */
SPLAT_API int64_t splat_loss_bytes(int32_t width, int32_t height);
SPLAT_API int32_t splat_photo_loss(const float* render, const float* photo, const uint8_t* mask, int32_t width,
                                   int32_t height, const SplatRectangle* inner, double ssim_weight, float* gradient,
                                   double* value, void* memory, int64_t bytes, SplatStream stream);

/* Colours of `pixels` pixels through a (3, 4) affine map, and back: by the picture and, to map_gradient (3, 4), by it.
 */
SPLAT_API int64_t splat_affine_bytes(int64_t pixels);
SPLAT_API int32_t splat_affine_colour(const float* map, const float* in, int64_t pixels, float* out,
                                      SplatStream stream);
SPLAT_API int32_t splat_affine_colour_backward(const float* map, const float* in, const float* upstream, int64_t pixels,
                                               float* gradient, float* map_gradient, void* memory, int64_t bytes,
                                               SplatStream stream);

/* The render (h, w, 3) with the sky behind it, and the gradients by its alpha and by the nodes (null: not asked for);
 * that by its colour is `upstream`. */
SPLAT_API int32_t splat_sky(const SplatSky* sky, float* out, SplatStream stream);
SPLAT_API int32_t splat_sky_backward(const SplatSky* sky, const float* upstream, float* alpha_gradient,
                                     float* node_gradient, SplatStream stream);

SPLAT_API int32_t splat_adam(const SplatAdam* adam, SplatStream stream);

/* Density control. Random numbers are those of train/draws.py. */
SPLAT_API int32_t splat_uniform(uint64_t seed, uint64_t step, uint64_t stream_of_use, int64_t count, double* out,
                                SplatStream stream);
/* Two places within each parent, relative to its mean, (2 k, 3): the first of all, then the second of all. */
SPLAT_API int32_t splat_split_offsets(uint64_t seed, uint64_t step, uint64_t stream_of_use, const int64_t* rows,
                                      int64_t count, const float* log_scales, const float* quats, float* out,
                                      SplatStream stream);
/* Places on a Morton curve through the box from `lowest` with sides of `size` (three floats on the host each). */
SPLAT_API int32_t splat_morton(const float* means, int64_t count, const float* lowest, const float* size, int64_t* keys,
                               SplatStream stream);

#if defined(__cplusplus)
}
#endif
#endif
