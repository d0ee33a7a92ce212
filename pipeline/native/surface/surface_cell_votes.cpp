#include "surface/surface_cell_votes.h"

#include <algorithm>
#include <cmath>
#include <limits>

#include "surface/surface_votes.h"

namespace splat {
namespace {

constexpr double kSigmaPixels = 0.7;   // standard deviation of a depth's position perpendicular to the ray
constexpr double kLeastSine = 0.2;     // of a ray's angle to the ground; flatter ones are treated as this
constexpr double kSpan = 3.0;          // heights within this many standard deviations are one surface
constexpr double kWeightUnit = 256.0;  // weights are integers in units of 1 / this
constexpr double kMostWeight = 1 << 30;
constexpr int kFullyConfirmed = 4;    // more photos that confirm a depth add no weight
constexpr int kLeastVotes = 2;        // minimum number of photos that agree,
constexpr double kLeastShare = 0.25;  // and minimum share of the weight of the cell's best surface
constexpr int kRounds = 3;            // of the robust mean: it has converged after two
constexpr double kBiweight = 2.5;     // standard deviations beyond which a vote has no weight
constexpr double kNaN = std::numeric_limits<double>::quiet_NaN();

int cell_of(std::uint64_t key) { return static_cast<int>(key >> (64 - kCellBits)); }

std::int64_t steps_of(std::uint64_t key) {
    return static_cast<std::int64_t>(key >> (kCoverBits + kConfidenceBits) & ((std::uint64_t{1} << kStepBits) - 1));
}

// Stable counting sort by cell; `starts` receives the index of each cell's first element.
template <class T, class CellOf>
void sort_by_cell(const std::vector<T>& from, int cells, CellOf cell_of_one, std::vector<T>* to,
                  std::vector<std::size_t>* starts) {
    std::vector<std::size_t>& places = *starts;  // next index of each cell, shifted by one cell: in the end its start
    places.assign(static_cast<std::size_t>(cells) + 2, 0);
    for (const T& one : from) ++places[static_cast<std::size_t>(cell_of_one(one)) + 2];
    for (std::size_t cell = 1; cell < places.size(); ++cell) places[cell] += places[cell - 1];
    to->resize(from.size());
    for (const T& one : from) (*to)[places[static_cast<std::size_t>(cell_of_one(one)) + 1]++] = one;
    places.pop_back();
}

// Standard deviation of a height: that of a pixel projected to the ground, which is longer where the ray is flat.
double sigma_of(const SurfaceCamera& camera, const CellTile& tile, int cell, double height) {
    const double east = tile.east + (tile.column + cell % tile.width + 0.5) * tile.cell - camera.centre[0];
    const double north = tile.north - (tile.row + cell / tile.width + 0.5) * tile.cell - camera.centre[1];
    const double above = camera.centre[2] - height;
    const double away = std::max(std::sqrt(east * east + north * north + above * above), kHeightStep);
    return kSigmaPixels * away / std::max(camera.fx, camera.fy) / std::max(above / away, kLeastSine);
}

// Candidate surfaces of a cell: for each vote, the votes below it that are close enough to be the same surface.
struct Surfaces {
    std::vector<std::int64_t> weights, covers;  // prefix sums over the votes
    std::vector<std::size_t> bottoms;
    std::int64_t best;  // maximum weight of a surface

    void rank(const Vote* votes, std::size_t count);
    std::int64_t weight(std::size_t top) const { return weights[top + 1] - weights[bottoms[top]]; }
    // Whether enough photos agree on the surface.
    bool stands(const Vote& vote, std::size_t top) const {
        return (top + 1 - bottoms[top] >= kLeastVotes || vote.confirmed >= kLeastVotes) &&
               static_cast<double>(weight(top)) >= kLeastShare * static_cast<double>(best);
    }
};

void Surfaces::rank(const Vote* votes, std::size_t count) {
    weights.assign(1, 0), covers.assign(1, 0), bottoms.clear();
    best = 0;
    for (std::size_t k = 0; k < count; ++k) {
        weights.push_back(weights[k] + votes[k].weight), covers.push_back(covers[k] + votes[k].cover);
        const double reach = kSpan * std::sqrt(2.0) * static_cast<double>(votes[k].sigma);
        const Vote* lowest = std::lower_bound(votes, votes + k, votes[k].height - reach,
                                              [](const Vote& vote, double height) { return vote.height < height; });
        bottoms.push_back(static_cast<std::size_t>(lowest - votes));
        best = std::max(best, weight(k));
    }
}

struct Fit {
    double height, sigma;
    std::int32_t photos;
};

// Tukey's biweight of a vote about a height, times its own weight (Beaton and Tukey 1974).
double counted(const Vote& vote, double height) {
    const double off = (vote.height - height) / (kBiweight * static_cast<double>(vote.sigma));
    if (!(std::fabs(off) < 1.0)) return 0.0;  // also for NaN
    const double kept = 1.0 - off * off;
    return vote.weight * kept * kept;
}

Fit fitted(const Vote* begin, const Vote* end, double start) {
    double height = start, about = start, total = 0.0;
    for (int round = 0; round < kRounds; ++round) {
        double above = 0.0;  // sum relative to the last height, to keep precision
        about = height, total = 0.0;
        for (const Vote* vote = begin; vote != end; ++vote) {
            const double weight = counted(*vote, about);
            total += weight, above += weight * (vote->height - about);
        }
        if (!(total > 0.0)) return {kNaN, kNaN, 0};
        height = about + above / total;
    }
    double scatter = 0.0, expected = 0.0, squares = 0.0;
    std::int32_t photos = 0, confirmed = 0;
    for (const Vote* vote = begin; vote != end; ++vote) {
        const double share = counted(*vote, about) / total, off = vote->height - height;
        if (!(share > 0.0)) continue;
        const auto sigma = static_cast<double>(vote->sigma);
        scatter += share * off * off, expected += share * sigma * sigma, squares += share * share;
        ++photos, confirmed = std::max(confirmed, 1 + static_cast<std::int32_t>(vote->confirmed));
    }
    return {height, std::sqrt(std::max(scatter, expected) * squares), std::max(photos, confirmed)};
}

}  // namespace

CellVotes::CellVotes(const CellTile& tile) : tile_(tile) {}

void CellVotes::add(const DepthPicture& picture, int left, int top, int right, int bottom) {
    keys_.clear();
    read_window(picture, left, top, right, bottom);
    sort_keys();
    for (std::size_t begin = 0; begin < sorted_keys_.size();) {
        const int cell = cell_of(sorted_keys_[begin]);
        const std::size_t end = starts_[static_cast<std::size_t>(cell) + 1];
        vote(picture.camera, begin, end, cell);
        begin = end;
    }
    sorted_ = false;
}

void CellVotes::read_window(const DepthPicture& picture, int left, int top, int right, int bottom) {
    const VoteKernels& kernels = SPLAT_KERNELS(vote_kernels);
    const SurfaceCamera& camera = picture.camera;
    constexpr int kRows = 2 * kSlopeReach + 1;
    const std::size_t width = static_cast<std::size_t>(right - left) + 2 * kSlopeReach + kRowPadding;
    std::vector<float> ring(kRows * width);
    std::vector<std::uint64_t> found(static_cast<std::size_t>(right - left) * kMostParts * kMostParts);
    const auto fill = [&](int row) {
        float* out = ring.data() + static_cast<std::size_t>((row + kRows) % kRows) * width;
        std::fill(out, out + width, std::numeric_limits<float>::quiet_NaN());
        if (row < 0 || row >= camera.height) return;
        const int first = std::max(left - kSlopeReach, 0), last = std::min(right + kSlopeReach, camera.width);
        kernels.invert(picture.depth + static_cast<std::int64_t>(row) * camera.width + first, last - first,
                       out + (first - left + kSlopeReach));
    };
    for (int row = top - kSlopeReach; row < top + kSlopeReach; ++row) fill(row);
    for (int row = top; row < bottom; ++row) {
        fill(row + kSlopeReach);
        const float* inverses[kRows];
        for (int k = 0; k < kRows; ++k)
            inverses[k] = ring.data() + static_cast<std::size_t>((row - kSlopeReach + k + kRows) % kRows) * width;
        const std::int64_t count = kernels.heights({picture, tile_, row, left, right, inverses}, found.data());
        keys_.insert(keys_.end(), found.begin(), found.begin() + count);
    }
}

void CellVotes::sort_keys() {
    sort_by_cell(keys_, cells(), cell_of, &sorted_keys_, &starts_);
    for (std::size_t cell = 0; cell + 1 < starts_.size(); ++cell)
        std::sort(sorted_keys_.begin() + static_cast<std::ptrdiff_t>(starts_[cell]),
                  sorted_keys_.begin() + static_cast<std::ptrdiff_t>(starts_[cell + 1]));
}

// One vote for each run of heights in a cell without a gap.
void CellVotes::vote(const SurfaceCamera& camera, std::size_t begin, std::size_t end, int cell) {
    while (begin < end) {
        const std::int64_t lowest = steps_of(sorted_keys_[begin]);
        const double sigma = sigma_of(camera, tile_, cell, tile_.low + static_cast<double>(lowest) * kHeightStep);
        const double gap = kSpan * sigma / kHeightStep;
        std::int64_t last = lowest, covered = 0, above = 0;
        int sure = 0;
        std::size_t next = begin;
        for (; next < end; ++next) {
            const std::uint64_t key = sorted_keys_[next];
            if (static_cast<double>(steps_of(key) - last) > gap) break;
            last = steps_of(key), above += last - lowest;
            covered += static_cast<std::int64_t>(key >> kConfidenceBits & ((1U << kCoverBits) - 1));
            sure = std::max(sure, static_cast<int>(key & ((1U << kConfidenceBits) - 1)));
        }
        const double mean =
            static_cast<double>(lowest) + static_cast<double>(above) / static_cast<double>(next - begin);
        const double fine = tile_.cell / sigma, counts = 1 + std::min(sure, kFullyConfirmed);
        Vote made{};
        made.height = tile_.low + (mean + 0.5) * kHeightStep, made.sigma = static_cast<float>(sigma);
        made.weight =
            static_cast<std::int32_t>(std::clamp(std::round(kWeightUnit * counts * fine * fine), 1.0, kMostWeight));
        made.cell = cell, made.confirmed = static_cast<std::uint8_t>(sure);
        made.cover = static_cast<std::uint16_t>(std::min<std::int64_t>(covered, UINT16_MAX));
        votes_.push_back(made);
        begin = next;
    }
}

void CellVotes::sort_votes() {
    if (sorted_) return;
    std::vector<Vote> sorted;
    sort_by_cell(votes_, cells(), [](const Vote& vote) { return vote.cell; }, &sorted, &starts_);
    votes_ = std::move(sorted);
    for (std::size_t cell = 0; cell + 1 < starts_.size(); ++cell)  // photos come in one order: equal heights keep it
        std::stable_sort(votes_.begin() + static_cast<std::ptrdiff_t>(starts_[cell]),
                         votes_.begin() + static_cast<std::ptrdiff_t>(starts_[cell + 1]),
                         [](const Vote& a, const Vote& b) { return a.height < b.height; });
    sorted_ = true;
}

void CellVotes::layers(const LayerPlanes& out) {
    sort_votes();
    const std::size_t size = static_cast<std::size_t>(cells());
    std::fill(out.height, out.height + kSurfaceLayers * size, kNaN);
    std::fill(out.count, out.count + kSurfaceLayers * size, 0);
    std::fill(out.cover, out.cover + kSurfaceLayers * size, 0.0);
    Surfaces surfaces;
    for (std::size_t cell = 0; cell < size; ++cell) {
        const Vote* votes = votes_.data() + starts_[cell];
        surfaces.rank(votes, starts_[cell + 1] - starts_[cell]);
        std::size_t layer = 0;
        for (std::size_t top = surfaces.bottoms.size(); top-- > 0 && layer < kSurfaceLayers;) {
            if (!surfaces.stands(votes[top], top)) continue;
            const std::size_t bottom = surfaces.bottoms[top], count = top + 1 - bottom, at = layer++ * size + cell;
            out.height[at] = votes[(bottom + top) / 2].height, out.count[at] = static_cast<std::int32_t>(count);
            const auto covered = static_cast<double>(surfaces.covers[top + 1] - surfaces.covers[bottom]);
            out.cover[at] = covered / (static_cast<double>(count) * kCoverUnit);
            top = bottom;
        }
    }
}

void CellVotes::fit(const double* start, const FitPlanes& out) {
    sort_votes();
    for (std::size_t cell = 0; cell < static_cast<std::size_t>(cells()); ++cell) {
        const Vote* votes = votes_.data() + starts_[cell];
        const Fit found = fitted(votes, votes_.data() + starts_[cell + 1], start[cell]);
        out.height[cell] = found.height, out.sigma[cell] = found.sigma, out.photos[cell] = found.photos;
    }
}

}  // namespace splat
