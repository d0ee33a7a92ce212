// PatchMatch: no out-of-bounds access to its images, and the same bits for any number of threads.
#include "patch_match/patch_match.h"

#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "base/threads.h"
#include "check.h"

namespace {

struct Photos {
    int width, height;
    std::vector<std::uint8_t> grey, counts;
    std::vector<std::uint32_t> corners;
};

Photos random_photos(int width, int height) {
    Random random(static_cast<std::uint64_t>(height * 1000 + width));
    Photos photos{width, height, {}, {}, {}};
    for (int k = 0; k < width * height; ++k) {
        photos.grey.push_back(static_cast<std::uint8_t>(random.below(256)));
        photos.counts.push_back(random.below(8) != 0);
        photos.corners.push_back(static_cast<std::uint32_t>(random.below(1 << 30)));
    }
    return photos;
}

std::vector<float> matched(const Photos& photo, const Photos& other) {
    const splat::PatchView view{other.width,
                                other.height,
                                other.corners.data(),
                                other.counts.data(),
                                {0.9f, 0.1f, 2.0f, -0.1f, 1.1f, -1.0f, 0.003f, -0.002f, 0.8f},
                                {-20.0f, 5.0f, 0.5f}};
    const std::vector<splat::PatchView> views(3, view);
    const std::size_t size = photo.grey.size();
    std::vector<float> found(4 * size);
    splat::PatchJob job{};
    job.width = photo.width, job.height = photo.height;
    job.grey = photo.grey.data(), job.counts = photo.counts.data();
    job.views = views.data(), job.view_count = 3;
    job.least = 0.01f, job.most = 2.0f, job.seed = 3;
    job.planes = found.data(), job.costs = found.data() + 3 * size;
    splat::patch_match(job, 3);
    return found;
}

void check_size(int width, int height) {
    const Photos photo = random_photos(width, height), other = random_photos(height + 3, width);
    splat::set_threads(1);
    const std::vector<float> one = matched(photo, other);
    splat::set_threads(4);
    check(same_bits(one, matched(photo, other)), "the same for one thread and four");
    check(all_finite(one), "finite");
}

}  // namespace

void test_patch_match() {
    for (const auto& [width, height] : {std::pair{4, 4}, {5, 61}, {67, 6}, {48, 33}})
        test_each_isa("PatchMatch " + std::to_string(width) + " x " + std::to_string(height),
                      [width = width, height = height] { check_size(width, height); });
}
