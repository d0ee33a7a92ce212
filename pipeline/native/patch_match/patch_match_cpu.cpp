// Depths of a photo by PatchMatch. Compiled once per ISA: internal linkage, no std templates.
//
// Planes spread over a chessboard, from the best of eight places around a pixel (Xu and Tao, "Multi-Scale Geometric
// Consistency Guided Multi-View Stereo", CVPR 2019). A plane's cost is one minus the correlation of the pixel's
// neighbourhood with what a photo shows there, weighted by similarity and proximity to the pixel (Bleyer et al.,
// "PatchMatch Stereo", BMVC 2011); only the two most similar photos count, against occlusion.
#include "base/simd.h"
#include "patch_match/patch_match.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr int kSamples = 32;     // of a round window: 6 x 6, two pixels apart, without the corners
constexpr int kLooked = 4;       // number of photos in which a pixel's planes are tried: the most similar ones so far
constexpr int kBest = 2;         // number of photos whose costs count
constexpr int kNoView = 255;     // instead of a photo's index
constexpr float kUnlike = 1.2f;  // cost above which a photo is uninformative: it shows something else
constexpr float kNoise2 = 1.5f * 1.5f;  // variance of grey values: contrast below it does not count as similarity
constexpr float kPerGrey = 0.047f;      // of a weight's logarithm to base two
constexpr float kPerPixel2 = 0.028f;    // the same, by squared distance
constexpr float kNearest = 1e-6f;       // homogeneous coordinate: points nearer than this count as behind the camera
constexpr float kDepthShare = 0.25f;    // first change of an inverse depth, relative to it
constexpr float kSlopeShare = 2.0f;     // the same for a slope, relative to the inverse depth over the photo's width
constexpr float kFainter = 0.5f;        // factor on changes from one iteration to the next
constexpr float kSame = 1e-3f;          // of the inverse depth: planes closer than that everywhere in the window
constexpr float kReach = 6.0f;          // pixels from the middle to the window's sides
constexpr int kTries = 2;  // random changes of each kind: of the depth, of the slope, and small ones of both
constexpr int kFirstFar = 7, kLastFar = 23;  // distances along rows and columns, pixels; odd, so of the other colour

// Offsets of the samples from the pixel, to the right and down, pixels.
SPLAT_TABLE float kRight[kSamples] = {-3, -1, 1,  3, -5, -3, -1, 1,  3,  5, -5, -3, -1, 1,  3, 5,
                                      -5, -3, -1, 1, 3,  5,  -5, -3, -1, 1, 3,  5,  -3, -1, 1, 3};
SPLAT_TABLE float kDown[kSamples] = {-5, -5, -5, -5, -3, -3, -3, -3, -3, -3, -1, -1, -1, -1, -1, -1,
                                     1,  1,  1,  1,  1,  1,  3,  3,  3,  3,  3,  3,  5,  5,  5,  5};
// By direction: offsets of seven nearby pixels, all of the other colour.
SPLAT_TABLE int kNear[4][7][2] = {{{0, -1}, {-1, -2}, {1, -2}, {-2, -3}, {2, -3}, {0, -3}, {0, -5}},
                                  {{0, 1}, {-1, 2}, {1, 2}, {-2, 3}, {2, 3}, {0, 3}, {0, 5}},
                                  {{-1, 0}, {-2, -1}, {-2, 1}, {-3, -2}, {-3, 2}, {-3, 0}, {-5, 0}},
                                  {{1, 0}, {2, -1}, {2, 1}, {3, -2}, {3, 2}, {3, 0}, {5, 0}}};

SPLAT_INLINE int least_of(int a, int b) { return a < b ? a : b; }

SPLAT_INLINE uint32_t mixed(uint32_t x) {
    x ^= x >> 16, x *= 0x7feb352dU, x ^= x >> 15, x *= 0x846ca68bU;
    return x ^ (x >> 16);
}

// Random numbers determined by a pixel, an iteration and a seed.
struct Draws {
    uint32_t state;
    SPLAT_METHOD float next() {  // [0, 1)
        state = mixed(state + 0x9e3779b9U);
        return static_cast<float>(state >> 8) * (1.0f / 16777216.0f);
    }
    SPLAT_METHOD float either_side() { return 2.0f * next() - 1.0f; }
};

// A pixel's window: weights that sum to one, and the weights times the grey values' differences from the mean.
struct Window {
    float x, y;  // of the pixel's centre
    float weights[kSamples], centred[kSamples];
    float variance;
};

struct Plane {
    float inverse, across, down;
};

void open_window(const PatchJob& job, int column, int row, Window* window) {
    float values[kSamples], logs[kSamples];
    const float middle = job.grey[static_cast<int64_t>(row) * job.width + column];
    for (int k = 0; k < kSamples; ++k) {
        const int x = column + static_cast<int>(kRight[k]), y = row + static_cast<int>(kDown[k]);
        const bool is_in = x >= 0 && y >= 0 && x < job.width && y < job.height;
        const int64_t at = static_cast<int64_t>(y) * job.width + x;
        const bool counts = is_in && job.counts[at];
        values[k] = counts ? job.grey[at] : middle;
        const float unlike = values[k] > middle ? values[k] - middle : middle - values[k];
        const float away = kRight[k] * kRight[k] + kDown[k] * kDown[k];
        logs[k] = counts ? -kPerGrey * unlike - kPerPixel2 * away : -120.0f;
    }
    Floats sum = fill(0.0f), mean = fill(0.0f), spread = fill(0.0f), unused = fill(0.0f);
    for (int k = 0; k < kSamples; k += kLanes) {
        const Floats weight = exp2(load(logs + k));
        store(window->weights + k, weight);
        sum = sum + weight, mean = fma(weight, load(values + k), mean);
    }
    float sums[4];
    sum_lanes(sum, mean, unused, unused, sums);
    const float scale = 1.0f / (sums[0] > 1e-20f ? sums[0] : 1e-20f);
    const Floats centre = fill(sums[1] * scale);
    for (int k = 0; k < kSamples; k += kLanes) {
        const Floats weight = load(window->weights + k) * fill(scale), apart = load(values + k) - centre;
        store(window->weights + k, weight);
        store(window->centred + k, weight * apart);
        spread = fma(weight * apart, apart, spread);
    }
    window->x = static_cast<float>(column) + 0.5f, window->y = static_cast<float>(row) + 0.5f;
    window->variance = sum_lanes(spread);
}

// One minus the correlation, or kPatchWorst where the photo does not show the pixel.
float view_cost(const PatchView& view, const Window& window, const Plane& plane) {
    const float* turn = view.turn;
    const float rest = plane.inverse - plane.across * window.x - plane.down * window.y;
    float right[3], down[3], at[3];  // change of the homogeneous pixel per step, and the image of the centre
    for (int k = 0; k < 3; ++k) {
        right[k] = turn[3 * k] + view.shift[k] * plane.across;
        down[k] = turn[3 * k + 1] + view.shift[k] * plane.down;
        at[k] = right[k] * window.x + down[k] * window.y + (turn[3 * k + 2] + view.shift[k] * rest);
    }
    if (!(at[2] > kNearest)) return kPatchWorst;
    const float width = static_cast<float>(view.width), height = static_cast<float>(view.height);
    const float middle_x = at[0] / at[2], middle_y = at[1] / at[2];
    const bool is_in = middle_x > 1.0f && middle_y > 1.0f && middle_x < width - 1.0f && middle_y < height - 1.0f;
    if (!is_in || !view.counts[static_cast<int64_t>(middle_y) * view.width + static_cast<int64_t>(middle_x)])
        return kPatchWorst;
    Floats mean = fill(0.0f), square = fill(0.0f), together = fill(0.0f), unused = fill(0.0f);
    for (int k = 0; k < kSamples; k += kLanes) {
        const Floats dx = load(kRight + k), dy = load(kDown + k);
        const Floats scale = inverse(max(fma(fill(right[2]), dx, fma(fill(down[2]), dy, fill(at[2]))), fill(kNearest)));
        Floats x = fma(fma(fill(right[0]), dx, fma(fill(down[0]), dy, fill(at[0]))), scale, fill(-0.5f));
        Floats y = fma(fma(fill(right[1]), dx, fma(fill(down[1]), dy, fill(at[1]))), scale, fill(-0.5f));
        x = clamp(x, fill(0.0f), fill(width - 1.0f)), y = clamp(y, fill(0.0f), fill(height - 1.0f));
        const Floats left = floor(x), above = floor(y);
        Floats corner[4];
        gather_bytes(view.corners, left, above, view.width, corner);
        const Floats part_x = x - left, part_y = y - above;
        const Floats top = fma(part_x, corner[1] - corner[0], corner[0]);
        const Floats bottom = fma(part_x, corner[3] - corner[2], corner[2]);
        const Floats value = fma(part_y, bottom - top, top), weighted = load(window.weights + k) * value;
        mean = mean + weighted, square = fma(weighted, value, square);
        together = fma(load(window.centred + k), value, together);
    }
    float sums[4];
    sum_lanes(mean, square, together, unused, sums);
    const float variance = sums[1] - sums[0] * sums[0];
    const float product = ((variance > 0.0f ? variance : 0.0f) + kNoise2) * (window.variance + kNoise2);
    return 1.0f - sums[2] / __builtin_sqrtf(product);
}

// The photos that a pixel is compared with, the most similar ones for its plane, as bytes of an integer; 255: none.
SPLAT_INLINE int chosen_view(uint32_t chosen, int k) { return static_cast<int>(chosen >> (8 * k) & 255U); }

float plane_cost(const PatchJob& job, const Window& window, const Plane& plane, uint32_t chosen) {
    if (!(plane.inverse >= job.least && plane.inverse <= job.most)) return kPatchWorst;
    float best[kBest + 1];
    for (float& each : best) each = kUnlike;
    for (int k = 0; k < kLooked; ++k) {
        const int view = chosen_view(chosen, k);
        if (view == kNoView) break;
        const float cost = view_cost(job.views[view], window, plane);
        int place = kBest;
        for (; place > 0 && best[place - 1] > cost; --place) best[place] = best[place - 1];
        best[place] = cost;
    }
    float sum = 0.0f;
    for (int k = 0; k < kBest; ++k) sum += best[k];
    return sum * (1.0f / kBest);
}

// The photos to compare with; the plane's cost in them is that of `plane_cost`, which is not computed twice.
uint32_t choose(const PatchJob& job, const Window& window, const Plane& plane, float* cost) {
    float costs[kLooked + 1];
    int views[kLooked + 1], count = 0;
    for (int k = 0; k < job.view_count; ++k) {
        const float found = view_cost(job.views[k], window, plane);
        int place = least_of(count, kLooked - 1);
        if (count == kLooked && costs[place] <= found) continue;
        for (; place > 0 && costs[place - 1] > found; --place)
            costs[place] = costs[place - 1], views[place] = views[place - 1];
        costs[place] = found, views[place] = k;
        count = least_of(count + 1, kLooked);
    }
    float sum = 0.0f;
    for (int k = 0; k < kBest; ++k) sum += k < count && costs[k] < kUnlike ? costs[k] : kUnlike;
    *cost = sum * (1.0f / kBest);
    uint32_t chosen = 0;
    for (int k = 0; k < kLooked; ++k) chosen |= static_cast<uint32_t>(k < count ? views[k] : kNoView) << (8 * k);
    return chosen;
}

// A pixel being processed: the best plane so far.
struct Pixel {
    const PatchJob& job;
    const Window& window;
    uint32_t chosen;  // the photos in which planes are tried
    Plane plane;
    float cost;

    SPLAT_METHOD void attempt(const Plane& other) {
        const float found = plane_cost(job, window, other, chosen);
        if (found < cost) cost = found, plane = other;
    }
    // The plane of another pixel, evaluated here; -1: none.
    SPLAT_METHOD void attempt_of(int64_t other, float right, float down) {
        const int64_t size = static_cast<int64_t>(job.width) * job.height;
        if (other < 0) return;
        const float across = job.planes[size + other], along = job.planes[2 * size + other];
        const float inverse = job.planes[other] - across * right - along * down;
        const float apart = __builtin_fabsf(inverse - plane.inverse);
        const float turned = __builtin_fabsf(across - plane.across) + __builtin_fabsf(along - plane.down);
        if (apart + kReach * turned > kSame * plane.inverse) attempt({inverse, across, along});
    }
};

void take_from_neighbours(const PatchJob& job, int column, int row, Pixel* pixel) {
    constexpr int kStep[4][2] = {{0, -1}, {0, 1}, {-1, 0}, {1, 0}};
    for (int direction = 0; direction < 4; ++direction) {
        for (int is_far = 0; is_far < 2; ++is_far) {
            const int count = is_far ? (kLastFar - kFirstFar) / 2 + 1 : 7;
            float least = kPatchWorst;
            int64_t found = -1;
            int right = 0, down = 0;
            for (int k = 0; k < count; ++k) {
                const int away = kFirstFar + 2 * k;
                const int dx = is_far ? away * kStep[direction][0] : kNear[direction][k][0];
                const int dy = is_far ? away * kStep[direction][1] : kNear[direction][k][1];
                const int x = column + dx, y = row + dy;
                if (x < 0 || y < 0 || x >= job.width || y >= job.height) continue;
                const int64_t at = static_cast<int64_t>(y) * job.width + x;
                if (job.costs[at] < least) least = job.costs[at], found = at, right = dx, down = dy;
            }
            pixel->attempt_of(found, static_cast<float>(right), static_cast<float>(down));
        }
    }
}

void change_a_little(const PatchJob& job, int iteration, Draws* draws, Pixel* pixel) {
    float range = kDepthShare, slope = kSlopeShare / static_cast<float>(job.width);
    for (int k = 0; k < job.begun + iteration; ++k) range *= kFainter, slope *= kFainter;
    for (int k = 0; k < kTries; ++k) {
        const Plane one = pixel->plane;
        pixel->attempt({one.inverse * (1.0f + range * draws->either_side()), one.across, one.down});
        const Plane two = pixel->plane;
        const float steep = slope * two.inverse;
        const float across = two.across + steep * draws->either_side();
        pixel->attempt({two.inverse, across, two.down + 2.0f * steep * draws->either_side()});
        range *= 0.2f, slope *= 0.3f;
        const Plane all = pixel->plane;
        const float inverse = all.inverse * (1.0f + range * draws->either_side());
        const float right = all.across + slope * all.inverse * draws->either_side();
        pixel->attempt({inverse, right, all.down + slope * all.inverse * draws->either_side()});
    }
}

void begin(const PatchJob& job, int row) {
    const int64_t size = static_cast<int64_t>(job.width) * job.height;
    for (int column = 0; column < job.width; ++column) {
        const int64_t at = static_cast<int64_t>(row) * job.width + column;
        if (!job.counts[at]) {
            for (int k = 0; k < 3; ++k) job.planes[k * size + at] = 0.0f;
            job.costs[at] = kPatchWorst;
            continue;
        }
        const float slopes = job.planes[size + at] + job.planes[2 * size + at];
        const bool is_plane = slopes - slopes == 0.0f;  // not infinite, not NaN
        if (!is_plane || !(job.planes[at] >= job.least && job.planes[at] <= job.most)) {
            Draws draws{mixed(job.seed) ^ mixed(static_cast<uint32_t>(at))};
            const float inverse = job.least + (job.most - job.least) * draws.next();
            const float steep = kSlopeShare * inverse / static_cast<float>(job.width);
            job.planes[at] = inverse;
            job.planes[size + at] = steep * draws.either_side();
            job.planes[2 * size + at] = 2.0f * steep * draws.either_side();
        }
        Window window;
        open_window(job, column, row, &window);
        const Plane plane{job.planes[at], job.planes[size + at], job.planes[2 * size + at]};
        job.chosen[at] = choose(job, window, plane, &job.costs[at]);
    }
}

void improve(const PatchJob& job, int row, int colour, int iteration) {
    const int64_t size = static_cast<int64_t>(job.width) * job.height;
    for (int column = (row + colour) & 1; column < job.width; column += 2) {
        const int64_t at = static_cast<int64_t>(row) * job.width + column;
        if (!job.counts[at]) continue;
        Window window;
        open_window(job, column, row, &window);
        const Plane plane{job.planes[at], job.planes[size + at], job.planes[2 * size + at]};
        float cost = job.costs[at];
        const uint32_t chosen = iteration ? choose(job, window, plane, &cost) : job.chosen[at];
        Pixel pixel{job, window, chosen, plane, job.costs[at]};
        take_from_neighbours(job, column, row, &pixel);
        Draws draws{mixed(job.seed + 1U + static_cast<uint32_t>(iteration)) ^ mixed(static_cast<uint32_t>(at))};
        change_a_little(job, iteration, &draws, &pixel);
        job.planes[at] = pixel.plane.inverse;
        job.planes[size + at] = pixel.plane.across;
        job.planes[2 * size + at] = pixel.plane.down;
        job.costs[at] = pixel.cost;
    }
}

}  // namespace

extern const PatchKernels patch_kernels = {begin, improve};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
