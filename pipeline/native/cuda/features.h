// A frame of features: what its kernels share besides the lists of frame.h.
//
// Channels are blended in groups, each by a walk of its own along the tiles' lists. The first group's backward pass
// also finds the moments, for which it reads all channels; those of the others sum only their channels. Sums are in
// order of the tiles, as frame.h describes, so that results have the same bits for every capacity and number of passes.
#pragma once

#include "cuda/frame.h"
#include "raster/features.h"

namespace splat {
namespace cuda {

// Channels of a group: up to kInlineChannels are in the record, in place of `red` to `depth`; of more, `red` has the
// bits of the splat's row in the features, which have their own memory.
constexpr int kWideChannels = 16;

struct ChannelGroup {
    int first, count;
};

// A splat's sums: the moments of features_math.h, with that of the last channel (of slanted splats), padded.
constexpr int kLastAt = 8, kSlantAt = 9, kSumFloats = 12;

// Everything that the kernels of features get besides a Job, by value.
struct FeatureJob {
    ScreenSplats splats;
    int channels, stride;  // floats from row to row of the features
    float alpha_max, log2_alpha_max;
    const float* background;  // (channels); null for zeros
    FeaturePictures pictures;
    FeaturePictureGradients by;  // features by planes, (channels, h, w)
    int64_t pixels;              // of a plane
    float* slots;                // (capacity, values of the group) of the current chunk
    float* sums;                 // (n, kSumFloats)
    ScreenGradients out;
};

}  // namespace cuda
}  // namespace splat
