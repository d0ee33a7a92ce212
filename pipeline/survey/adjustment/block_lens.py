"""A lens in a block: what an adjustment may change in it, and how pixels depend on that."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.sfm.lenses.lens_model import NAMES

LENS_STEP = 1e-3  # step of central differences with respect to a lens parameter, pixels at the image's corner
LENGTHS = frozenset({"f", "cx", "cy"})  # parameters in pixels
RAY_STEP = 1e-5
MIN_DEPTH = 1e-6  # metres in front of a camera


@dataclass(frozen=True)
class Lens:
    """A lens and what an adjustment may change in it.

    Attributes:
        camera: COLMAP's.
        names: Of the free parameters: those of the wide models, but ``f`` for both focal lengths together and
            ``aspect`` for the second one's relative excess.
        directions: Change of the camera's parameters per unit of each.
        values: Their present values.
        mean: Prior means.
        sigmas: Prior standard deviations; infinite for none.
    """

    camera: pycolmap.Camera
    names: tuple[str, ...]
    directions: Float64[np.ndarray, "k _"]
    values: Float64[np.ndarray, " k"]
    mean: Float64[np.ndarray, " k"]
    sigmas: Float64[np.ndarray, " k"]

    def moved(self, step: Float64[np.ndarray, " k"]) -> Lens:
        """The same lens with its free parameters changed."""
        return replace(self, camera=self.after(step), values=self.values + step)

    def after(self, step: Float64[np.ndarray, " k"]) -> pycolmap.Camera:
        """The camera with the free parameters changed."""
        camera = pycolmap.Camera(self.camera.todict())
        camera.params = np.asarray(self.camera.params, np.float64) + step @ self.directions
        return camera


def free_lens(
    camera: pycolmap.Camera, names: Sequence[str], mean: Mapping[str, float], sigmas: Mapping[str, float]
) -> Lens:
    """A lens with some free parameters.

    Args:
        camera: Of a wide model.
        names: Of the free parameters.
        mean: Prior means by name; missing ones are the present values.
        sigmas: Prior standard deviations by name; missing ones are infinite.
    """
    own, params = NAMES.get(camera.model_name, ()), np.asarray(camera.params, np.float64)
    directions = np.zeros((len(names), len(params)))
    values = np.zeros(len(names))
    for row, name in enumerate(names):
        if name == "f":
            directions[row, :2], values[row] = (1.0, params[1] / params[0]), params[0]
        elif name == "aspect":
            directions[row, 1], values[row] = params[0], params[1] / params[0] - 1.0
        else:
            directions[row, own.index(name)], values[row] = 1.0, params[own.index(name)]
    return Lens(
        pycolmap.Camera(camera.todict()),
        tuple(names),
        directions,
        values,
        np.array([mean.get(name, value) for name, value in zip(names, values.tolist(), strict=True)]),
        np.array([sigmas.get(name, np.inf) for name in names]),
    )


def lens_derivatives(
    lens: Lens, rays: Float64[np.ndarray, "m 3"], parameters: bool
) -> tuple[Float64[np.ndarray, "m 2 3"], Float64[np.ndarray, "m 2 k"], Float64[np.ndarray, "m 2"]]:
    """Derivatives of pixels by the point in the camera's axes and by the free parameters, and the pixels."""
    depth = rays[:, 2:]
    flat = rays / np.where(depth > MIN_DEPTH, depth, np.nan)
    columns = []
    for axis in range(2):
        step = np.zeros(3)
        step[axis] = RAY_STEP
        columns.append((project(lens.camera, flat + step) - project(lens.camera, flat - step)) / (2.0 * RAY_STEP))
    by_flat = np.stack(columns, axis=2)
    inner = np.zeros((len(rays), 2, 3))
    inner[:, 0, 0] = inner[:, 1, 1] = 1.0
    inner[:, :, 2] = -flat[:, :2]
    by_ray = by_flat @ (inner / depth[:, :, None])
    by_lens = np.zeros((len(rays), 2, len(lens.names)))
    for k, name in enumerate(lens.names if parameters else ()):
        step = np.zeros(len(lens.names))
        step[k] = LENS_STEP if name in LENGTHS else LENS_STEP / lens.camera.width
        ahead, back = project(lens.after(step), flat), project(lens.after(-step), flat)
        by_lens[:, :, k] = (ahead - back) / (2.0 * step[k])
    return by_ray, by_lens, project(lens.camera, flat)


def project(camera: pycolmap.Camera, rays: Float64[np.ndarray, "m 3"]) -> Float64[np.ndarray, "m 2"]:
    """Pixels of points in the camera's axes; NaN where a ray is not finite."""
    if len(rays) == 0:
        return np.zeros((0, 2))
    sound = np.isfinite(rays).all(axis=1)
    result = np.full((len(rays), 2), np.nan)
    result[sound] = np.asarray(camera.img_from_cam(rays[sound]), np.float64)
    return result
