// The pool: every index once, nesting, exceptions, several callers, and a changing number of threads.
#include "base/threads.h"

#include <atomic>
#include <limits>
#include <stdexcept>
#include <string>
#include <thread>
#include <vector>

#include "check.h"

namespace {

void every_index_once() {
    for (int threads : {1, 2, 5, 9, 1})
        for (std::int64_t count : {0, 1, 2, 7, 500}) {
            splat::set_threads(threads);
            std::vector<int> times(static_cast<std::size_t>(count));  // not atomic: a second time would be a race
            splat::parallel_for(count, [&](std::int64_t i) { ++times[static_cast<std::size_t>(i)]; });
            for (int t : times) check(t == 1, std::to_string(threads) + " threads, " + std::to_string(count));
        }
}

void counts_are_clamped() {
    splat::set_threads(-3);
    check(splat::thread_count() == 1, "at least one");
    splat::set_threads(std::numeric_limits<int>::max());
    check(splat::thread_count() == 256, "at most 256");
    splat::set_threads(2);
}

void nested() {
    splat::set_threads(5);
    std::vector<std::int64_t> sums(40);
    splat::parallel_for(40, [&](std::int64_t i) {
        std::int64_t sum = 0;  // not atomic: what a task starts runs on its own thread
        splat::parallel_for(i, [&](std::int64_t j) { splat::parallel_for(2, [&](std::int64_t k) { sum += j * k; }); });
        sums[static_cast<std::size_t>(i)] = sum;
    });
    for (std::int64_t i = 0; i < 40; ++i) check(sums[static_cast<std::size_t>(i)] == i * (i - 1) / 2, "sum");
}

void exceptions() {
    for (int threads : kThreadCounts) {
        splat::set_threads(threads);
        for (int throwing : {0, 17, 99, -1}) {  // -1: all of them at once
            bool caught = false;
            std::vector<std::int64_t> alive(100);  // gone once the exception is out, and no task may touch it then
            try {
                splat::parallel_for(100, [&](std::int64_t i) {
                    if (i == throwing || throwing < 0) throw std::runtime_error("task " + std::to_string(i));
                    for (int round = 0; round < 1000; ++round) alive[static_cast<std::size_t>(i)] += round;
                });
            } catch (const std::runtime_error& error) {
                caught = std::string(error.what()).rfind("task ", 0) == 0;
            }
            check(caught, "the exception arrives");
        }
        std::atomic<int> done{0};
        splat::parallel_for(100, [&](std::int64_t) { ++done; });
        check(done == 100, "the pool goes on afterwards");
    }
}

void several_callers() {
    std::atomic<std::int64_t> total{0};
    std::vector<std::thread> callers;
    for (int c = 0; c < 4; ++c)
        callers.emplace_back([&, c] {
            for (int round = 0; round < 50; ++round) {
                if (c == 0) splat::set_threads(1 + round % 5);
                std::vector<std::int64_t> mine(64);
                splat::parallel_for(64, [&](std::int64_t i) { mine[static_cast<std::size_t>(i)] = i; });
                for (std::int64_t value : mine) total += value;
            }
        });
    for (std::thread& caller : callers) caller.join();
    check(total == 4 * 50 * 63 * 32, "every caller's work is done");
}

void a_task_changes_the_number_of_threads() {
    splat::set_threads(3);
    std::atomic<int> done{0};
    for (int round = 0; round < 20; ++round)
        splat::parallel_for(30, [&](std::int64_t i) {
            if (i % 7 == 0) splat::set_threads(1 + static_cast<int>(i) % 4);
            ++done;
        });
    check(done == 600, "all tasks ran");
}

void denormals() {
    volatile float tiny = std::numeric_limits<float>::min(), half = 0.5f;
    splat::set_threads(4);
    std::vector<float> products(200, 1.0f);
    splat::parallel_for(200, [&](std::int64_t i) { products[static_cast<std::size_t>(i)] = tiny * half; });
    for (float product : products) check(product == 0.0f, "flushed in every task");
    check(tiny * half > 0.0f, "not flushed in the caller afterwards");
}

}  // namespace

void test_threads() {
    test("every index once", every_index_once);
    test("the number of threads is clamped", counts_are_clamped);
    test("nested calls run on the thread of their task", nested);
    test("an exception arrives once no task runs any more", exceptions);
    test("several callers", several_callers);
    test("a task changes the number of threads", a_task_changes_the_number_of_threads);
    test("denormals are flushed in tasks only", denormals);
}
