"""What training requires of the CUDA kernels besides frames, with tolerances: for ``checking``, without torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from frames import PARAMETERS, DeviceFrame, Memory, RenderCase, RenderOutcome, pointer, rows_of

from splatpipe.pipeline.raster.cuda.cuda_api import SplatRectangle, SplatStep
from splatpipe.pipeline.raster.cuda.cuda_library import CudaLibrary

LOSS = 1e-5
LOSS_GRADIENT = 5e-5
"""Relative, the gradient in L2; as in test_loss.py."""
STEP = 1e-4
"""Relative L2 error of the change in values and moments: that of their gradients."""
FLOAT = 2.0**-24
"""Rounding of the stored values."""
OFFSETS = 1e-5
"""As in test_cuda_loss.py: the device's logarithm, cosine and exponential, of scales about one."""
BETAS, EPSILON, COUNT = (0.9, 0.999), 1e-15, 7
RATES = {"means": 1e-3, "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 5e-2, "sh": 2.5e-3}
RATE_SH_REST = 2.5e-3 / 20
SCALES = (-2.0, 0.5)  # to which log_scales are clamped
KEY = (5, 600, 2)  # key of the random numbers: seed, step, purpose


@dataclass(frozen=True)
class Loss:
    """A loss of render and photo (h, w, 3) over an inner window where the mask (h, w) is not zero; its gradient."""

    render: np.ndarray
    photo: np.ndarray
    mask: np.ndarray
    inner: tuple[int, int, int, int]
    weight: float
    value: float
    gradient: np.ndarray

    def complaints(self, library: CudaLibrary) -> Iterator[str]:
        height, width = self.mask.shape
        at = Memory()
        size = library.size("splat_loss_bytes", width, height)
        memory = at.empty("memory", (size,), np.uint8)
        given = [at.put(name, getattr(self, name)) for name in ("render", "photo", "mask")]
        gradient, value = at.empty("gradient", self.render.shape), at.empty("value", (1,), np.float64)
        pictures = (*map(pointer, given), width, height, SplatRectangle(*self.inner), self.weight)
        library.call("splat_photo_loss", *pictures, pointer(gradient), pointer(value), pointer(memory), size, None)
        yield from (f"written beside {name}" for name in at.overrun())
        if not abs(value[0] - self.value) <= LOSS * self.value:
            yield f"the loss is {value[0]}, not {self.value}"
        error = np.linalg.norm(gradient.astype(np.float64) - self.gradient) / np.linalg.norm(self.gradient)
        if not error <= LOSS_GRADIENT:
            yield f"gradient of the loss: {error:.1e}"


def step_complaints(library: CudaLibrary, case: RenderCase, exact: RenderOutcome) -> Iterator[str]:
    """Check the fused backward pass and Adam step (Kingma and Ba, ICLR 2015) on the visible rows."""
    rng = np.random.default_rng(8)
    start = {"value": case.rows}
    start["mean"] = {name: (1e-2 * rng.normal(size=rows.shape)).astype(np.float32) for name, rows in case.rows.items()}
    start["square"] = {name: (1e-4 * rng.random(rows.shape)).astype(np.float32) for name, rows in case.rows.items()}
    frame = DeviceFrame(library, case)
    frame.forward()
    frame.blend_backward()
    now = {
        kind: {name: frame.at.put(f"{kind} of {name}", rows) for name, rows in group.items()}
        for kind, group in start.items()
    }
    skipped = frame.at.put("skipped", np.zeros(1, np.int64))
    step = SplatStep(*map(rows_of, now.values()), rate_sh_rest=RATE_SH_REST, skipped=pointer(skipped), sparse=1)
    step.rows = case.count * 3 // 4  # the others are rendered around them
    step.rates[:] = list(RATES.values())
    step.beta1, step.beta2, step.epsilon, step.step = *BETAS, EPSILON, COUNT
    step.log_scale_min, step.log_scale_max = SCALES
    library.call("splat_step", frame.shot, frame.frame, step, None, None)
    yield from (f"written beside {name}" for name in frame.at.overrun())
    if skipped[0]:
        yield f"{skipped[0]} rows were left out"
    seen = (exact.pictures["visible"] == 1) & (np.arange(case.count) < step.rows)
    for name in PARAMETERS:
        expected = stepped(name, {kind: group[name] for kind, group in start.items()}, exact.gradients[name], seen)
        for kind, array in expected.items():
            array[step.rows :] = start[kind][name][step.rows :]  # nor are these limited
            before, after = (group[kind][name].astype(np.float64) for group in (start, now))
            error, moved = np.linalg.norm(after - array), np.linalg.norm(array - before)
            if not error <= STEP * moved + FLOAT * np.linalg.norm(array):
                yield f"{kind} of {name} after a step: {error:.1e} of {moved:.1e}"


def stepped(name: str, old: dict[str, np.ndarray], gradient: np.ndarray, seen: np.ndarray) -> dict[str, np.ndarray]:
    """Return a parameter's values and moments after a step, in float64."""
    rows = seen.reshape(-1, *[1] * (gradient.ndim - 1))
    rate: float | np.ndarray = RATES[name]
    if name == "sh":
        rate = np.full(gradient.shape[1:], RATE_SH_REST)
        rate[0] = RATES[name]
    values, means, squares = (old[kind].astype(np.float64) for kind in ("value", "mean", "square"))
    next_means = BETAS[0] * means + (1.0 - BETAS[0]) * gradient
    next_squares = BETAS[1] * squares + (1.0 - BETAS[1]) * gradient**2
    corrected = next_means / (1.0 - BETAS[0] ** COUNT), next_squares / (1.0 - BETAS[1] ** COUNT)
    next_values = np.where(rows, values - rate * corrected[0] / (np.sqrt(corrected[1]) + EPSILON), values)
    if name == "log_scales":
        next_values = next_values.clip(*SCALES)
    return {
        "value": next_values,
        "mean": np.where(rows, next_means, means),
        "square": np.where(rows, next_squares, squares),
    }


@dataclass(frozen=True)
class Draws:
    """Density control's random numbers for ``KEY``.

    Attributes:
        uniform: The first ones, (n).
        rows: Gaussians that are split, (k).
        log_scales: Of all Gaussians, (m, 3).
        quats: Of all Gaussians, (m, 4).
        offsets: Offsets of the split halves, (2 k, 3).
        means: Places in the unit cube, (p, 3).
        keys: Morton codes of these places, (p).
    """

    uniform: np.ndarray
    rows: np.ndarray
    log_scales: np.ndarray
    quats: np.ndarray
    offsets: np.ndarray
    means: np.ndarray
    keys: np.ndarray

    def complaints(self, library: CudaLibrary) -> Iterator[str]:
        at = Memory()
        uniform, offsets = at.empty("uniform", self.uniform.shape, np.float64), at.empty("offsets", self.offsets.shape)
        keys = at.empty("keys", self.keys.shape, np.int64)
        library.call("splat_uniform", *KEY, len(uniform), pointer(uniform), None)
        parents = pointer(self.rows), len(self.rows), pointer(self.log_scales), pointer(self.quats)
        library.call("splat_split_offsets", *KEY, *parents, pointer(offsets), None)
        lowest, size = (np.full(3, value, np.float32) for value in (0.0, 1.0))
        corner = (np.ctypeslib.as_ctypes(each) for each in (lowest, size))
        library.call("splat_morton", pointer(self.means), len(keys), *corner, pointer(keys), None)
        yield from (f"written beside {name}" for name in at.overrun())
        if (uniform != self.uniform).any():
            yield "other random numbers"
        if not (np.abs(offsets - self.offsets) <= OFFSETS).all():
            yield "halves of a split lie elsewhere"
        if (keys != self.keys).any():
            yield "other places on the Morton curve"
