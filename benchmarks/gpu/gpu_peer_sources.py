"""Pack the peers' sources for the GPU machine, trimmed to what is timed there. They are not ours: never committed."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path

DESCRIPTION = "peer.json"
CHANNELS = 3  # the only number that gsplat is compiled for: 19 are instantiated, and take most of its compiler's time
INSTANCES = re.compile(r"^\s*__(?:INS|LAUNCH_KERNEL)__\((\d+)\)\s*$\n", re.MULTILINE)
SECTIONS = "-ffunction-sections"  # with `DROP_UNUSED`: what nothing calls needs no definition of what it calls
DROP_UNUSED = "-Wl,--gc-sections"
GSPLAT_CALLS = (
    "adam",
    "intersect_tile",
    "intersect_offset",
    "projection_ewa_3dgs_fused_fwd",
    "projection_ewa_3dgs_fused_bwd",
    "rasterize_to_pixels_3dgs_fwd",
    "rasterize_to_pixels_3dgs_bwd",
    "spherical_harmonics_fwd",
    "spherical_harmonics_bwd",
)
GSPLAT_SOURCES = (
    *("Adam.cpp", "AdamCUDA.cu", "Intersect.cpp", "IntersectTile.cu", "Projection.cpp", "ProjectionEWA3DGSFused.cu"),
    *("Rasterization.cpp", "RasterizeToPixels3DGSBwd.cu", "RasterizeToPixels3DGSFwd.cu"),
    *("SphericalHarmonics.cpp", "SphericalHarmonicsCUDA.cu"),
)
GSPLAT_BINDINGS = """#include <torch/extension.h>
#include "Ops.h"
#include "Cameras.h"
PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    py::enum_<gsplat::CameraModelType>(m, "CameraModelType").value("PINHOLE", gsplat::CameraModelType::PINHOLE);
%s}
"""
FASTER_GS_BINDINGS = """#include <torch/extension.h>
#include "rasterization_api.h"
#include "adam.h"
PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.def("forward", &faster_gs::rasterization::forward_wrapper);
    m.def("backward", &faster_gs::rasterization::backward_wrapper);
    m.def("adam_step", &faster_gs::adam::adam_step_wrapper);
}
"""
# What CUDA 13 no longer has, and a name that C++20's own function takes; torch's headers decide the standard.
FASTER_GS_CHANGES = (
    (r"cub::Max\(\)", "[](uint one, uint other) { return one > other ? one : other; }"),
    (r"\blerp\b", "lerp_between"),
)


@dataclass(frozen=True)
class PeerBuild:
    """How a packed peer is compiled.

    Attributes:
        extension: Name of the compiled module.
        beside: The package that it lies in; "" beside the packages.
        packages: Folders of Python packages.
        sources: What is compiled.
        includes: Folders of headers.
        cxx, nvcc, linker: Flags.
        version: The peer's own, or a digest of its sources.
    """

    extension: str
    beside: str
    packages: tuple[str, ...]
    sources: tuple[str, ...]
    includes: tuple[str, ...]
    cxx: tuple[str, ...]
    nvcc: tuple[str, ...]
    linker: tuple[str, ...] = ()
    version: str = ""


def pack_peers(folder: Path | None, target: Path) -> dict[str, str]:
    """Pack each peer that a folder has.

    Args:
        folder: With ``gsplat`` (a 1.5.3 wheel's or source tree), ``faster-gaussian-splatting`` and ``fused-ssim``; None
            for those that are packed already.
        target: Folder for one folder a peer.

    Returns:
        For each peer its version, or why it is left out.
    """
    said = {}
    for name, (source, pack) in PEERS.items():
        if folder is None and (target / name / DESCRIPTION).exists():
            said[name] = "as before"
            continue
        shutil.rmtree(target / name, ignore_errors=True)
        if folder is None or not (folder / source).is_dir():
            said[name] = f"left out: there is no {source} in the folder of peers"
            continue
        try:
            build = pack(folder / source, target / name)
        except (OSError, ValueError) as error:
            shutil.rmtree(target / name, ignore_errors=True)
            said[name] = f"left out: {error}"
            continue
        (target / name / DESCRIPTION).write_text(json.dumps(asdict(build), indent=1))
        said[name] = build.version
    return said


def _pack_gsplat(source: Path, target: Path) -> PeerBuild:
    package, made = source / "gsplat", target / "gsplat"
    version = re.search(r'"(.+)"', (package / "version.py").read_text())
    if version is None or version[1] != "1.5.3":
        raise ValueError("it is not gsplat 1.5.3")
    _copy(package, made, lambda path: path.suffix == ".py")
    csrc, include = Path("cuda", "csrc"), Path("cuda", "include")
    _copy(package / include, made / include, lambda path: path.suffix in (".h", ".cuh"))
    flat = set(GSPLAT_SOURCES)
    _copy(package / csrc, made / csrc, lambda p: p.parent == Path() and (p.suffix in (".h", ".cuh") or p.name in flat))
    glm = csrc / "third_party" / "glm"
    _copy(package / glm / "glm", made / glm / "glm", lambda path: path.suffix in (".hpp", ".h", ".inl"))
    for name in GSPLAT_SOURCES:
        path = made / csrc / name
        path.write_text(INSTANCES.sub(lambda m: m[0] if int(m[1]) == CHANNELS else "", path.read_text()))
    calls = "".join(f'    m.def("{name}", &gsplat::{name});\n' for name in GSPLAT_CALLS)
    (made / "cuda" / "ext.cpp").write_text(GSPLAT_BINDINGS % calls)
    sources = ("gsplat/cuda/ext.cpp", *(f"gsplat/cuda/csrc/{name}" for name in GSPLAT_SOURCES))
    cxx, nvcc = ("-O3", "-Wno-attributes", SECTIONS), ("-O3", "-use_fast_math", "-Xcompiler", SECTIONS)
    includes = ("gsplat/cuda/include", f"gsplat/{glm}")
    return PeerBuild("csrc", "gsplat", ("gsplat",), sources, includes, cxx, nvcc, (DROP_UNUSED,), "1.5.3")


def _pack_faster_gs(source: Path, target: Path) -> PeerBuild:
    name = "FasterGSCudaBackend"
    package, made = source / name / name, target / name
    rooms = ("adam", "rasterization", "utils")
    for room in rooms:
        _copy(package / room, made / room, lambda path: path.suffix in (".h", ".cuh", ".cu"))
    for file in ("rasterization.py", "adam.py"):
        _copy(package / "torch_bindings", made / "torch_bindings", lambda path, file=file: path.name == file)
    for path in filter(Path.is_file, made.rglob("*")):
        text = path.read_text()
        for pattern, instead in FASTER_GS_CHANGES:
            text = re.sub(pattern, instead, text)
        path.write_text(text)
    (made / "__init__.py").touch()
    (made / "torch_bindings" / "__init__.py").touch()
    (made / "bindings.cpp").write_text(FASTER_GS_BINDINGS)
    sources = (made / "bindings.cpp", *sorted(made.rglob("*.cu")))
    listed = tuple(str(path.relative_to(target)) for path in sources)
    includes = (f"{name}/utils", f"{name}/adam/include", f"{name}/rasterization/include")
    nvcc = ("-O3", "-use_fast_math")
    return PeerBuild("_C", name, (name,), listed, includes, ("-O3",), nvcc, (), _digest(made))


def _pack_fused_ssim(source: Path, target: Path) -> PeerBuild:
    _copy(source / "fused_ssim", target / "fused_ssim", lambda path: path.suffix == ".py")
    files = ("ssim.cu", "ssim3d.cu", "ext.cpp", "ssim.h", "ssim3d.h")
    _copy(source, target / "csrc", lambda path: str(path) in files)
    sources = tuple(f"csrc/{name}" for name in files[:3])
    flags = ("-O3", "-DFUSED_SSIM_CUDA")
    nvcc = (*flags, "--maxrregcount=32", "--use_fast_math")
    return PeerBuild("fused_ssim_cuda", "", ("fused_ssim",), sources, ("csrc",), flags, nvcc, (), _digest(target))


def _copy(source: Path, target: Path, wanted: Callable[[Path], bool]) -> None:
    """Copy the files of a folder whose paths in it are wanted.

    Raises:
        ValueError: if there is none.
    """
    found = [path for path in sorted(source.rglob("*")) if path.is_file() and wanted(path.relative_to(source))]
    if not found:
        raise ValueError(f"there is nothing to pack in {source.name}")
    for path in found:
        to = target / path.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, to)


def _digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return "sources " + sha256(b"".join(path.read_bytes() for path in files)).hexdigest()[:12]


PEERS: dict[str, tuple[str, Callable[[Path, Path], PeerBuild]]] = {
    "gsplat": ("gsplat", _pack_gsplat),
    "faster-gs": ("faster-gaussian-splatting", _pack_faster_gs),
    "fused-ssim": ("fused-ssim", _pack_fused_ssim),
}
