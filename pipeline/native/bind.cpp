// The Python module `splatpipe.pipeline.native._native`.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>
#include <vector>

#include "base/isa.h"
#include "base/threads.h"

namespace nb = nanobind;
using namespace nb::literals;

void bind_raster(nb::module_& m);
void bind_features(nb::module_& m);
void bind_loss(nb::module_& m);
void bind_adam(nb::module_& m);
void bind_patch_match(nb::module_& m);
void bind_descriptors(nb::module_& m);
void bind_sky(nb::module_& m);
void bind_surface(nb::module_& m);

namespace {

std::vector<std::string> isas() {
    std::vector<std::string> names;
    for (splat::Isa isa : {splat::Isa::avx512, splat::Isa::avx2, splat::Isa::baseline})
        if (splat::isa_available(isa)) names.emplace_back(splat::isa_name(isa));
    return names;
}

void set_isa(const std::string& name) {
    if (!splat::set_isa(name.c_str())) throw nb::value_error(("this CPU has no " + name).c_str());
}

}  // namespace

NB_MODULE(_native, m) {
    nb::set_leak_warnings(false);  // a graph that is still referenced at exit is not a leak
    m.doc() = "Native kernels: rasterizer, loss, optimiser, depths, descriptors, surfaces.";
    m.def("set_threads", &splat::set_threads, "threads"_a, "Threads of the one pool that all kernels share.");
    m.def("threads", &splat::thread_count);
    m.def("isa", [] { return std::string(splat::isa_name(splat::active_isa())); }, "The instruction set in use.");
    m.def("isas", &isas, "Instruction sets that this CPU has and this build knows, best first.");
    m.def("set_isa", &set_isa, "name"_a, "Use one of isas(), or \"auto\".");
    splat::set_isa("auto");
    bind_raster(m);
    bind_features(m);
    bind_loss(m);
    bind_adam(m);
    bind_patch_match(m);
    bind_descriptors(m);
    bind_sky(m);
    bind_surface(m);
}
