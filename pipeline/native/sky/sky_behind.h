// Compositing a whole render over the sky, forward and backward: threads around the kernels. Not for kernel files.
#pragma once

#include "sky/sky.h"

namespace splat {

// Whether a job is valid: its nodes reach the last pixel, and `elsewhere` comes with `around`.
bool is_sound(const SkyJob& job);

// Writes `out`, (height, width, 3).
void lay_over(const SkyJob& job, float* out);

// dL/d(alpha) and, unless null, dL/d(nodes) from dL/d(out); the same bits for any number of threads. dL/d(colour) is
// dL/d(out).
void lay_over_backward(const SkyJob& job, const float* upstream, float* alpha_gradient, float* node_gradient);

}  // namespace splat
