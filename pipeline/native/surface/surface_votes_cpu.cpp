// Pixels as small planes, and the cells that they cover. Compiled once per ISA: internal linkage, no std templates.
//
// Inverse depth is linear in a plane's pixels, w = n . (x, y, 1) for the plane n . X = 1; so its gradient in the
// picture is the plane's normal in the camera.
#include "base/simd.h"
#include "surface/surface_votes.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kSamePixels = 10.0f;  // depths that differ by more than this many pixel widths are not one surface
constexpr double kSteepest = 3.0;     // rise over run; steeper is a wall, which has no single height at a place
constexpr double kCovered = 0.75;     // of a cell: pixels that are farther apart are divided
constexpr int kWidest = 4;            // cells from a pixel's centre to its edge; larger pixels are too coarse
constexpr int kBlock = kRowPadding;   // pixels at a time: their planes stay in the L1 cache
constexpr int kMostConfident = (1 << kConfidenceBits) - 1;
constexpr double kMostCover = (1 << kCoverBits) - 1;

// Planes of some pixels of a row.
struct Block {
    int first, count;
    uint8_t is_near[kBlock];                         // inside the tile and its range of heights
    float slope_x[kBlock], slope_y[kBlock];          // of the inverse depth, a pixel to the right and down; NaN: none
    double x[kBlock];                                // of the ray
    double east[kBlock], north[kBlock], up[kBlock];  // of the pixel's centre
    double rise_east[kBlock], rise_north[kBlock];    // of the plane
    double right_east[kBlock], right_north[kBlock];  // metres to the next pixel
    double down_east[kBlock], down_north[kBlock];
    int wide[kBlock], high[kBlock];  // parts that the pixel is divided into; 0: it is not used
};

// The camera's axes in the world, and a row's ray.
struct RowRay {
    double right[3], start[3], y;
};

RowRay row_ray(const HeightRow& job) {
    const SurfaceCamera& camera = job.picture.camera;
    RowRay ray;
    ray.y = (job.row + 0.5 - camera.cy) / camera.fy;
    for (int k = 0; k < 3; ++k) {
        ray.right[k] = camera.turn[k];
        ray.start[k] = camera.turn[3 + k] * ray.y + camera.turn[6 + k];
    }
    return ray;
}

void invert(const float* depth, int count, float* inverse) {
    for (int k = 0; k < count; ++k) inverse[k] = depth[k] > 0.0f ? 1.0f / depth[k] : __builtin_nanf("");
}

// Positions of the block's pixels; false if none is near the tile.
bool place(const HeightRow& job, const RowRay& ray, Block* block) {
    const SurfaceCamera& camera = job.picture.camera;
    const CellTile& tile = job.tile;
    const float* depth = job.picture.depth + static_cast<int64_t>(job.row) * camera.width + block->first;
    const double west = tile.column - 2 * kWidest, far = tile.column + tile.width + 2 * kWidest;
    const double top = tile.row - 2 * kWidest, bottom = tile.row + tile.height + 2 * kWidest;
    const double per_pixel = 1.0 / camera.fx, per_cell = 1.0 / tile.cell;
    int near = 0;
    for (int k = 0; k < block->count; ++k) {
        const double x = (block->first + k + 0.5 - camera.cx) * per_pixel, z = depth[k];
        const double east = camera.centre[0] + (ray.right[0] * x + ray.start[0]) * z;
        const double north = camera.centre[1] + (ray.right[1] * x + ray.start[1]) * z;
        const double up = camera.centre[2] + (ray.right[2] * x + ray.start[2]) * z;
        const double across = (east - tile.east) * per_cell, down = (tile.north - north) * per_cell;
        const bool is_near = (z > 0.0) & (up >= tile.low) & (up < tile.high) & (across >= west) & (across < far) &
                             (down >= top) & (down < bottom);
        block->x[k] = x, block->east[k] = east, block->north[k] = north, block->up[k] = up;
        block->is_near[k] = is_near, near |= is_near;
    }
    return near != 0;
}

SPLAT_INLINE Floats size(Floats v) { return max(v, fill(0.0f) - v); }  // NaN stays

// Slope of inverse depths per pixel in a direction, by least squares over pairs of pixels on both sides that lie in one
// plane with it; one-sided at a surface's edge; NaN if there is no neighbour.
SPLAT_INLINE void slope(const HeightRow& job, const Block& block, float same, bool is_down, float* out) {
    const int offset = block.first - job.left + kSlopeReach;
    const auto row = [&](int down, int right) { return job.inverses[kSlopeReach + down] + offset + right; };
    for (int k = 0; k < kBlock; k += kLanes) {
        const Floats centre = load(row(0, 0) + k), near = centre * fill(same), twice = centre + centre;
        Floats total = fill(0.0f), weight = fill(0.0f);
        for (int along = 1; along <= 2; ++along) {
            const Floats step = fill(static_cast<float>(along)), steep = fill(2.0f) * step * near;
            for (int aside = -1; aside <= 1; ++aside) {
                const Floats ahead = load((is_down ? row(along, aside) : row(aside, along)) + k);
                const Floats behind = load((is_down ? row(-along, aside) : row(aside, -along)) + k);
                const Floats difference = ahead - behind;
                const Mask is_flat = both(less(size(ahead + behind - twice), near), less(size(difference), steep));
                total = total + only(is_flat, step * difference);
                weight = weight + only(is_flat, fill(2.0f) * step * step);
            }
        }
        const Floats onward = load((is_down ? row(1, 0) : row(0, 1)) + k) - centre;
        const Floats back = centre - load((is_down ? row(-1, 0) : row(0, -1)) + k);
        const Floats last = select(less(size(back), near), back, fill(__builtin_nanf("")));
        const Floats single = select(less(size(onward), near), onward, last);
        const Mask is_paired = less(fill(0.0f), weight);
        store(out + k, select(is_paired, total / select(is_paired, weight, fill(1.0f)), single));
    }
}

// The planes in the world, and the number of parts of each pixel.
void lay(const HeightRow& job, const RowRay& ray, Block* block) {
    const SurfaceCamera& camera = job.picture.camera;
    const double* turn = camera.turn;
    const float* inverse = job.inverses[kSlopeReach] + (block->first - job.left + kSlopeReach);
    const float* depth = job.picture.depth + static_cast<int64_t>(job.row) * camera.width + block->first;
    const double widest = 2 * kWidest * job.tile.cell, covered = kCovered * job.tile.cell;
    const double unit = 1.0 / (covered * covered), per_x = 1.0 / camera.fx, per_y = 1.0 / camera.fy;
    for (int k = 0; k < block->count; ++k) {
        const double w = inverse[k], z = depth[k], x = block->x[k];
        const double slope_x = block->slope_x[k], slope_y = block->slope_y[k];
        const double a = slope_x * camera.fx, b = slope_y * camera.fy, c = w - a * x - b * ray.y;
        const double n_east = turn[0] * a + turn[3] * b + turn[6] * c;
        const double n_north = turn[1] * a + turn[4] * b + turn[7] * c;
        const double n_up = turn[2] * a + turn[5] * b + turn[8] * c;
        const double ray_east = ray.right[0] * x + ray.start[0], ray_north = ray.right[1] * x + ray.start[1];
        const double right_east = (turn[0] * per_x - ray_east * slope_x * z) * z;
        const double right_north = (turn[1] * per_x - ray_north * slope_x * z) * z;
        const double down_east = (turn[3] * per_y - ray_east * slope_y * z) * z;
        const double down_north = (turn[4] * per_y - ray_north * slope_y * z) * z;
        // The normal looks away from the camera: down, where the plane is seen from above. NaN is not usable.
        const double level = kSteepest * n_up;
        const bool is_used = (block->is_near[k] != 0) & (n_up < 0.0) &
                             (n_east * n_east + n_north * n_north <= level * level) &
                             (__builtin_fabs(right_east) <= widest) & (__builtin_fabs(right_north) <= widest) &
                             (__builtin_fabs(down_east) <= widest) & (__builtin_fabs(down_north) <= widest);
        const double wide = (right_east * right_east + right_north * right_north) * unit;
        const double high = (down_east * down_east + down_north * down_north) * unit;
        block->rise_east[k] = -n_east / n_up, block->rise_north[k] = -n_north / n_up;
        block->right_east[k] = right_east, block->right_north[k] = right_north;
        block->down_east[k] = down_east, block->down_north[k] = down_north;
        block->wide[k] = is_used ? 1 + (wide > 1.0) + (wide > 4.0) + (wide > 9.0) : 0;
        block->high[k] = 1 + (high > 1.0) + (high > 4.0) + (high > 9.0);
    }
}
static_assert(kMostParts == 4, "as many squares as above");

SPLAT_INLINE int64_t floored(double value) {
    const int64_t whole = static_cast<int64_t>(value);
    return whole - (value < static_cast<double>(whole));
}

SPLAT_TABLE double kShare[kMostParts + 1] = {0.0, 1.0, 0.5, 1.0 / 3.0, 0.25};  // of one part, by the number of parts

// The keys of one pixel.
SPLAT_INLINE int64_t cover(const HeightRow& job, const Block& block, int k, uint64_t* keys) {
    const CellTile& tile = job.tile;
    const int wide = block.wide[k], high = block.high[k];
    const double per_cell = 1.0 / tile.cell, part_wide = kShare[wide], part_high = kShare[high];
    const double east = block.east[k], north = block.north[k];
    const double area =
        __builtin_fabs(block.right_east[k] * block.down_north[k] - block.right_north[k] * block.down_east[k]);
    const double share = kCoverUnit * area * (part_wide * part_high * per_cell * per_cell);
    const uint64_t covered = static_cast<uint64_t>(static_cast<int64_t>(share < 1.0          ? 1.0
                                                                        : share > kMostCover ? kMostCover
                                                                                             : share));
    const int64_t pixel = static_cast<int64_t>(job.row) * job.picture.camera.width + block.first + k;
    const int sure = job.picture.confidence[pixel];
    const uint64_t rest =
        covered << kConfidenceBits | static_cast<uint64_t>(sure < kMostConfident ? sure : kMostConfident);
    int64_t written = 0;
    for (int i = 0; i < wide; ++i) {
        const double right = (i + 0.5) * part_wide - 0.5;
        for (int j = 0; j < high; ++j) {
            const double down = (j + 0.5) * part_high - 0.5;
            const double off_east = block.right_east[k] * right + block.down_east[k] * down;
            const double off_north = block.right_north[k] * right + block.down_north[k] * down;
            const int64_t column = floored((east + off_east - tile.east) * per_cell);
            const int64_t row = floored((tile.north - (north + off_north)) * per_cell);
            const int64_t x = column - tile.column, y = row - tile.row;
            if (x < 0 || x >= tile.width || y < 0 || y >= tile.height) continue;
            const double to_east = tile.east + (static_cast<double>(column) + 0.5) * tile.cell - east;
            const double to_north = tile.north - (static_cast<double>(row) + 0.5) * tile.cell - north;
            const double height = block.up[k] + block.rise_east[k] * to_east + block.rise_north[k] * to_north;
            if (!(height >= tile.low && height < tile.high)) continue;
            const uint64_t steps = static_cast<uint64_t>(static_cast<int64_t>((height - tile.low) / kHeightStep));
            const uint64_t cell = static_cast<uint64_t>(y * tile.width + x);
            keys[written++] = (cell << kStepBits | steps) << (kCoverBits + kConfidenceBits) | rest;
        }
    }
    return written;
}

int64_t heights(const HeightRow& job, uint64_t* keys) {
    const SurfaceCamera& camera = job.picture.camera;
    const RowRay ray = row_ray(job);
    const float same = kSamePixels / static_cast<float>(camera.fx > camera.fy ? camera.fx : camera.fy);
    int64_t written = 0;
    for (int first = job.left; first < job.right; first += kBlock) {
        Block block;
        block.first = first, block.count = job.right - first < kBlock ? job.right - first : kBlock;
        if (!place(job, ray, &block)) continue;
        slope(job, block, same, false, block.slope_x);
        slope(job, block, same, true, block.slope_y);
        lay(job, ray, &block);
        for (int k = 0; k < block.count; ++k)
            if (block.wide[k]) written += cover(job, block, k, keys + written);
    }
    return written;
}

}  // namespace

extern const VoteKernels vote_kernels = {invert, heights};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
