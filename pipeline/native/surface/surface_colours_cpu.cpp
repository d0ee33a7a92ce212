// Compiled once per ISA: internal linkage, no std templates.
#include "surface/surface_colours.h"
#include "surface/surface_project.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kCubic = -0.75f;                   // parameter a of Keys' kernel; OpenCV's value, sharper than -0.5
constexpr double kFirstFiner = 1.515716566510398;  // 2^0.6: how much finer a photo must be to be halved

using Quad = float __attribute__((vector_size(16)));
using QuadInts = int32_t __attribute__((vector_size(16)));

SPLAT_INLINE Quad quad(uint32_t pixel) {
    const int32_t bits = static_cast<int32_t>(pixel);
    const QuadInts shift = {0, 8, 16, 24}, bytes = (QuadInts{bits, bits, bits, bits} >> shift) & 255;
    return __builtin_convertvector(bytes, Quad);
}

SPLAT_INLINE double within(double value, double last) { return value > 0.0 ? (value < last ? value : last) : 0.0; }

// Maps a pinhole's pixel to the photo; beyond the grid, the outermost squares are extrapolated.
SPLAT_INLINE void through_lens(const Lens& lens, double* column, double* row) {
    const double x = *column / lens.step, y = *row / lens.step;
    const int left = static_cast<int>(within(x, lens.columns - 2)), top = static_cast<int>(within(y, lens.rows - 2));
    const double* above = lens.nodes + 2 * (static_cast<int64_t>(top) * lens.columns + left);
    const double *below = above + 2 * static_cast<int64_t>(lens.columns), across = x - left, down = y - top;
    double found[2];
    for (int axis = 0; axis < 2; ++axis) {
        const double upper = above[axis] * (1.0 - across) + above[2 + axis] * across;
        const double lower = below[axis] * (1.0 - across) + below[2 + axis] * across;
        found[axis] = upper * (1.0 - down) + lower * down;
    }
    *column = found[0], *row = found[1];
}

void find(const Photo& photo, const Places& places, double cell, const uint8_t* seen, double* column, double* row,
          int8_t* times) {
    const SurfaceCamera& camera = photo.camera;
    const double focal = camera.fx > camera.fy ? camera.fx : camera.fy;
    InPhoto at;
    for (int64_t first = 0; first < places.count; first += kPlaces) {
        const int64_t last = first + kPlaces < places.count ? first + kPlaces : places.count;
        bool is_any = false;
        for (int64_t k = first; k < last; ++k) times[k] = -1, is_any |= seen[k] != 0;
        if (!is_any) continue;
        project(camera, places, first, &at);
        for (int k = 0; k < at.count; ++k) {
            if (!at.is_in[k] || !seen[first + k]) continue;
            const double finer = cell * focal / at.depth[k] / kFirstFiner;
            int halved = 0;
            for (int time = 0; time < kMostHalved; ++time) halved += finer >= static_cast<double>(1 << time);
            double x = at.column[k], y = at.row[k];
            if (photo.lens.nodes) through_lens(photo.lens, &x, &y);
            column[first + k] = within(x, photo.width), row[first + k] = within(y, photo.height);
            times[first + k] = static_cast<int8_t>(halved);
        }
    }
}

void read(const Photo& photo, int row, int left, int count, uint32_t* out) {
    const int width = photo.width, height = photo.height;
    const uint8_t* from = photo.pixels + static_cast<int64_t>(row < height ? row : height - 1) * width * 3;
    for (int k = 0; k < count; ++k) {
        const uint8_t* pixel = from + static_cast<int64_t>(left + k < width ? left + k : width - 1) * 3;
        out[k] = static_cast<uint32_t>(photo.tone[3 * pixel[0]]) |
                 static_cast<uint32_t>(photo.tone[3 * pixel[1] + 1]) << 8 |
                 static_cast<uint32_t>(photo.tone[3 * pixel[2] + 2]) << 16;
    }
}

void halve(const uint32_t* upper, const uint32_t* lower, int count, uint32_t* out) {
    for (int k = 0; k < count; ++k) {
        const uint32_t pixels[4] = {upper[2 * k], upper[2 * k + 1], lower[2 * k], lower[2 * k + 1]};
        uint32_t even = 0x00020002U, odd = 0x00000002U;  // sums of bytes, packed, plus 2 to round the mean of four
        for (uint32_t pixel : pixels) even += pixel & 0x00ff00ffU, odd += pixel >> 8 & 0xffU;
        out[k] = (even >> 2 & 0x00ff00ffU) | (odd >> 2) << 8;
    }
}

// Weights of the four pixels around a position, `part` of a pixel after the second.
SPLAT_INLINE void cubic(float part, float* weights) {
    const float a = kCubic, far = part + 1.0f, near = 1.0f - part;
    weights[0] = ((a * far - 5.0f * a) * far + 8.0f * a) * far - 4.0f * a;
    weights[1] = ((a + 2.0f) * part - (a + 3.0f)) * part * part + 1.0f;
    weights[2] = ((a + 2.0f) * near - (a + 3.0f)) * near * near + 1.0f;
    weights[3] = 1.0f - weights[0] - weights[1] - weights[2];
}

SPLAT_INLINE int held(int value, int last) { return value < 0 ? 0 : value > last ? last : value; }

SPLAT_INLINE Quad mixed(const uint32_t* row, const int* columns, const float* weights) {
    return (quad(row[columns[0]]) * weights[0] + quad(row[columns[1]]) * weights[1]) +
           (quad(row[columns[2]]) * weights[2] + quad(row[columns[3]]) * weights[3]);
}

void sample(const Halved& part, int64_t count, const double* column, const double* row, const int8_t* times,
            uint8_t* colour) {
    const double scale = 1.0 / static_cast<double>(1 << part.times);
    for (int64_t k = 0; k < count; ++k) {
        if (times[k] != part.times) continue;
        // Shifted by a pixel: positive, so that truncation rounds down.
        const double x = column[k] * scale + 0.5, y = row[k] * scale + 0.5;
        const int left = static_cast<int>(x), top = static_cast<int>(y);
        float across[4], down[4];
        int columns[4];
        cubic(static_cast<float>(x - left), across), cubic(static_cast<float>(y - top), down);
        Quad sum = {0.5f, 0.5f, 0.5f, 0.5f};
        for (int j = 0; j < 4; ++j) columns[j] = held(left - 2 + j, part.whole_width - 1) - part.left;
        for (int j = 0; j < 4; ++j) {
            const int at = held(top - 2 + j, part.whole_height - 1) - part.top;
            sum += mixed(part.pixels + static_cast<int64_t>(at) * part.width, columns, across) * down[j];
        }
        const Quad low = {}, high = low + 255.0f;
        const QuadInts whole = __builtin_convertvector(sum < low ? low : sum > high ? high : sum, QuadInts);
        for (int channel = 0; channel < 3; ++channel) colour[3 * k + channel] = static_cast<uint8_t>(whole[channel]);
    }
}

}  // namespace

extern const ColourKernels colour_sample_kernels = {find, read, halve, sample};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
