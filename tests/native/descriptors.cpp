// The search for nearest descriptors: no out-of-bounds access, and the products of a plain loop.
#include <cstddef>
#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "check.h"
#include "descriptors/nearest.h"

namespace {

std::vector<std::uint8_t> random_descriptors(std::int64_t count, int below) {
    Random random(static_cast<std::uint64_t>(count * 1000 + below));
    std::vector<std::uint8_t> found(static_cast<std::size_t>(count * splat::kDescriptor));
    for (std::uint8_t& value : found) value = static_cast<std::uint8_t>(random.below(below));
    return found;
}

void check_count(std::int64_t query_count, std::int64_t value_count) {
    const std::vector<std::uint8_t> queries = random_descriptors(query_count, 256);
    const std::vector<std::uint8_t> values = random_descriptors(value_count, 255);
    const auto size = static_cast<std::size_t>(query_count);
    std::vector<std::int64_t> rows(size);
    std::vector<std::int32_t> best(size), second(size);
    const splat::NearestJob job{queries.data(), query_count, values.data(), value_count,
                                rows.data(),    best.data(), second.data()};
    const std::int64_t query_bounds[] = {0, query_count / 2, query_count},
                       value_bounds[] = {0, value_count, value_count};
    splat::compare_groups(job, query_bounds, value_bounds, 2);
    for (std::int64_t q = 0; q < query_count / 2; ++q) {
        std::int64_t row = 0;
        std::int32_t first = -1, next = 0;
        for (std::int64_t v = 0; v < value_count; ++v) {
            std::int32_t product = 0;
            for (std::int64_t k = 0; k < splat::kDescriptor; ++k)
                product += std::int32_t{queries[static_cast<std::size_t>(q * splat::kDescriptor + k)]} *
                           values[static_cast<std::size_t>(v * splat::kDescriptor + k)];
            if (product > first)
                next = first > next ? first : next, first = product, row = v;
            else if (product > next)
                next = product;
        }
        const auto at = static_cast<std::size_t>(q);
        check(rows[at] == row && best[at] == first && second[at] == next, "query " + std::to_string(q));
    }
    for (std::size_t q = size / 2; q < size; ++q) check(best[q] == 0, "a group without values is left alone");
}

}  // namespace

void test_descriptors() {
    for (const auto& [queries, values] : {std::pair{2, 1}, {14, 16}, {26, 65}, {9, 257}, {40, 530}})
        test_each_isa("descriptors " + std::to_string(queries) + " x " + std::to_string(values),
                      [queries = queries, values = values] { check_count(queries, values); });
}
