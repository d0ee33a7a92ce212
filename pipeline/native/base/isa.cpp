#include "base/isa.h"

#include <atomic>
#include <cstring>

namespace splat {
namespace {

constexpr Isa kAll[] = {Isa::avx512, Isa::avx2, Isa::baseline};  // best first

Isa best_isa() {
    for (Isa isa : kAll)
        if (isa_available(isa)) return isa;
    return Isa::baseline;
}

std::atomic<Isa> active{Isa::baseline};

}  // namespace

Isa active_isa() { return active.load(std::memory_order_relaxed); }

const char* isa_name(Isa isa) { return isa == Isa::avx512 ? "avx512" : isa == Isa::avx2 ? "avx2" : "baseline"; }

bool isa_available([[maybe_unused]] Isa isa) {
#if SPLAT_HAS_AVX2 && SPLAT_HAS_AVX512
    const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
                      __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2");
    if (isa == Isa::avx2) return avx2;
    if (isa == Isa::avx512)
        return avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
               __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl");
#endif
    return isa == Isa::baseline;
}

bool set_isa(const char* name) {
    if (std::strcmp(name, "auto") == 0) {
        active = best_isa();
        return true;
    }
    for (Isa isa : kAll)
        if (std::strcmp(name, isa_name(isa)) == 0 && isa_available(isa)) {
            active = isa;
            return true;
        }
    return false;
}

}  // namespace splat
