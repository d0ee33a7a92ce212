// An affine map of a whole picture's colours: threads around the kernels. Not for kernel files.
#pragma once

#include <cstdint>

namespace splat {

// A (pixels, 3) picture through a (3, 4) map.
void affine_colour(const float* map, const float* in, std::int64_t pixels, float* out);

// dL/d(in) and, (3, 4), dL/d(map) from dL/d(out); the same bits for any number of threads.
void affine_colour_backward(const float* map, const float* in, const float* upstream, std::int64_t pixels,
                            float* gradient, double* map_gradient);

}  // namespace splat
