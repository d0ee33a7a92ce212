// The instruction sets that kernels are compiled for, and the choice between them at run time.
//
// A kernel file is compiled once per ISA with SPLAT_ISA_NAMESPACE set. All it defines lives in
// `namespace splat::SPLAT_ISA_NAMESPACE`, in an unnamed namespace, but for one table of function pointers:
//
//     // loss.h                                        // loss_cpu.cpp
//     struct LossKernels { void (*blur)(...); };       namespace splat::SPLAT_ISA_NAMESPACE {
//     SPLAT_DECLARE_KERNELS(LossKernels, loss_kernels)   namespace { void blur(...) {...} }
//                                                        extern const LossKernels loss_kernels = {blur};
//     // any caller                                    }
//     SPLAT_KERNELS(loss_kernels).blur(...)
//
// No std templates and no inline functions of other headers in kernel files: the linker keeps one copy of those, and if
// it is the one compiled for AVX-512, an older laptop dies of SIGILL.
#pragma once

namespace splat {

enum class Isa { baseline = 0, avx2 = 1, avx512 = 2 };

// The ISA in use, of set_isa; baseline before that.
Isa active_isa();

// Choose by name: "baseline", "avx2", "avx512", or "auto". False if this CPU or this build lacks it.
bool set_isa(const char* name);
const char* isa_name(Isa isa);
bool isa_available(Isa isa);

}  // namespace splat

#if SPLAT_HAS_AVX512 || SPLAT_HAS_AVX2 || SPLAT_ISA_AVX512 || SPLAT_ISA_AVX2
#define SPLAT_DECLARE_KERNELS(Table, table) \
    namespace splat::baseline {             \
    extern const Table table;               \
    }                                       \
    namespace splat::avx2 {                 \
    extern const Table table;               \
    }                                       \
    namespace splat::avx512 {               \
    extern const Table table;               \
    }
#define SPLAT_KERNELS(table)                                                \
    (::splat::active_isa() == ::splat::Isa::avx512 ? ::splat::avx512::table \
     : ::splat::active_isa() == ::splat::Isa::avx2 ? ::splat::avx2::table   \
                                                   : ::splat::baseline::table)
#else
#define SPLAT_DECLARE_KERNELS(Table, table) \
    namespace splat::baseline {             \
    extern const Table table;               \
    }
#define SPLAT_KERNELS(table) (::splat::baseline::table)
#endif
