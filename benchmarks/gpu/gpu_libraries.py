"""Both native libraries for the GPU machine: compiled beforehand, loaded there if they fit, and else compiled there."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

from gpu_parts import Row

ROOT = Path(__file__).resolve().parents[2]
NATIVE = ROOT / "pipeline" / "native"
FIND_PYTHON = Path(__file__).parent / "stable_abi"  # in place of CMake's FindPython, which wants an interpreter
ARCHITECTURE = "90"  # compute capability times ten: H100 and H200
DEBIAN = "deb http://deb.debian.org/debian trixie main"  # with Python 3.13, whose headers know the ABI of 3.12
HEADERS = "libpython3.13-dev"
STABLE = "_native.abi3.so"
CUDA = "libsplat_cuda.so"
COMPILED = (".cpp", ".h", ".cu", ".cuh")
COMPILE_S = 150.0  # at most, there; the module takes 190 s of one core
ROOM = ("pipeline", "native")
FITS = {  # ends with an error if the library does not fit; in processes of their own, as the second starts the device
    STABLE: "import numpy; from splatpipe.pipeline.native import _native; print(_native.isa())",
    CUDA: (
        "from splatpipe.pipeline.raster.cuda.cuda_library import load\n"
        "code, device = load().device(0)\n"
        "assert code == 0, load().error(code)\n"
        "print(device.described())"
    ),
}


def sources_digest() -> str:
    """Return a digest of everything that the libraries are compiled from."""
    digest = hashlib.sha256()
    for path in sorted(path for path in NATIVE.rglob("*") if path.suffix in COMPILED or path.name == "CMakeLists.txt"):
        digest.update(f"{path.relative_to(NATIVE)}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def compile_beforehand(target: Path, scratch: Path) -> Row:
    """Compile both libraries for the other machine into a folder, unless they are there from the same sources.

    Args:
        target: The folder.
        scratch: For headers and objects; kept for the next time.

    Returns:
        For each library what was done.
    """
    target.mkdir(parents=True, exist_ok=True)
    stamp, digest = target / "sources.sha256", sources_digest()
    if stamp.exists() and stamp.read_text() != digest:
        for old in target.iterdir():
            old.unlink()
    said: Row = {}
    for name, compile_one in ((STABLE, _compile_stable), (CUDA, _compile_cuda)):
        if (target / name).exists():
            said[name] = "as before"
            continue
        try:
            made = compile_one(scratch)
        except (OSError, subprocess.SubprocessError, StopIteration) as error:
            output = getattr(error, "stderr", None) or getattr(error, "output", None) or str(error)
            said[name] = f"is compiled there, since here it fails: {output.strip()[-300:]}"
            continue
        shutil.copy2(made, target / name)
        said[name] = f"compiled, {made.stat().st_size / 1e6:.1f} MB"
    stamp.write_text(digest)
    return said


def place(carried: Path, packages: Path, scratch: Path) -> Row:
    """On the GPU machine: put both libraries beside their Python modules, compiled there if those carried do not fit.

    Args:
        carried: The folder that ``compile_beforehand`` filled.
        packages: The folder that ``splatpipe`` is imported from.
        scratch: Folder for objects.

    Returns:
        For each library where it came from.

    Raises:
        SystemExit: if one can neither be loaded nor compiled.
    """
    room, said = packages.joinpath("splatpipe", *ROOM), Row()
    for name in (STABLE, CUDA):
        patterns = ("_native*.so",) if name == STABLE else (CUDA,)
        for found in (path for pattern in patterns for path in carried.glob(pattern)):
            shutil.copy2(found, room / found.name)
        if os.environ.get("SPLATPIPE_HARNESS") and name == CUDA:
            said[name] = "the harness's in its place"
        elif why := _misfit(name, packages):
            for found in (path for pattern in patterns for path in room.glob(pattern)):
                found.unlink()
            target = "_native" if name == STABLE else "splat_cuda"
            try:
                made = _compile_here(scratch / "build", target)
            except (OSError, subprocess.SubprocessError, StopIteration) as error:
                output = getattr(error, "stderr", None) or getattr(error, "output", None) or str(error)
                raise SystemExit(f"{name} does not fit ({why}) and does not compile: {output!s:.1000}") from error
            shutil.copy2(made, room / made.name)
            said[name] = f"compiled here, since the carried one does not fit: {why}"
        else:
            said[name] = "as carried"
    return said


def _misfit(name: str, packages: Path) -> str:
    """Return why a placed library does not fit; "" if it does."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(packages), os.environ.get("PYTHONPATH", "")])}
    words = [sys.executable, "-c", FITS[name]]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=environment, timeout=60)
    except subprocess.TimeoutExpired:
        return "it does not answer"
    return "" if done.returncode == 0 else (done.stderr.strip().splitlines() or ["it ends without a word"])[-1][:300]


def _compile_stable(scratch: Path) -> Path:
    """Compile the CPU's module for the stable ABI of Python 3.12, with Debian's headers of a later one."""
    headers = _headers(scratch / "headers")
    include = next(iter(headers.glob("usr/include/python3.*")))
    options = [
        f"-DCMAKE_MODULE_PATH={FIND_PYTHON}",
        f"-DSPLATPIPE_PYTHON_HEADERS={include};{include.parent}",
        f"-DPython_EXECUTABLE={sys.executable}",
    ]
    made = _cmake(scratch / "stable", "_native", options, {"SPLATPIPE_CUDA": "off"})
    return Path(shutil.copy2(made, scratch / STABLE))


def _compile_cuda(scratch: Path) -> Path:
    """Compile the CUDA kernels for the machine's cards, with line numbers for the sanitizer."""
    options = [f"-DPython_EXECUTABLE={sys.executable}", "-DCMAKE_CUDA_FLAGS=-lineinfo"]
    options += [f"-DPython_INCLUDE_DIR={path}" for path in _own_headers()]
    return _cmake(scratch / "cuda", "splat_cuda", options, {"SPLATPIPE_CUDA": ARCHITECTURE})


def _compile_here(scratch: Path, target: str) -> Path:
    """Compile a library for this machine."""
    options = [f"-DPython_EXECUTABLE={sys.executable}", "-DCMAKE_CUDA_FLAGS=-lineinfo"]
    return _cmake(scratch, target, options, {"SPLATPIPE_CUDA": "auto"}, COMPILE_S)


def _cmake(
    scratch: Path, target: str, options: list[str], environment: dict[str, str], timeout_s: float | None = None
) -> Path:
    """Configure and build one target of the project's own CMake; return the library."""
    programs = [str(Path(sys.executable).parent), os.environ.get("PATH", ""), "/usr/local/cuda/bin"]
    environment = {**os.environ, **environment, "PATH": os.pathsep.join(programs)}

    def run(words: list[str]) -> str:
        output = subprocess.run(words, check=True, capture_output=True, text=True, env=environment, timeout=timeout_s)
        return output.stdout.strip()

    nanobind = run([sys.executable, "-m", "nanobind", "--cmake_dir"])
    words = ["cmake", "-S", str(NATIVE), "-B", str(scratch), "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release"]
    run([*words, f"-DCMAKE_PREFIX_PATH={nanobind}", *options])
    run(["cmake", "--build", str(scratch), "--target", target])
    pattern = "_native*.so" if target == "_native" else "cuda/libsplat_cuda.so"
    return next(iter(scratch.glob(pattern)))


def _headers(folder: Path) -> Path:
    """Fetch and unpack Debian's headers of Python, without installing them."""
    if not any(folder.glob("usr/include/python3.*")):
        lists = folder / "apt"
        (lists / "lists" / "partial").mkdir(parents=True, exist_ok=True)
        (lists / "sources.list").write_text(DEBIAN + "\n")
        places = {"Etc::sourcelist": lists / "sources.list", "Etc::sourceparts": "-", "State::Lists": lists / "lists"}
        options = [word for key, value in places.items() for word in ("-o", f"Dir::{key}={value}")]
        options += ["-o", f"Dir::Cache={lists}"]
        for words in (["update"], ["download", HEADERS]):
            subprocess.run(["apt-get", "-q", *options, *words], check=True, capture_output=True, text=True, cwd=folder)
        package = next(iter(folder.glob(f"{HEADERS}*.deb")))
        subprocess.run(["dpkg", "-x", str(package), str(folder)], check=True, capture_output=True, text=True)
    return folder


def _own_headers() -> list[Path]:
    """Return this Python's headers where `make` has unpacked them, if they are not where CMake looks."""
    if (Path(sysconfig.get_path("include")) / "Python.h").exists():
        return []
    return list((Path(sys.prefix) / "headers" / "usr" / "include").glob("python3.*"))[:1]
