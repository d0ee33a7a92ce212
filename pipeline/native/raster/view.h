// From a shot, as callers on any device describe it, to the view in the kernels' precision. Not for kernel files.
#pragma once

#include "raster/raster.h"
#include "raster/shot.h"

namespace splat {

constexpr int kMaxPixels = 65536;  // along a side: tiles are counted in 16 bits
constexpr int kMaxShDegree = 3;
constexpr int kMaxShCount = (kMaxShDegree + 1) * (kMaxShDegree + 1);

// Null, or the name of the invalid argument.
inline const char* find_view(const SplatShot& shot, View* view) {
    if (shot.width < 1 || shot.height < 1 || shot.width > kMaxPixels || shot.height > kMaxPixels) return "size";
    if (shot.left < 0 || shot.top < 0 || shot.whole_width - shot.left < shot.width ||
        shot.whole_height - shot.top < shot.height)
        return "window";
    const int degree = shot.sh_degree;
    if (degree < 0 || degree > kMaxShDegree || shot.sh_count > kMaxShCount ||
        (degree + 1) * (degree + 1) > shot.sh_count)
        return "sh_degree";
    view->width = shot.width, view->height = shot.height;
    view->tiles_x = (shot.width + kTile - 1) / kTile, view->tiles_y = (shot.height + kTile - 1) / kTile;
    view->fx = static_cast<float>(shot.fx), view->fy = static_cast<float>(shot.fy);
    view->cx = static_cast<float>(shot.cx), view->cy = static_cast<float>(shot.cy);
    const double* pose = shot.cam_from_world;
    for (int row = 0; row < 3; ++row) {
        double centre = 0.0;
        for (int column = 0; column < 3; ++column) {
            view->rotation[3 * row + column] = static_cast<float>(pose[4 * row + column]);
            centre -= pose[4 * column + row] * pose[4 * column + 3];
        }
        view->translation[row] = static_cast<float>(pose[4 * row + 3]);
        view->centre[row] = static_cast<float>(centre);
    }
    // Uses the whole image, so that a window renders exactly as in the whole.
    const double cx = shot.cx + shot.left, cy = shot.cy + shot.top;
    const double margin_x = kFrustumMargin * 0.5 * shot.whole_width,
                 margin_y = kFrustumMargin * 0.5 * shot.whole_height;
    view->ratio_min[0] = static_cast<float>(-(cx + margin_x) / shot.fx);
    view->ratio_max[0] = static_cast<float>((shot.whole_width - cx + margin_x) / shot.fx);
    view->ratio_min[1] = static_cast<float>(-(cy + margin_y) / shot.fy);
    view->ratio_max[1] = static_cast<float>((shot.whole_height - cy + margin_y) / shot.fy);
    view->near_z = static_cast<float>(shot.near_z), view->depth_origin = static_cast<float>(shot.depth_origin);
    for (int c = 0; c < 3; ++c) view->background[c] = static_cast<float>(shot.background[c]);
    view->sh_degree = degree, view->sh_count = shot.sh_count;
    view->antialias = shot.antialias != 0;
    return nullptr;
}

}  // namespace splat
