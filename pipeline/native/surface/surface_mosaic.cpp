#include "surface/surface_mosaic.h"

#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <vector>

namespace splat {
namespace {

constexpr int kSeam = 60;      // cost of a seam between two cells,
constexpr int kSeamStep = 12;  // and of each grey value by which the photos differ there

// Box sums over the cells of a picture, row by row from the top; the border is replicated.
class SlidingBox {
  public:
    SlidingBox(int width, int height, int radius)
        : width_(width), height_(height), radius_(radius), sums_(static_cast<std::size_t>(width + 2 * radius)) {}

    // The sums of row `row` of a picture; rows are requested in order.
    void row(int row, const std::uint16_t* picture, std::int32_t* out) {
        const MosaicKernels& kernels = SPLAT_KERNELS(mosaic_kernels);
        std::int32_t* middle = sums_.data() + radius_;
        const auto fetch = [&](int y) {
            return picture + static_cast<std::int64_t>(std::clamp(y, 0, height_ - 1)) * width_;
        };
        if (row == 0) {
            std::fill(sums_.begin(), sums_.end(), 0);
            for (int y = -radius_; y <= radius_; ++y) kernels.slide(fetch(y), nullptr, width_, middle);
        } else {
            kernels.slide(fetch(row + radius_), fetch(row - radius_ - 1), width_, middle);
        }
        std::fill(sums_.data(), middle, middle[0]);
        std::fill(middle + width_, middle + width_ + radius_, middle[width_ - 1]);
        kernels.across(sums_.data(), radius_, width_, out);
    }

  private:
    int width_, height_, radius_;
    std::vector<std::int32_t> sums_;
};

class Mosaic {
  public:
    Mosaic(const MosaicJob& job, const MosaicResult& out)
        : job_(job),
          out_(out),
          cells_(static_cast<std::int64_t>(job.width) * job.height),
          grey_(static_cast<std::size_t>(job.photos * cells_)),
          average_(grey_.size()) {}

    void make() {
        SPLAT_KERNELS(mosaic_kernels).grey(job_.colour, job_.photos * cells_, grey_.data());
        compare();
        choose();
        for (int sweep = 0; sweep < 2 * kSweeps; ++sweep)
            for (int row = 1; row + 1 < job_.height; ++row)
                for (int column = 1 + (row + 1 + sweep + job_.parity) % 2; column + 1 < job_.width; column += 2)
                    move(static_cast<std::int64_t>(row) * job_.width + column);
        for (int row = 0; row < job_.height; ++row)
            for (int column = 0; column < job_.width; ++column) blend(row, column);
    }

  private:
    void compare();
    void choose();
    void move(std::int64_t cell);
    int energy(int label, std::int64_t cell) const;
    void blend(int row, int column);
    std::int64_t at(int photo, std::int64_t cell) const { return photo * cells_ + cell; }

    const MosaicJob& job_;
    const MosaicResult& out_;
    std::int64_t cells_;
    std::vector<std::uint8_t> grey_;
    std::vector<std::uint16_t> average_;  // costs
};

// Photos cost more where they differ from the others. They are blurred first, because a texture that two photos show
// a fraction of a pixel apart is no outlier.
void Mosaic::compare() {
    const MosaicKernels& kernels = SPLAT_KERNELS(mosaic_kernels);
    const auto width = static_cast<std::size_t>(job_.width), photos = static_cast<std::size_t>(job_.photos);
    std::vector<std::uint16_t>& tagged = average_;  // not in use yet
    kernels.tag(grey_.data(), job_.seen, job_.photos * cells_, tagged.data());
    std::vector<SlidingBox> boxes(photos, SlidingBox(job_.width, job_.height, kSoft));
    std::vector<std::uint8_t> soft(photos * width);
    std::vector<float> weights(photos * width), total(width), mean(width);
    std::vector<std::int32_t> sums(width);
    for (int row = 0; row < job_.height; ++row) {
        for (std::size_t photo = 0; photo < photos; ++photo) {
            boxes[photo].row(row, tagged.data() + at(static_cast<int>(photo), 0), sums.data());
            kernels.soften(sums.data(), job_.width, soft.data() + photo * width);
        }
        const std::int64_t first = static_cast<std::int64_t>(row) * job_.width;
        kernels.compare({job_.photos, job_.width, cells_, job_.seen + first, job_.cost + first, soft.data(),
                         weights.data(), total.data(), mean.data()});
    }
}

// The minimum of the costs averaged around each cell (Hosni et al., "Fast Cost-Volume Filtering", 2013).
void Mosaic::choose() {
    const MosaicKernels& kernels = SPLAT_KERNELS(mosaic_kernels);
    std::vector<std::uint16_t> least(static_cast<std::size_t>(cells_), kNever);
    std::vector<std::int32_t> totals(static_cast<std::size_t>(job_.width));
    std::fill(out_.label, out_.label + cells_, std::int16_t{-1});
    for (int photo = 0; photo < job_.photos; ++photo) {
        SlidingBox box(job_.width, job_.height, kSmooth);
        for (int row = 0; row < job_.height; ++row) {
            const std::int64_t first = static_cast<std::int64_t>(row) * job_.width, here = at(photo, first);
            box.row(row, job_.cost + at(photo, 0), totals.data());
            kernels.choose(totals.data(), job_.seen + here, photo, job_.width, average_.data() + here,
                           least.data() + first, out_.label + first);
        }
    }
}

// The averaged cost of a label, and of the seams with the neighbours' (Kwatra et al., "Graphcut Textures", 2003).
int Mosaic::energy(int label, std::int64_t cell) const {
    int total = average_[static_cast<std::size_t>(at(label, cell))];
    for (std::int64_t beside : {cell - job_.width, cell + job_.width, cell - 1, cell + 1}) {
        const int other = out_.label[beside];
        if (other < 0 || other == label) continue;
        const auto grey = [&](int photo, std::int64_t place) -> int {
            return grey_[static_cast<std::size_t>(at(photo, place))];
        };
        total += kSeam + kSeamStep * (std::abs(grey(label, cell) - grey(other, cell)) +
                                      std::abs(grey(label, beside) - grey(other, beside)));
    }
    return total;
}

// Gives a cell at a seam the label of a neighbour where that is cheaper.
void Mosaic::move(std::int64_t cell) {
    const std::int16_t own = out_.label[cell];
    const std::int16_t theirs[] = {out_.label[cell - job_.width], out_.label[cell + job_.width], out_.label[cell - 1],
                                   out_.label[cell + 1]};
    if (own < 0 || (own == theirs[0] && own == theirs[1] && own == theirs[2] && own == theirs[3])) return;
    std::int16_t best = own;
    int least = energy(own, cell);
    for (std::int16_t other : theirs) {
        if (other < 0 || other == best) continue;
        const int found = energy(other, cell);
        if (found < least || (found == least && other < best)) best = other, least = found;
    }
    out_.label[cell] = best;
}

// The colour of the cell's photo, mixed at seams with those of the labels around that see the cell.
void Mosaic::blend(int row, int column) {
    const std::int64_t cell = static_cast<std::int64_t>(row) * job_.width + column;
    int total[3] = {}, weights = 0;
    const int own = out_.label[cell];
    for (int y = row - kFeather; y <= row + kFeather; ++y) {
        const std::int64_t first = static_cast<std::int64_t>(std::clamp(y, 0, job_.height - 1)) * job_.width;
        for (int x = column - kFeather; x <= column + kFeather; ++x) {
            const int label = out_.label[first + std::clamp(x, 0, job_.width - 1)];
            if (label < 0 || !job_.seen[at(label, cell)]) continue;
            const std::uint8_t* colour = job_.colour + 3 * at(label, cell);
            for (int channel = 0; channel < 3; ++channel) total[channel] += colour[channel];
            ++weights;
        }
    }
    for (int channel = 0; channel < 3; ++channel)
        out_.colour[3 * cell + channel] =
            static_cast<std::uint8_t>(own < 0 ? 0 : (total[channel] + weights / 2) / weights);
}

}  // namespace

void keep_best(int photos, std::int64_t cells, int most, const std::uint16_t* cost, std::uint8_t* seen,
               std::uint8_t* seen_by) {
    const MosaicKernels& kernels = SPLAT_KERNELS(mosaic_kernels);
    std::vector<std::uint16_t> least(static_cast<std::size_t>(most * cells), kNever);
    std::fill(seen_by, seen_by + cells, std::uint8_t{0});
    for (int photo = 0; photo < photos; ++photo)
        kernels.rank(seen + photo * cells, cost + photo * cells, most, cells, least.data(), seen_by);
    for (int photo = 0; photo < photos; ++photo)
        kernels.drop(cost + photo * cells, least.data() + (most - 1) * cells, cells, seen + photo * cells);
}

void compose_mosaic(const MosaicJob& job, const MosaicResult& out) { Mosaic(job, out).make(); }

}  // namespace splat
