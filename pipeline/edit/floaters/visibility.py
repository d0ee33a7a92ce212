"""Visibility of each Gaussian in the photos: how much, in how many, over what angle, and whether it floats.

A Gaussian's visibility in a photo is the sum over the pixels of its blending weights α T. Projecting centres would not
do, since what lies in a photo's frustum may be hidden. The sum is the derivative of the image's sum with respect to the
Gaussian's colour, since a pixel is Σ αᵢ Tᵢ cᵢ (Kerbl et al. 2023, eq. 3): one backward pass per photo. Red, green and
blue may be weighted separately in that sum, so the same pass yields means over the visible part of a Gaussian, such as
the depth there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from torch import Tensor

from splatpipe.pipeline.edit.floaters.depth_islands import without_islands
from splatpipe.pipeline.edit.floaters.isolation import half_axes
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.pulled_back import pulled_back
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import C0
from splatpipe.pipeline.splat.sky.panorama import Panorama

MIN_VISIBLE_PX = 1e-3  # visible area in one photo, pixels, below which a Gaussian is not seen: less is rounding
NEAR_SHARE = 0.3  # of the depth where a photo's scene begins: nearer to its camera there is nothing, in any direction
BEGINS_PERCENTILE = 5  # of a photo's depths, where its scene begins
BORDER_SHARE = 0.08  # width of the border as a share of an image's shorter side: seen only there is hardly covered
IN_FRONT_SHARE = 0.005  # a Gaussian floats if it is that much, relative to the depth, in front of the background,
IN_FRONT_SIGMAS = 2.0  # and its least distance to it in its standard deviations along the view axis


@dataclass(frozen=True, eq=False)
class TrainingPhotos:
    """The photos that a splat was trained on.

    Attributes:
        cameras: Cameras of whole images at reduced size (``options.SEEN_MEGAPIXELS``).
        options: How the splat is rendered.
        picture: Returns a photo, (h, w, 3) RGB, and its mask at its camera's size; None if only cameras are known.
        sky: The panorama behind the splat, or None.
        compared: Indices of the photos that suspects are compared with, if there are pictures; None: all.
    """

    cameras: Sequence[Camera]
    options: rasterizer.RenderOptions
    picture: Callable[[int], tuple[Pixels, Mask | None]] | None = None
    sky: Panorama | None = field(default=None, repr=False)
    compared: Sequence[int] | None = None

    @property
    def compared_photos(self) -> Sequence[int]:
        """Indices of the photos that suspects are compared with."""
        return range(len(self.cameras)) if self.compared is None else self.compared


@dataclass(frozen=True, eq=False)
class GaussianVisibility:
    """Visibility of each Gaussian in all photos together.

    Attributes:
        weight: Σ w in pixels; w is a photo's sum of α T.
        photos: (Σ w)² / Σ w², the effective number of photos that see it; 0 if unseen.
        angle_deg: Weighted RMS angle between the rays to those photos and their mean direction; 0 if unseen.
        border: Share of its weight that lies at the images' borders.
        floating: Share of its visible area in photos where it lies in front of everything around it.
        gap: How far in front of its surroundings it lies as a share of their depth, weighted mean, -1..1.
        compared: Its weight in the photos that suspects are compared with.
        beside: Whether its centre is so near to a camera, before it, beside it or behind, that whoever took the photo
            must have seen past it.
    """

    weight: Float32[np.ndarray, " n"]
    photos: Float32[np.ndarray, " n"]
    angle_deg: Float32[np.ndarray, " n"]
    border: Float32[np.ndarray, " n"]
    floating: Float32[np.ndarray, " n"]
    gap: Float32[np.ndarray, " n"]
    compared: Float32[np.ndarray, " n"]
    beside: Bool[np.ndarray, " n"]


class _VisibilitySums:
    """Sums over the photos from which ``GaussianVisibility`` is computed."""

    def __init__(self, n: int) -> None:
        self.weight, self.square, self.border, self.compared = (np.zeros(n, np.float32) for _ in range(4))
        self.area, self.before, self.gap = (np.zeros(n, np.float32) for _ in range(3))
        self.towards = np.zeros((n, 3), np.float32)
        self.beside = np.zeros(n, np.bool_)

    def sightings(self) -> GaussianVisibility:
        def part(value: Float32[np.ndarray, " n"], of: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
            return np.asarray(np.divide(value, of, out=np.zeros_like(value), where=of > 0.0))

        together = np.minimum(part(np.linalg.norm(self.towards, axis=1), self.weight), 1.0)  # 1 if all rays coincide
        angle = np.rad2deg(np.sqrt(2.0 * (1.0 - together), dtype=np.float32))
        angle[self.weight == 0.0] = 0.0
        photos = part(self.weight * self.weight, self.square)
        border, before, gap = part(self.border, self.weight), part(self.before, self.area), part(self.gap, self.weight)
        return GaussianVisibility(self.weight, photos, angle, border, before, gap, self.compared, self.beside)


def measure_visibility(
    gaussians: Gaussians, photos: TrainingPhotos, on_progress: Callable[[int], None]
) -> GaussianVisibility:
    """Compute the visibility of each Gaussian in the photos.

    Args:
        gaussians: Finite Gaussians on the CPU or device that renders them.
        photos: The training photos; only their cameras are used.
        on_progress: Called with the number of photos done.
    """
    grey = grey_of(gaussians)
    plain = replace(photos.options, sh_degree=0, depth=True, magnitudes=False)
    centres, axes = gaussians.means.detach().numpy(force=True), half_axes(gaussians)
    sums, compared_indices = _VisibilitySums(len(gaussians)), set(photos.compared_photos)
    for index, camera in enumerate(photos.cameras):
        rendered = rasterizer.render(grey, camera, plain)
        behind = without_islands(rendered.median_depth.numpy(force=True))
        picture = np.stack([np.ones_like(behind), _border(camera), behind], axis=2)
        found = weights_of(rendered, grey, picture)
        rows = np.flatnonzero(found[:, 0] > MIN_VISIBLE_PX)
        _add(sums, rows, found[rows], camera, (centres[rows], axes[rows]))
        if index in compared_indices:
            sums.compared[rows] += found[rows, 0]
        sums.beside[_within(centres, camera, NEAR_SHARE * _begins(behind))] = True
        on_progress(index + 1)
    return sums.sightings()


def weights_of(
    rendered: rasterizer.Render, grey: Gaussians, picture: Float32[np.ndarray, "h w 3"]
) -> Float32[np.ndarray, "n 3"]:
    """Sums over a render's pixels of each Gaussian's weights α T times an image's values."""
    values = torch.from_numpy(picture).to(rendered.colour)
    found = pulled_back(rendered.colour, values, grey.sh)
    return np.asarray((found[:, 0] / C0).numpy(force=True))


def grey_of(gaussians: Gaussians) -> Gaussians:
    """Copies of the Gaussians with a single colour coefficient each, which requires a gradient."""
    colours: Float[Tensor, "n 1 3"] = torch.zeros_like(gaussians.sh[:, :1])
    return replace(gaussians.detach(), sh=colours.requires_grad_())


def _border(camera: Camera) -> Float32[np.ndarray, "h w"]:
    """1 at an image's border, 0 elsewhere."""
    picture = np.ones((camera.height, camera.width), np.float32)
    width = max(1, round(BORDER_SHARE * min(camera.height, camera.width)))
    picture[width:-width, width:-width] = 0.0
    return picture


def _begins(depth: Float32[np.ndarray, "h w"]) -> float:
    """Depth where the scene of a photo begins, world units; 0 if it shows none."""
    shown = depth[depth > 0.0]
    return float(np.percentile(shown, BEGINS_PERCENTILE)) if len(shown) else 0.0


def _within(centres: Float32[np.ndarray, "n 3"], camera: Camera, distance: float) -> Bool[np.ndarray, " n"]:
    off = centres - camera.centre().astype(np.float32)
    return np.asarray(np.einsum("ni,ni->n", off, off) < distance * distance)


def _add(
    sums: _VisibilitySums,
    rows: Int64[np.ndarray, " m"],
    found: Float32[np.ndarray, "m 3"],
    camera: Camera,
    placed: tuple[Float32[np.ndarray, "m 3"], Float32[np.ndarray, "m 3 3"]],
) -> None:
    """Add one photo's contributions to the sums."""
    weight, border, behind = found.T
    centres, axes = placed
    rays = (camera.centre() - centres).astype(np.float32)
    depths = camera.depths(centres.astype(np.float64)).astype(np.float32)
    spread = np.linalg.norm(np.einsum("mij,i->mj", axes, camera.cam_from_world[2, :3].astype(np.float32)), axis=1)
    behind = behind / weight
    is_before = behind - depths > np.maximum(IN_FRONT_SHARE * depths, IN_FRONT_SIGMAS * spread)
    area = weight * depths * depths / np.float32(camera.fx * camera.fy)
    sums.weight[rows] += weight
    sums.square[rows] += weight * weight
    sums.border[rows] += border
    sums.towards[rows] += rays * (weight / np.maximum(np.linalg.norm(rays, axis=1), 1e-30))[:, None]
    sums.area[rows] += area
    sums.before[rows] += area * is_before
    sums.gap[rows] += weight * np.clip(1.0 - depths / behind, -1.0, 1.0)
