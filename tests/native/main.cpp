#include <cstdio>
#include <stdexcept>

#include "base/isa.h"
#include "check.h"

namespace {

int passed = 0, failed = 0;

constexpr splat::Isa kIsas[] = {splat::Isa::baseline, splat::Isa::avx2, splat::Isa::avx512};

void test_isa() {
    test("an ISA is chosen by name, and only one that there is", [] {
        check(splat::set_isa("auto") && splat::isa_available(splat::active_isa()), "auto is available");
        const splat::Isa best = splat::active_isa();
        for (const char* name : {"", "sse9", "AVX2"}) check(!splat::set_isa(name), name);
        check(splat::active_isa() == best, "a name that is refused changes nothing");
        for (splat::Isa isa : kIsas)
            check(splat::set_isa(splat::isa_name(isa)) == splat::isa_available(isa), splat::isa_name(isa));
    });
}

}  // namespace

void check(bool holds, const std::string& what) {
    if (!holds) throw std::runtime_error(what);
}

void test(const std::string& name, const std::function<void()>& body) {
    try {
        body();
        ++passed;
    } catch (const std::exception& error) {
        ++failed;
        std::printf("FAILED %s: %s\n", name.c_str(), error.what());
    }
}

void test_each_isa(const std::string& name, const std::function<void()>& body) {
    for (splat::Isa isa : kIsas) {
        if (!splat::set_isa(splat::isa_name(isa))) continue;
        test(name + " (" + splat::isa_name(isa) + ")", body);
    }
}

int main() {
    test_isa();
    test_threads();
    test_raster();
    test_gradients();
    test_features();
    test_loss();
    test_colour();
    test_sky();
    test_patch_match();
    test_descriptors();
    test_surface();
    test_adam();
    std::printf("%d passed, %d failed\n", passed, failed);
    return failed ? 1 : 0;
}
