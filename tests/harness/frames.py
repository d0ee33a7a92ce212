"""Frames through the CUDA kernels' C interface in this machine's memory. Without torch: faults run separately."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from building import FORWARD, REVERSE, SHUFFLED

from splatpipe.pipeline.raster.cuda.cuda_api import (
    SplatFrame,
    SplatFrameFacts,
    SplatPictureGradients,
    SplatPictures,
    SplatRows,
    SplatShot,
)
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

ORDERS = ((FORWARD, 0), (REVERSE, 0), (SHUFFLED, 1))
PARAMETERS = ("means", "log_scales", "quats", "opacity_logits", "sh")
GREY = ("alpha", "depth_sum", "depth_square_sum")
POISON = 0x7FA5A5A5
GUARD_BYTES = 1024
ALIGNMENT = 256


class Memory:
    """Arrays as on a device: filled with signalling NaN, with guards on both sides."""

    def __init__(self) -> None:
        self._all: list[tuple[str, np.ndarray, int, int]] = []

    def empty(self, name: str, shape: tuple[int, ...], dtype: type = np.float32) -> np.ndarray:
        size = int(np.prod(shape)) * np.dtype(dtype).itemsize
        words = np.full((size + 2 * GUARD_BYTES + ALIGNMENT) // 4 + 1, POISON, np.uint32)
        raw = words.view(np.uint8)
        begin = GUARD_BYTES + -(raw.ctypes.data + GUARD_BYTES) % ALIGNMENT
        self._all.append((name, raw, begin, size))
        return raw[begin : begin + size].view(dtype).reshape(shape)

    def put(self, name: str, values: np.ndarray) -> np.ndarray:
        copy = self.empty(name, values.shape, values.dtype.type)
        copy[...] = values
        return copy

    def overrun(self) -> list[str]:
        """Return the arrays that something was written beside."""
        found = []
        for name, raw, begin, size in self._all:
            guards = np.concatenate([raw[begin - GUARD_BYTES : begin], raw[begin + size : begin + size + GUARD_BYTES]])
            offset = (begin - GUARD_BYTES) % 4, (begin + size) % 4
            pattern = np.full(GUARD_BYTES // 4 + 2, POISON, np.uint32).view(np.uint8)
            expected = np.concatenate([pattern[at : at + GUARD_BYTES] for at in offset])
            if (guards != expected).any():
                found.append(name)
        return found


@dataclass(frozen=True)
class RenderCase:
    """A view of some Gaussians, and the upstream gradients of its images.

    Attributes:
        rows: Raw parameters by name, float32.
        pose: cam_from_world, (3, 4).
        intrinsics: fx, fy, cx, cy.
        size: Width and height, pixels.
        window: Left, top, width and height within the whole image, if this is a window; None for the whole.
        upstream: dL/d(image) by name: colour (h, w, 3), alpha, depth_sum, depth_square_sum (h, w).
    """

    rows: dict[str, np.ndarray]
    pose: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size: tuple[int, int]
    upstream: dict[str, np.ndarray] = field(default_factory=dict)
    sh_degree: int = 3
    near: float = 0.2
    depth_origin: float = 3.0
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialias: bool = False
    depths: bool = True
    magnitudes: bool = False
    window: tuple[int, int, int, int] | None = None

    @property
    def count(self) -> int:
        return len(self.rows["means"])

    def shot(self) -> SplatShot:
        shot = SplatShot(near_z=self.near, depth_origin=self.depth_origin, sh_degree=self.sh_degree)
        shot.cam_from_world[:] = self.pose.ravel().tolist()
        shot.fx, shot.fy, shot.cx, shot.cy = self.intrinsics
        shot.background[:] = self.background
        shot.width, shot.height = self.size
        shot.left, shot.top, shot.whole_width, shot.whole_height = self.window or (0, 0, *self.size)
        shot.sh_count = self.rows["sh"].shape[1]
        shot.antialias, shot.depths, shot.magnitudes = int(self.antialias), int(self.depths), int(self.magnitudes)
        return shot

    def changed(self, **changes: object) -> RenderCase:
        return replace(self, **changes)  # type: ignore[arg-type]


@dataclass(frozen=True)
class RenderOutcome:
    """Outcome of a case: images, radii and visibility; gradients by parameter and of means2d; the frame's facts."""

    pictures: dict[str, np.ndarray]
    gradients: dict[str, np.ndarray]
    facts: tuple[int, int, int] = (0, 0, 0)

    def differs(self, other: RenderOutcome) -> list[str]:
        """Return the names of results that are not bit-identical; the number of chunks is not a result."""
        ours, theirs = self.pictures | self.gradients, other.pictures | other.gradients
        names = [name for name in ours if ours[name].tobytes() != theirs[name].tobytes()]
        return names + [f"facts {self.facts} {other.facts}"] * (self.facts[:2] != other.facts[:2])


def pointer(array: np.ndarray | None) -> int | None:
    return None if array is None else array.ctypes.data


def rows_of(arrays: dict[str, np.ndarray]) -> SplatRows:
    return SplatRows(*(pointer(arrays[name]) for name in PARAMETERS))


class DeviceFrame:
    """A case on the device, starting with the forward pass."""

    def __init__(self, library: CudaLibrary, case: RenderCase, capacity: int = 1 << 16, passes: int = 1) -> None:
        self.library, self.case, self.at = library, case, Memory()
        self.shot = case.shot()
        count, capacity = case.count, max(capacity, case.count, 1)
        sizes = [library.size(name, self.shot, count, capacity) for name in ("splat_frame_bytes", "splat_back_bytes")]
        memory, back = (
            self.at.empty(name, (size,), np.uint8) for name, size in zip(("frame", "back"), sizes, strict=True)
        )
        self.frame = SplatFrame(pointer(memory), sizes[0], pointer(back), sizes[1], count, capacity, passes)
        self._memory = memory
        self._held = {name: self.at.put(name, np.ascontiguousarray(rows)) for name, rows in case.rows.items()}
        self.model = rows_of(self._held)

    def forward(self) -> dict[str, np.ndarray]:
        width, height = self.case.size
        names = ("colour", *GREY, "median_depth") if self.case.depths else ("colour", "alpha")
        pictures = {
            name: self.at.empty(name, (height, width, 3) if name == "colour" else (height, width)) for name in names
        }
        to = SplatPictures(**{name: pointer(picture) for name, picture in pictures.items()})
        radii = self.at.empty("radii", (self.case.count,))
        visible = self.at.empty("visible", (self.case.count,), np.uint8)
        self.library.call(
            "splat_forward", self.shot, self.model, self.frame, to, pointer(radii), pointer(visible), None
        )
        return pictures | {"radii": radii, "visible": visible}

    def facts(self) -> tuple[int, int, int]:
        facts = SplatFrameFacts.from_buffer(self._memory)
        return facts.pairs, facts.visible, facts.chunks

    def blend_backward(self) -> None:
        upstream = {
            name: self.at.put(f"d {name}", np.ascontiguousarray(value, np.float32))
            for name, value in self.case.upstream.items()
            if self.case.depths or not name.startswith("depth")
        }
        given = SplatPictureGradients(**{name: pointer(value) for name, value in upstream.items()})
        self.library.call("splat_blend_backward", self.shot, self.model, self.frame, given, None)

    def project_backward(self) -> dict[str, np.ndarray]:
        gradients = {name: self.at.empty(f"d {name}", rows.shape) for name, rows in self.case.rows.items()}
        means2d = self.at.empty("d means2d", (self.case.count, 2))
        to = rows_of(gradients)
        self.library.call("splat_project_backward", self.shot, self.model, self.frame, to, pointer(means2d), None)
        return gradients | {"means2d": means2d}


def run(library: CudaLibrary, case: RenderCase, capacity: int = 1 << 16, passes: int = 1) -> RenderOutcome:
    """Run forward and, if there are upstream gradients, backward; assert that nothing was written out of bounds."""
    frame = DeviceFrame(library, case, capacity, passes)
    pictures = frame.forward()
    gradients = {}
    if case.upstream:
        frame.blend_backward()
        gradients = frame.project_backward()
    assert not frame.at.overrun(), f"written beside {frame.at.overrun()}"
    return RenderOutcome(pictures, gradients, frame.facts())


def controls(library: CudaLibrary) -> ctypes.CDLL:
    """The harness's own functions in the same library."""
    from building import load

    return load(Path(library._functions._name))
