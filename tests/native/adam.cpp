// Adam against its float64 definition, sparse and with non-finite gradients.
#include "adam/adam.h"

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "adam/adam_step.h"
#include "base/threads.h"
#include "check.h"

namespace {

constexpr int kWidths[] = {3, 3, 4, 1, 48, 64};
constexpr splat::AdamOptions kOptions{0.9, 0.999, 1e-15, 1};
constexpr int kSteps = 3;

struct State {
    std::vector<std::vector<float>> values, means, squares;

    bool same_bits_as(const State& other) const {
        bool same = true;
        for (std::size_t t = 0; t < values.size(); ++t)
            same = same && same_bits(values[t], other.values[t]) && same_bits(means[t], other.means[t]) &&
                   same_bits(squares[t], other.squares[t]);
        return same;
    }
};

State start(int rows) {
    Random random(static_cast<std::uint64_t>(rows));
    State state;
    for (int width : kWidths) {
        const std::size_t size = static_cast<std::size_t>(rows) * static_cast<std::size_t>(width);
        state.values.emplace_back(size), state.means.emplace_back(size), state.squares.emplace_back(size);
        for (float& value : state.values.back()) value = random.normal();
    }
    return state;
}

std::vector<std::vector<float>> gradients_of(const State& state, int step, bool hostile) {
    Random random(static_cast<std::uint64_t>(step) + 100);
    std::vector<std::vector<float>> gradients;
    for (const std::vector<float>& values : state.values) {
        gradients.emplace_back(values.size());
        for (float& value : gradients.back()) {
            value = random.normal();
            if (hostile && random.below(200) == 0) value = random.below(2) ? NAN : -INFINITY;
        }
    }
    return gradients;
}

// Visible rows: all or some; empty for all.
std::vector<std::uint8_t> seen_rows(int rows, bool sparse, int step) {
    Random random(static_cast<std::uint64_t>(step));
    std::vector<std::uint8_t> visible(sparse ? static_cast<std::size_t>(rows) : 0);
    for (std::uint8_t& seen : visible) seen = random.below(2) != 0;
    return visible;
}

std::int64_t step_natively(State* state, int rows, int step, bool sparse, bool hostile) {
    const auto gradients = gradients_of(*state, step, hostile);
    const auto visible = seen_rows(rows, sparse, step);
    std::vector<std::vector<float>> rates;
    std::vector<splat::AdamRows> tensors;
    for (std::size_t t = 0; t < gradients.size(); ++t) {
        rates.emplace_back(kWidths[t], 1e-2f);
        tensors.push_back({state->values[t].data(), gradients[t].data(), state->means[t].data(),
                           state->squares[t].data(), rates.back().data(), kWidths[t]});
    }
    splat::AdamOptions options = kOptions;
    options.step = step;
    return splat::adam_step(tensors, rows, sparse ? visible.data() : nullptr, options);
}

bool row_finite(const std::vector<std::vector<float>>& gradients, int row) {
    for (std::size_t t = 0; t < gradients.size(); ++t)
        for (int c = 0; c < kWidths[t]; ++c)
            if (!std::isfinite(gradients[t][static_cast<std::size_t>(row * kWidths[t] + c)])) return false;
    return true;
}

// Returns the largest difference of `got` from the definition, value by value.
double worst_difference(const State& before, const State& got, int rows, int step, bool sparse, bool hostile,
                        std::int64_t* skipped) {
    const auto gradients = gradients_of(before, step, hostile);
    const auto visible = seen_rows(rows, sparse, step);
    double worst = 0.0;
    for (int row = 0; row < rows; ++row) {
        const bool seen = !sparse || visible[static_cast<std::size_t>(row)], finite = row_finite(gradients, row);
        *skipped += seen && !finite;
        for (std::size_t t = 0; t < gradients.size(); ++t)
            for (int c = 0; c < kWidths[t]; ++c) {
                const std::size_t i = static_cast<std::size_t>(row * kWidths[t] + c);
                double value = before.values[t][i];
                if (seen && finite) {
                    const double g = gradients[t][i];
                    const double mean = 0.9 * before.means[t][i] + 0.1 * g;
                    const double square = 0.999 * before.squares[t][i] + 0.001 * g * g;
                    const double root = std::sqrt(square / (1.0 - std::pow(0.999, step)));
                    value -= 1e-2 * mean / (1.0 - std::pow(0.9, step)) / (root + 1e-15);
                }
                worst = std::max(worst, std::abs(value - double{got.values[t][i]}));
            }
    }
    return worst;
}

void is_the_definition() {
    for (int rows : {0, 1, 15, 16, 17, 300})
        for (bool sparse : {false, true})
            for (bool hostile : {false, true}) {
                State state = start(rows);
                for (int step = 1; step <= kSteps; ++step) {
                    const State before = state;
                    const std::int64_t skipped = step_natively(&state, rows, step, sparse, hostile);
                    std::int64_t expected = 0;
                    const double worst = worst_difference(before, state, rows, step, sparse, hostile, &expected);
                    check(skipped == expected, std::to_string(rows) + " rows: rows left out are counted");
                    check(worst < 2e-6, std::to_string(rows) + " rows: off by " + std::to_string(worst));
                }
            }
}

void same_for_any_threads() {
    const int rows = 1001;
    State alone = start(rows);
    splat::set_threads(1);
    for (int step = 1; step <= kSteps; ++step) step_natively(&alone, rows, step, true, true);
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        State state = start(rows);
        for (int step = 1; step <= kSteps; ++step) step_natively(&state, rows, step, true, true);
        check(state.same_bits_as(alone), std::to_string(threads) + " threads");
    }
}

}  // namespace

void test_adam() {
    test_each_isa("Adam is its definition, sparse or not, whatever the gradients", is_the_definition);
    test_each_isa("Adam is the same for any number of threads", same_for_any_threads);
}
