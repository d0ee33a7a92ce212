"""Lenses as COLMAP's camera models: parameter names, and conversion to wider and narrower models.

Calibration uses the widest model of a kind, FULL_OPENCV or OPENCV_FISHEYE, with one focal length for both axes; the
result is stored as the narrowest equivalent model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from jaxtyping import Float64

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.geometry.similarity import rotation_from_vector

WIDE, WIDE_FISHEYE = "FULL_OPENCV", "OPENCV_FISHEYE"
FISHEYES = frozenset({"SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", "SIMPLE_FISHEYE", "FISHEYE"})
NAMES = {
    WIDE: ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    WIDE_FISHEYE: ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}
MODELS_BY_SIZE = {  # COLMAP's models of each kind, fewest parameters first
    WIDE: ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"),
    WIDE_FISHEYE: ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"),
}
PARAMETERS = {  # a model's parameters, by the names of the wide models; f is both focal lengths
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": NAMES[WIDE],
    "SIMPLE_FISHEYE": ("f", "cx", "cy"),
    "FISHEYE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV_FISHEYE": NAMES[WIDE_FISHEYE],
}
GRID = 21  # samples along each side of the image where two lenses are compared


@dataclass(frozen=True)
class StatedLens:
    """A lens stated by a file or the photos' metadata.

    Attributes:
        model: COLMAP's camera model.
        width: Width of the images that ``params`` refer to, in the same unit: pixels, once it is fitted to photos.
        height: Likewise.
        params: COLMAP's parameters, in that unit; the centre of the first pixel is (0.5, 0.5).
        source: ``file``, ``lens-file``, ``xmp-dewarp``.
        camera: The camera's name in the file; empty if it has none.
    """

    model: str
    width: int | float
    height: int | float
    params: tuple[float, ...]
    source: str
    camera: str = ""

    def colmap(self, number: int = 1) -> pycolmap.Camera:
        """Return the lens as a COLMAP camera."""
        return pycolmap.Camera(
            camera_id=number,
            model=self.model,
            width=round(self.width),
            height=round(self.height),
            params=list(self.params),
        )


def stated_lenses(lenses: Sequence[JSON]) -> dict[int, StatedLens]:
    """Read the lenses of the artifact ``ingest.lenses``, in each camera group's pixels, by COLMAP's camera id."""
    return {
        number: StatedLens(**{**lens, "params": tuple(lens["params"])})
        for number, lens in enumerate(lenses, start=1)
        if lens is not None
    }


def is_known(model: str) -> bool:
    """Whether a camera model is one that calibration can widen."""
    return model in PARAMETERS


def kind_of(model: str) -> str:
    """Return the widest model of the same kind."""
    return WIDE_FISHEYE if model in FISHEYES else WIDE


def named_params(camera: pycolmap.Camera) -> dict[str, float]:
    """Return all parameters of the camera's wide model by name."""
    own = dict(zip(PARAMETERS[camera.model_name], (float(value) for value in camera.params), strict=True))
    if "f" in own:
        own["fx"] = own["fy"] = own.pop("f")
    return {name: own.get(name, 0.0) for name in NAMES[kind_of(camera.model_name)]}


def set_lens(camera: pycolmap.Camera, model: str, named: Mapping[str, float]) -> None:
    """Change a camera's model and parameters in place; its image size and id stay."""
    focal = 0.5 * (named["fx"] + named["fy"])
    camera.model = pycolmap.CameraModelId.__members__[model]
    camera.params = [focal if name == "f" else named[name] for name in PARAMETERS[model]]


def widen(camera: pycolmap.Camera) -> None:
    """Convert a camera in place to the widest model of its kind; its projection stays the same."""
    set_lens(camera, kind_of(camera.model_name), named_params(camera))


def narrow(camera: pycolmap.Camera) -> None:
    """Convert a camera in place to the narrowest model of its kind with the same projection."""
    named = named_params(camera)
    for model in MODELS_BY_SIZE[kind_of(camera.model_name)]:
        kept = PARAMETERS[model]
        lost = [name for name in named if name not in kept and name not in ("fx", "fy")]
        if all(named[name] == 0.0 for name in lost) and ("f" not in kept or named["fx"] == named["fy"]):
            set_lens(camera, model, named)
            return


def picture_rays(width: int, height: int, camera: pycolmap.Camera) -> Float64[np.ndarray, "n 2"]:
    """Return x/z and y/z of the camera's rays on a grid over the image; not finite where there is no ray."""
    x, y = np.meshgrid(np.linspace(0.0, width, GRID), np.linspace(0.0, height, GRID))
    return np.asarray(camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)), np.float64)


def simplest(lens: pycolmap.Camera) -> tuple[str, tuple[float, ...]]:
    """Fit the simple model with a centred principal point that is nearest to a lens, as the start for mapping.

    Least squares over the image, in pixels: both unknowns, f and f k1, are linear.

    Returns:
        SIMPLE_RADIAL or, for a fisheye, SIMPLE_RADIAL_FISHEYE, and its parameters.
    """
    fisheye = kind_of(lens.model_name) == WIDE_FISHEYE
    x, y = np.meshgrid(np.linspace(0.0, lens.width, GRID), np.linspace(0.0, lens.height, GRID))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    rays = np.asarray(lens.cam_from_img(pixels), np.float64)
    good = np.isfinite(rays).all(axis=1)
    rays, pixels = rays[good], pixels[good]
    tangent = np.linalg.norm(rays, axis=1)
    if fisheye:
        rays = rays * (np.arctan(tangent) / np.maximum(tangent, 1e-12))[:, None]
        tangent = np.arctan(tangent)
    named = named_params(lens)
    away = (pixels - [named["cx"], named["cy"]]).ravel()
    design = np.stack([rays.ravel(), (rays * (tangent**2)[:, None]).ravel()], axis=1)
    solved, *_ = np.linalg.lstsq(design, away, rcond=None)
    focal, k = float(solved[0]), float(solved[1] / solved[0])
    return "SIMPLE_RADIAL_FISHEYE" if fisheye else "SIMPLE_RADIAL", (focal, lens.width / 2, lens.height / 2, k)


def apart_px(found: pycolmap.Camera, other: pycolmap.Camera, turn: bool = False) -> Float64[np.ndarray, " n"]:
    """Compare where two lenses project the rays of a grid over the image.

    Args:
        found: One lens.
        other: Another lens of the same image size; the grid covers its image.
        turn: First remove the small common rotation that fits best, which the poses would absorb.

    Returns:
        Distances, pixels; infinite where one of the lenses has no projection.
    """
    rays = picture_rays(other.width, other.height, other)
    rays = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    want = np.asarray(other.img_from_cam(rays), np.float64)
    rotation = np.eye(3)
    for _ in range(6 if turn else 0):
        turned = rays @ rotation.T
        have = np.asarray(found.img_from_cam(turned), np.float64)
        step, columns = 1e-6, []
        for axis in np.eye(3):
            moved = np.asarray(found.img_from_cam(turned + step * np.cross(axis, turned)), np.float64)
            columns.append(((moved - have) / step).ravel())
        design, residual = np.stack(columns, axis=1), (want - have).ravel()
        good = np.isfinite(residual) & np.isfinite(design).all(axis=1)
        angle, *_ = np.linalg.lstsq(design[good], residual[good], rcond=None)
        rotation = rotation_from_vector(angle) @ rotation
    have = np.asarray(found.img_from_cam(rays @ rotation.T), np.float64)
    distance = np.linalg.norm(have - want, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def indices(model: str, names: Sequence[str]) -> list[int]:
    """Return the indices of parameters of a wide model."""
    return [NAMES[model].index(name) for name in names]
