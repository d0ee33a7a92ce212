/* A shot as callers on any device describe it. Plain C: part of the interface in cuda/api.h. */
#ifndef SPLAT_SHOT_H
#define SPLAT_SHOT_H

#include <stdint.h>

/* A camera and render settings. */
typedef struct {
    double cam_from_world[12]; /* rotation and translation, 3 x 4, row-major */
    double fx, fy, cx, cy;     /* pixels; the first pixel's centre is (0.5, 0.5) */
    double near_z, depth_origin;
    double background[3];
    int32_t width, height;
    int32_t left, top; /* position in the whole image if this is a window of it; otherwise 0 */
    int32_t whole_width, whole_height;
    int32_t sh_degree; /* degree used */
    int32_t sh_count;  /* coefficients stored per channel */
    int32_t antialias;
    int32_t depths;     /* whether depths are rendered and have gradients */
    int32_t magnitudes; /* whether means2d sums the pixels' absolute values */
    int32_t reserved;
} SplatShot;

#endif
