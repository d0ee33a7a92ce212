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

constexpr int kSamples = 32;            // of a round window: 6 x 6, two pixels apart, without the corners
constexpr int kNoView = 255;            // instead of a photo's index
constexpr float kUnlike = 1.2f;         // cost above which a photo is uninformative: it shows something else
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

// One value for each of four photos, which are compared with at once.
constexpr int kFour = 4;
using Fours = float __attribute__((vector_size(4 * kFour)));

SPLAT_INLINE Fours capped(Fours a, float most) { return a < most ? a : Fours{} + most; }

// Four photos as a pixel sees them: a plane (inverse, across, down) at the pixel's centre carries it to at + shift
// inverse, and a step to the right changes that by right + shift across, one down by down + shift down.
struct Four {
    const PatchView* view[kFour];  // null: none
    Fours at[3], right[3], down[3], shift[3];
};

SPLAT_INLINE void open_four(const PatchJob& job, const Window& window, const int (&number)[kFour], Four* four) {
    for (int i = 0; i < kFour; ++i) {
        four->view[i] = number[i] < job.view_count ? job.views + number[i] : nullptr;
        const PatchView& view = job.views[four->view[i] ? number[i] : 0];
        for (int k = 0; k < 3; ++k) {
            four->right[k][i] = view.turn[3 * k], four->down[k][i] = view.turn[3 * k + 1];
            four->at[k][i] = view.turn[3 * k + 2], four->shift[k][i] = view.shift[k];
        }
    }
    for (int k = 0; k < 3; ++k) four->at[k] += four->right[k] * window.x + four->down[k] * window.y;
}

// Sums over a photo's samples: of its values, their squares, and their products with the window's values.
struct Sums {
    Floats mean, square, together;
};

SPLAT_INLINE Sums sampled(const PatchView& view, const Window& window, const float (&at)[3], const float (&right)[3],
                          const float (&down)[3]) {
    Sums sums{fill(0.0f), fill(0.0f), fill(0.0f)};
    const Floats last_x = fill(static_cast<float>(view.width) - 1.0f);
    const Floats last_y = fill(static_cast<float>(view.height) - 1.0f);
    for (int k = 0; k < kSamples; k += kLanes) {
        const Floats dx = load(kRight + k), dy = load(kDown + k);
        const Floats scale = inverse(max(fma(fill(right[2]), dx, fma(fill(down[2]), dy, fill(at[2]))), fill(kNearest)));
        Floats x = fma(fma(fill(right[0]), dx, fma(fill(down[0]), dy, fill(at[0]))), scale, fill(-0.5f));
        Floats y = fma(fma(fill(right[1]), dx, fma(fill(down[1]), dy, fill(at[1]))), scale, fill(-0.5f));
        x = clamp(x, fill(0.0f), last_x), y = clamp(y, fill(0.0f), last_y);
        const Floats left = floor(x), above = floor(y);
        Floats corner[4];
        gather_bytes(view.corners, left, above, view.width, corner);
        const Floats part_x = x - left, part_y = y - above;
        const Floats top = fma(part_x, corner[1] - corner[0], corner[0]);
        const Floats bottom = fma(part_x, corner[3] - corner[2], corner[2]);
        const Floats value = fma(part_y, bottom - top, top), weighted = load(window.weights + k) * value;
        sums.mean = sums.mean + weighted, sums.square = fma(weighted, value, sums.square);
        sums.together = fma(load(window.centred + k), value, sums.together);
    }
    return sums;
}

// One minus the correlation, or kPatchWorst where a photo does not show the pixel.
Fours view_costs(const Four& four, const Window& window, const Plane& plane) {
    Fours at[3], right[3], down[3];
    for (int k = 0; k < 3; ++k) {
        at[k] = four.at[k] + four.shift[k] * plane.inverse;
        right[k] = four.right[k] + four.shift[k] * plane.across;
        down[k] = four.down[k] + four.shift[k] * plane.down;
    }
    const Fours middle_x = at[0] / at[2], middle_y = at[1] / at[2];
    Sums sums[kFour];
    Fours costs;
    for (int i = 0; i < kFour; ++i) {
        sums[i] = {fill(0.0f), fill(0.0f), fill(0.0f)};
        costs[i] = kPatchWorst;
        if (!four.view[i] || !(at[2][i] > kNearest)) continue;
        const PatchView& view = *four.view[i];
        const float x = middle_x[i], y = middle_y[i];
        const float width = static_cast<float>(view.width), height = static_cast<float>(view.height);
        if (!(x > 1.0f && y > 1.0f && x < width - 1.0f && y < height - 1.0f)) continue;
        if (!view.counts[static_cast<int64_t>(y) * view.width + static_cast<int64_t>(x)]) continue;
        sums[i] = sampled(view, window, {at[0][i], at[1][i], at[2][i]}, {right[0][i], right[1][i], right[2][i]},
                          {down[0][i], down[1][i], down[2][i]});
        costs[i] = 1.0f;
    }
    float mean[kFour], square[kFour], together[kFour];
    sum_lanes(sums[0].mean, sums[1].mean, sums[2].mean, sums[3].mean, mean);
    sum_lanes(sums[0].square, sums[1].square, sums[2].square, sums[3].square, square);
    sum_lanes(sums[0].together, sums[1].together, sums[2].together, sums[3].together, together);
    for (int i = 0; i < kFour; ++i) {
        const float variance = square[i] - mean[i] * mean[i];
        const float product = ((variance > 0.0f ? variance : 0.0f) + kNoise2) * (window.variance + kNoise2);
        costs[i] -= together[i] / __builtin_sqrtf(product);
    }
    return costs;
}

// Mean of the lowest two costs, each at most kUnlike.
SPLAT_INLINE float best_of(Fours costs) {
    costs = capped(costs, kUnlike);
    const float a = costs[0] < costs[1] ? costs[0] : costs[1], b = costs[0] < costs[1] ? costs[1] : costs[0];
    const float c = costs[2] < costs[3] ? costs[2] : costs[3], d = costs[2] < costs[3] ? costs[3] : costs[2];
    const float middle = a < c ? c : a, other = b < d ? b : d;
    return 0.5f * ((a < c ? a : c) + (middle < other ? middle : other));
}

// The photos that a pixel is compared with, the most similar ones for its plane, as bytes of an integer; 255: none.
SPLAT_INLINE int chosen_view(uint32_t chosen, int k) { return static_cast<int>(chosen >> (8 * k) & 255U); }

// The photos to compare with; the plane's cost in them is not computed twice.
uint32_t choose(const PatchJob& job, const Window& window, const Plane& plane, float* cost) {
    float costs[kFour + 1];
    int views[kFour + 1], count = 0;
    for (int first = 0; first < job.view_count; first += kFour) {
        Four four;
        open_four(job, window, {first, first + 1, first + 2, first + 3}, &four);
        const Fours found = view_costs(four, window, plane);
        for (int i = 0; i < least_of(kFour, job.view_count - first); ++i) {
            int place = least_of(count, kFour - 1);
            if (count == kFour && costs[place] <= found[i]) continue;
            for (; place > 0 && costs[place - 1] > found[i]; --place)
                costs[place] = costs[place - 1], views[place] = views[place - 1];
            costs[place] = found[i], views[place] = first + i;
            count = least_of(count + 1, kFour);
        }
    }
    Fours best;
    uint32_t chosen = 0;
    for (int k = 0; k < kFour; ++k) {
        best[k] = k < count ? costs[k] : kUnlike;
        chosen |= static_cast<uint32_t>(k < count ? views[k] : kNoView) << (8 * k);
    }
    *cost = best_of(best);
    return chosen;
}

// A pixel being processed: the best plane so far.
struct Pixel {
    const PatchJob& job;
    const Window& window;
    const Four& four;  // the photos in which planes are tried
    Plane plane;
    float cost;

    SPLAT_METHOD void attempt(const Plane& other) {
        if (!(other.inverse >= job.least && other.inverse <= job.most)) return;
        const float found = best_of(view_costs(four, window, other));
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
        Four four;
        open_four(job, window,
                  {chosen_view(chosen, 0), chosen_view(chosen, 1), chosen_view(chosen, 2), chosen_view(chosen, 3)},
                  &four);
        Pixel pixel{job, window, four, plane, job.costs[at]};
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
