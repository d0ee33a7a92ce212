// Compiled once per ISA: internal linkage, no std templates.
#include "base/simd.h"
#include "surface/surface_mosaic.h"

namespace splat {
namespace SPLAT_ISA_NAMESPACE {
namespace {

constexpr float kOddFree = 15.0f;   // difference from the other photos, grey values, that costs nothing,
constexpr float kOdd = 15.0f;       // and the cost of each further grey value
constexpr float kOddMost = 60.0f;   // larger differences are clamped to this
constexpr float kEvenCost = 64.0f;  // added to costs, so that the best photo does not outweigh the rest a hundredfold
constexpr int kRounds = 2;          // of the robust mean

void rank(const uint8_t* seen, const uint16_t* cost, int most, int64_t cells, uint16_t* least, uint8_t* seen_by) {
    constexpr int kPart = 512;  // cells at a time: their values stay in the L1 cache
    uint16_t rest[kPart];
    for (int64_t first = 0; first < cells; first += kPart) {
        const int count = cells - first < kPart ? static_cast<int>(cells - first) : kPart;
        for (int k = 0; k < count; ++k) {
            rest[k] = seen[first + k] ? cost[first + k] : kNever;
            seen_by[first + k] =
                static_cast<uint8_t>(seen_by[first + k] + (seen[first + k] & (seen_by[first + k] < 255)));
        }
        for (int place = 0; place < most; ++place) {
            uint16_t* held = least + place * cells + first;
            for (int k = 0; k < count; ++k) {
                const uint16_t low = rest[k] < held[k] ? rest[k] : held[k];
                rest[k] = rest[k] < held[k] ? held[k] : rest[k];
                held[k] = low;
            }
        }
    }
}

void drop(const uint16_t* cost, const uint16_t* limits, int64_t cells, uint8_t* seen) {
    for (int64_t k = 0; k < cells; ++k) seen[k] = static_cast<uint8_t>(seen[k] & (cost[k] <= limits[k]));
}

void grey(const uint8_t* colour, int64_t count, uint8_t* out) {
    for (int64_t k = 0; k < count; ++k) {  // BT.601, in units of 1 / 16,384
        const uint8_t* pixel = colour + 3 * k;
        out[k] = static_cast<uint8_t>((4899 * pixel[0] + 9617 * pixel[1] + 1868 * pixel[2] + 8192) >> 14);
    }
}

static_assert((2 * kSoft + 1) * (2 * kSoft + 1) * UINT8_MAX < kCounted, "greys do not spill over into their number");

void tag(const uint8_t* grey, const uint8_t* seen, int64_t count, uint16_t* tagged) {
    for (int64_t k = 0; k < count; ++k) tagged[k] = static_cast<uint16_t>(seen[k] ? kCounted + grey[k] : 0);
}

void soften(const int32_t* sums, int count, uint8_t* soft) {
    for (int k = 0; k < count; ++k) {
        const int number = sums[k] / kCounted, total = sums[k] % kCounted;
        const float mean = static_cast<float>(total) / static_cast<float>(number ? number : 1);
        soft[k] = static_cast<uint8_t>(static_cast<int>(mean));
    }
}

void slide(const uint16_t* met, const uint16_t* left, int count, int32_t* sums) {
    if (left)
        for (int k = 0; k < count; ++k) sums[k] += met[k] - left[k];
    else
        for (int k = 0; k < count; ++k) sums[k] += met[k];
}

void across(const int32_t* sums, int radius, int count, int32_t* out) {
    for (int k = 0; k < count; ++k) out[k] = sums[k];
    for (int step = 1; step <= 2 * radius; ++step)
        for (int k = 0; k < count; ++k) out[k] += sums[k + step];
}

// The others' grey value is a mean weighted towards better photos, recomputed without outliers.
void compare(const LikenessRow& row) {
    const int width = row.width;
    float *total = row.total, *mean = row.mean;
    for (int photo = 0; photo < row.photos; ++photo) {
        const uint8_t* seen = row.seen + photo * row.stride;
        const uint16_t* cost = row.cost + photo * row.stride;
        float* weights = row.weights + static_cast<int64_t>(photo) * width;
        for (int k = 0; k < width; ++k) weights[k] = seen[k] ? 1.0f / (static_cast<float>(cost[k]) + kEvenCost) : 0.0f;
    }
    for (int round = 0; round < kRounds; ++round) {
        for (int k = 0; k < width; ++k) total[k] = 1e-20f, mean[k] = 0.0f;
        for (int photo = 0; photo < row.photos; ++photo) {
            const uint8_t* soft = row.soft + static_cast<int64_t>(photo) * width;
            const float* weights = row.weights + static_cast<int64_t>(photo) * width;
            for (int k = 0; k < width; ++k) {
                total[k] += weights[k];
                mean[k] += weights[k] * static_cast<float>(soft[k]);
            }
        }
        for (int k = 0; k < width; ++k) mean[k] /= total[k];
        for (int photo = 0; photo < row.photos && round + 1 < kRounds; ++photo) {
            const uint8_t* soft = row.soft + static_cast<int64_t>(photo) * width;
            float* weights = row.weights + static_cast<int64_t>(photo) * width;
            for (int k = 0; k < width; ++k) {
                const float apart = __builtin_fabsf(static_cast<float>(soft[k]) - mean[k]);
                const float odd = apart > kOddFree ? apart / kOddFree : 1.0f;
                weights[k] /= odd * odd;
            }
        }
    }
    for (int photo = 0; photo < row.photos; ++photo) {
        const uint8_t* seen = row.seen + photo * row.stride;
        const uint8_t* soft = row.soft + static_cast<int64_t>(photo) * width;
        uint16_t* cost = row.cost + photo * row.stride;
        for (int k = 0; k < width; ++k) {
            float apart = __builtin_fabsf(static_cast<float>(soft[k]) - mean[k]) - kOddFree;
            apart = apart < 0.0f ? 0.0f : apart > kOddMost ? kOddMost : apart;
            const int more = static_cast<int>(kOdd * apart) + cost[k];
            cost[k] = static_cast<uint16_t>(seen[k] && more < kHidden ? more : seen[k] ? kHidden : cost[k]);
        }
    }
}

void choose(const int32_t* totals, const uint8_t* seen, int photo, int count, uint16_t* average, uint16_t* least,
            int16_t* label) {
    constexpr int kArea = (2 * kSmooth + 1) * (2 * kSmooth + 1);
    for (int k = 0; k < count; ++k) {
        const uint16_t mean = static_cast<uint16_t>(seen[k] ? totals[k] / kArea : kNever);
        const bool is_better = mean < least[k];
        average[k] = mean;
        least[k] = is_better ? mean : least[k];
        label[k] = is_better ? static_cast<int16_t>(photo) : label[k];
    }
}

}  // namespace

extern const MosaicKernels mosaic_kernels = {rank, drop, grey, tag, soften, slide, across, compare, choose};

}  // namespace SPLAT_ISA_NAMESPACE
}  // namespace splat
