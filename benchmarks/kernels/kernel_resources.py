"""Compile the CUDA kernels and print their registers, spills and shared memory, as Markdown.

    python benchmarks kernel_resources                       # a table of sm_90, and the spills on every device
    python benchmarks kernel_resources --devices 86 --of 86

Nothing runs on a GPU: the figures are the compiler's (`ptxas -v`). Warnings are errors, so it also shows that the code
of every device compiles without.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

NATIVE = Path(__file__).resolve().parents[2] / "pipeline" / "native"
SOURCES = NATIVE / "cuda"
FAMILIES = {75: (75,), 80: (80, 86, 89), 90: (90,), 100: (100,), 120: (120,)}
"""Devices by the architecture that their code is made from, as in `CMakeLists.txt` beside the sources."""
FLAGS = (
    "-std=c++17",
    "-O3",
    "-DNDEBUG",
    "-Xptxas=-v",
    "-Werror=all-warnings",
    "-Xcompiler=-Wall,-Wextra,-Werror,-fPIC",
)
# Further compiler flags by source file, as in the pipeline's build.
FLAGS_OF = dict.fromkeys(("frame.cu", "features.cu"), ("-fmad=false",))
ENTRY = re.compile(r"Compiling entry function '(\w+)' for 'sm_(\d+)\w*'")
SPILLS = re.compile(r"(\d+) bytes spill stores, (\d+) bytes spill loads")
USED = re.compile(r"Used (\d+) registers(?:.*?(\d+) bytes smem)?")
NAME = re.compile(r"(?:.* )?(?:\w+::|\(anonymous namespace\)::)*(\w+(?:<.*>)?)\(")


@dataclass(frozen=True)
class KernelResources:
    """What a kernel takes on a device.

    Attributes:
        source: Name of its source file.
        kernel: Its name, with template arguments.
        device: 10 · major + minor of the compute capability.
        registers: Per thread.
        spill_bytes: Stores and loads of registers that did not fit, with those of functions that it calls, per thread.
        shared_bytes: Per block.
    """

    source: str
    kernel: str
    device: int
    registers: int
    spill_bytes: int
    shared_bytes: int


def resources_in(said: str, source: str) -> Iterator[KernelResources]:
    """Read the compiler's output for a source; names are still mangled."""
    begins = [*ENTRY.finditer(said)]
    for entry, after in zip_longest(begins, begins[1:]):
        part = said[entry.end() : len(said) if after is None else after.start()]
        used = USED.search(part)
        assert used is not None, f"ptxas says nothing of {entry[1]}:\n{part}"
        spilled = sum(int(stores) + int(loads) for stores, loads in SPILLS.findall(part))
        yield KernelResources(source, entry[1], int(entry[2]), int(used[1]), spilled, int(used[2] or 0))


def kernel_name(demangled: str) -> str:
    """Return a kernel's name without namespaces and parameters."""
    found = NAME.match(demangled)
    return demangled if found is None else found[1].replace("splat::cuda::", "").replace("(anonymous namespace)::", "")


def compiled(source: Path, devices: Sequence[int], nvcc: str) -> list[KernelResources]:
    """Compile a source for some devices.

    Raises:
        SystemExit: with the compiler's output, if it fails or warns.
    """
    targets = []
    for made_from, family in FAMILIES.items():
        if wanted := [f"sm_{device}" for device in family if device in devices]:
            targets.append(f"-gencode=arch=compute_{made_from},code=[{','.join(wanted)}]")
    with tempfile.TemporaryDirectory() as folder:
        command = [nvcc, *FLAGS, *FLAGS_OF.get(source.name, ()), *targets]
        command += [f"-I{NATIVE}", "-c", str(source), "-o", str(Path(folder) / "kernels.o")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    said = done.stdout + done.stderr
    if done.returncode != 0:
        raise SystemExit(f"{source.name}:\n{said}")
    found = list(resources_in(said, source.name))
    names = "\n".join(each.kernel for each in found)
    plain = subprocess.run(["c++filt"], input=names, capture_output=True, text=True, check=True).stdout.splitlines()
    return [
        KernelResources(
            each.source, kernel_name(name), each.device, each.registers, each.spill_bytes, each.shared_bytes
        )
        for each, name in zip(found, plain, strict=True)
    ]


def table(found: Sequence[KernelResources], device: int) -> list[str]:
    """Return the lines of a Markdown table of a device's kernels."""
    kernels = sorted((each for each in found if each.device == device), key=lambda each: (each.source, each.kernel))
    return [
        f"| sm_{device} | registers | spilled, bytes | shared, bytes |",
        "|---|---|---|---|",
        *(f"| {k.source}: `{k.kernel}` | {k.registers} | {k.spill_bytes} | {k.shared_bytes:,} |" for k in kernels),
    ]


def spills(found: Sequence[KernelResources]) -> list[str]:
    """Return a line for each kernel that spills registers, with the bytes on each device."""
    by_kernel: dict[str, list[KernelResources]] = {}
    for each in sorted(found, key=lambda each: (each.source, each.kernel, each.device)):
        if each.spill_bytes:
            by_kernel.setdefault(each.kernel, []).append(each)
    return [
        f"- `{kernel}`: " + ", ".join(f"{each.spill_bytes} on sm_{each.device}" for each in spilling)
        for kernel, spilling in by_kernel.items()
    ]


def main(arguments: Sequence[str]) -> None:
    """Compile and print."""
    every = [device for family in FAMILIES.values() for device in family]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, nargs="+", choices=every, default=every, help="to compile for")
    parser.add_argument("--of", type=int, default=90, help="the device of the table")
    parser.add_argument("--nvcc", default="nvcc", help="the compiler")
    options = parser.parse_args(arguments)
    found = [
        each for source in sorted(SOURCES.glob("*.cu")) for each in compiled(source, options.devices, options.nvcc)
    ]
    print("\n".join(table(found, options.of)))
    print(f"\nSpilled, of {len(found)} kernels for {', '.join(f'sm_{device}' for device in options.devices)}:\n")
    print("\n".join(spills(found) or ["- none"]))


if __name__ == "__main__":
    main(sys.argv[1:])
