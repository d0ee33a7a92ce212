// Applying an affine map to a whole image's colours: threads around the kernels. Not for kernel files.
#pragma once

#include <cstdint>

namespace splat {

// Applies a (3, 4) map to a (pixels, 3) image.
void affine_colour(const float* map, const float* in, std::int64_t pixels, float* out);

// dL/d(in) and, (3, 4), dL/d(map) from dL/d(out); the same bits for any number of threads.
void affine_colour_backward(const float* map, const float* in, const float* upstream, std::int64_t pixels,
                            float* gradient, double* map_gradient);

}  // namespace splat
