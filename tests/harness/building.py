"""Build the CUDA kernels' sources for the CPU, on top of ``cuda_on_cpu.h``; builds are cached by content."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

HARNESS = Path(__file__).resolve().parent
NATIVE = HARNESS.parents[1] / "pipeline" / "native"
KEPT = Path(tempfile.gettempdir()) / f"splatpipe-cuda-on-cpu-{os.getuid()}"

FORWARD, REVERSE, SHUFFLED = range(3)
"""Orders of threads and blocks, for ``harness_order``."""

FLAGS = ("-std=c++17", "-O2", "-g0", "-fPIC", "-fvisibility=hidden", "-fno-math-errno", "-DSPLAT_ON_CPU=1")
_CPU = Path("/proc/cpuinfo")
WARNINGS = ("-Wall", "-Wextra", "-Wno-unknown-pragmas", "-Wno-unused-parameter", "-Wno-psabi")
TRAPS = ("-O1", "-fsanitize=undefined,float-cast-overflow", "-fsanitize-undefined-trap-on-error")
LIKE_NVCC = ("-fexpensive-optimizations", "-ffp-contract=fast")
_SOURCES = (".h", ".cuh", ".cu")
_INCLUDE = re.compile(r'^#include "(.+)"', re.MULTILINE)


def kernel_sources() -> list[Path]:
    """Return all of the backend's sources."""
    return sorted((NATIVE / "cuda").glob("*.cu"))


def build_on_cpu(
    sources: Iterable[Path] | None = None,
    name: str = "splat_cuda",
    flags: Iterable[str] = (),
    changed: Mapping[Path, str] | None = None,
) -> Path:
    """Compile sources and link them with the harness.

    Args:
        sources: CUDA sources; None: the backend's own.
        name: Name of the library.
        flags: Further compiler flags.
        changed: Replacement text for sources or headers in ``NATIVE``, by their paths there; whatever depends on them
            is compiled with less optimisation (half the time), with contraction of products and sums wherever possible,
            as by nvcc, and with a trap on undefined behaviour.

    Returns:
        The shared library, ``lib<name>_on_cpu.so``.

    Raises:
        AssertionError: with the compiler's output, if it does not compile.
    """
    KEPT.mkdir(mode=0o700, exist_ok=True)
    assert KEPT.stat().st_uid == os.getuid(), f"{KEPT} is somebody else's: what lies there would be run"
    chosen = [HARNESS / "cuda_on_cpu.cpp", *(kernel_sources() if sources is None else sources)]
    native = _copy_with(changed) if changed else NATIVE
    options = (*FLAGS, *_fused(), *WARNINGS, *flags)

    def compiled(source: Path) -> Path:
        if changed and not _depends(source, NATIVE).isdisjoint(changed):
            return _compile(native / source.relative_to(NATIVE), native, (*options, *TRAPS, *LIKE_NVCC))
        return _compile(source, NATIVE, options)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        objects = list(pool.map(compiled, chosen))
    library = KEPT / _digest(path.name for path in objects) / f"lib{name}_on_cpu.so"
    if not library.exists():
        _write(library, ["-shared", *map(str, objects)])
    return library


def load(library: Path) -> ctypes.CDLL:
    """Load the library, with the harness's own functions declared."""
    loaded = ctypes.CDLL(str(library))
    loaded.harness_order.argtypes = [ctypes.c_int, ctypes.c_uint64]
    loaded.harness_order.restype = None
    loaded.harness_multiprocessors.argtypes = [ctypes.c_int]
    loaded.harness_multiprocessors.restype = None
    loaded.harness_fault.argtypes = [ctypes.c_int]
    loaded.harness_fault.restype = None
    loaded.harness_message.restype = ctypes.c_char_p
    loaded.harness_launches.restype = ctypes.c_int64
    loaded.harness_switches.restype = ctypes.c_int64
    loaded.harness_switches_alone.restype = ctypes.c_int64
    loaded.harness_used.argtypes, loaded.harness_used.restype = [ctypes.c_int], ctypes.c_int64
    return loaded


def _fused() -> tuple[str, ...]:
    """Return flags that fuse products into sums only where the source does: the bits of C's fmaf, faster."""
    has_fma = _CPU.exists() and "fma" in _CPU.read_text().split()
    return ("-ffp-contract=off", *(("-mfma",) if has_fma else ()))


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:32]


def _copy_with(changed: Mapping[Path, str]) -> Path:
    """Return a copy of the native sources in which some files are replaced."""
    files = [path for path in sorted(NATIVE.rglob("*")) if path.suffix in _SOURCES]
    texts = {path: changed.get(path, path.read_text()) for path in files}
    assert changed.keys() <= texts.keys(), "no such source"
    root = KEPT / "sources" / _digest(texts.values())
    for path, text in texts.items():
        to = root / path.relative_to(NATIVE)
        if not to.exists():
            to.parent.mkdir(parents=True, exist_ok=True)
            beside = to.with_name(f"{to.name}.{os.getpid()}")
            beside.write_text(text)
            beside.replace(to)
    return root


def _depends(source: Path, native: Path) -> set[Path]:
    """Return a source and the headers that it includes, directly or indirectly."""
    found, left = set(), [source]
    while left:
        path = left.pop()
        if path in found:
            continue
        found.add(path)
        for name in _INCLUDE.findall(path.read_text()):
            places = (path.parent / name, native / name, HARNESS / name)
            left += [place.resolve() for place in places if place.exists()][:1]
    return found


def _compile(source: Path, native: Path, options: tuple[str, ...]) -> Path:
    """Compile a source to an object, cached by the source, its headers and the options."""
    texts = [path.read_text() for path in sorted(_depends(source, native))]
    built = KEPT / "objects" / f"{source.stem}-{_digest([source.name, *options, *texts])}.o"
    if not built.exists():
        language = ("-x", "c++") if source.suffix == ".cu" else ()
        _write(built, [*options, f"-I{HARNESS}", f"-I{native}", "-c", *language, str(source)])
    return built


def _write(path: Path, arguments: list[str]) -> None:
    """Run the compiler; the file appears atomically, since others may build the same one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    done = subprocess.run(["c++", *arguments, "-o", str(beside)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{path.name}:\n{done.stderr}"
    beside.replace(path)
