"""The objects compiled per instruction set share nothing that a linker could merge.

Of an inline function or a template that several objects hold, the linker keeps one copy. Were it the one compiled for
AVX-512, a CPU without would die of SIGILL wherever the function is called, also from code for the oldest CPU.
"""

import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from repository import ROOT

NATIVE = ROOT / "pipeline" / "native"
KERNEL_TABLE = re.compile(r"splat::(?P<isa>\w+)::\w+_kernels")
WEAK = "WwVvu"  # nm's letters for what the linker may take from another object


def strangers(obj: Path, isa: str) -> list[str]:
    """Symbols of an object that are weak, or global without being a kernel table of the ISA."""
    lines = subprocess.check_output(["nm", "-C", obj], text=True).splitlines()
    symbols = [re.fullmatch(r"[0-9a-f]* +(\w) (.+)", line) for line in lines]
    found = []
    for kind, name in (symbol.groups() for symbol in symbols if symbol):
        table = KERNEL_TABLE.fullmatch(name)
        if kind in WEAK or (kind.isupper() and kind != "U" and not (table and table["isa"] == isa)):
            found.append(f"{kind} {name}")
    return found


def compile_for_avx2(source: str, folder: Path) -> Path:
    (folder / "kernel.cpp").write_text(source)
    obj = folder / "kernel.o"
    isa = ["-DSPLAT_ISA_NAMESPACE=avx2", "-DSPLAT_ISA_AVX2=1"]
    subprocess.run(["c++", "-std=c++17", "-O0", *isa, "-I", NATIVE, "-c", folder / "kernel.cpp", "-o", obj], check=True)
    return obj


def test_the_builds_objects_have_no_global_symbols_but_their_kernel_tables() -> None:
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}-*-{sysconfig.get_platform().replace('-', '_')}"
    (build,) = (ROOT / "build").glob(f"{tag.replace('.', '_')}/build.ninja")
    objects = re.findall(r"^build (CMakeFiles/kernels_(\w+)\.dir/\S+\.o):", build.read_text(), re.MULTILINE)
    assert "baseline" in {isa for _, isa in objects}
    for path, isa in objects:
        assert strangers(build.parent / path, isa) == [], path


KERNEL = """
#include "base/isa.h"
{include}
struct Kernels {{ int (*count)(int); }};
SPLAT_DECLARE_KERNELS(Kernels, test_kernels)
{outside}
namespace splat::avx2 {{
namespace {{ int count(int n) {{ {body} }} }}
extern const Kernels test_kernels = {{count}};
}}
"""


@pytest.mark.parametrize(
    ("include", "outside", "body", "stranger"),
    [
        ("#include <vector>", "", "return std::vector<int>(n).size();", "W std::"),
        ("", "inline int twice(int n) { return 2 * n; }", "return twice(n);", "W twice"),
        ("", "int twice(int n) { return 2 * n; }", "return twice(n);", "T twice"),
        ("", "namespace splat::avx512 { extern const Kernels test_kernels = {}; }", "return n;", "R splat::avx512"),
    ],
)
def test_templates_inline_and_other_global_functions_are_found(
    tmp_path: Path, include: str, outside: str, body: str, stranger: str
) -> None:
    obj = compile_for_avx2(KERNEL.format(include=include, outside=outside, body=body), tmp_path)
    assert any(found.startswith(stranger) for found in strangers(obj, "avx2")), strangers(obj, "avx2")


def test_a_kernel_as_it_should_be_passes(tmp_path: Path) -> None:
    obj = compile_for_avx2(KERNEL.format(include="", outside="", body="return n;"), tmp_path)
    assert strangers(obj, "avx2") == []
