"""The backdrop of a scene by viewing direction alone: a small panorama, and compositing a render over it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from torch import Tensor

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.containers.archives import read_archive
from splatpipe.pipeline.splat.model.upload import rgb_beside, upload
from splatpipe.pipeline.splat.sky.sky_mask import directions, horizontal_axes

ROWS = 32  # rows from straight down to straight up, cells of 5.6°: gradients and large clouds, no buildings
COLUMNS = 2 * ROWS
FULL_FROM_DEG = -2.0  # elevation from which the panorama covers fully, the lowest that the sky search allows
NOTHING_UP_TO_DEG = -6.0  # elevation up to which it covers nothing: holes in the ground stay holes
STEP_PX = 8  # spacing of the nodes at which directions are looked up; a cell is wider than that
LARGEST_FILE_BYTES = 1 << 20


@dataclass
class Panorama:
    """Colours by elevation and azimuth, interpolated bilinearly between the cells' centres.

    Attributes:
        up: The panorama's pole, a unit vector in the model's frame.
        colours: RGB of the cells, row by row from straight down, 0..1; an autograd leaf while it is trained.
    """

    up: Float64[np.ndarray, " 3"]
    colours: Float[Tensor, "cells 3"]

    def behind(self, camera: Camera, background: tuple[float, float, float]) -> Float[Tensor, "h w 3"]:
        """What a camera sees behind the scene: the panorama, and below the horizon the background.

        Args:
            camera: The camera.
            background: Red, green, blue, 0..1.
        """
        return self.view_from(camera).behind(self.colours, background)

    def view_from(self, camera: Camera) -> PanoramaView:
        """The lookup of a camera's nodes in this panorama."""
        if self.colours.device.type == "cpu":
            return gather_view(camera, self.up, self.colours)
        return matrix_view(camera, self.up, self.colours)

    def at(self, rays: Float64[np.ndarray, "*shape 3"]) -> Float[Tensor, "*shape 3"]:
        """The colours along some directions, of any length."""
        return GatherLookup.of_rays(rays, self.up, self.colours).mixed(self.colours).reshape(rays.shape)

    def to(self, device: torch.device) -> Panorama:
        """The panorama with its colours on a device; they are no longer an autograd leaf if they had to be moved."""
        return Panorama(self.up, self.colours.to(device))


@runtime_checkable
class Lookup(Protocol):
    """The cells and weights that some directions interpolate, independent of the cells' colours."""

    def mixed(self, colours: Float[Tensor, "cells 3"]) -> Float[Tensor, "n 3"]:
        """The directions' colours."""


@dataclass(frozen=True)
class PanoramaView:
    """The directions of a camera's nodes as a lookup in a panorama.

    Attributes:
        camera: The camera.
        share: The panorama's share of the backdrop, (rows, columns, 1).
        cells: The cells that the nodes interpolate, row by row.
    """

    camera: Camera
    share: Float[Tensor, "rows columns 1"]
    cells: Lookup

    def behind(
        self, colours: Float[Tensor, "cells 3"], background: tuple[float, float, float]
    ) -> Float[Tensor, "h w 3"]:
        """What the camera sees behind the scene for given cell colours, with the background below the horizon."""
        return between_nodes(self.at_nodes(colours, background), self.camera.height, self.camera.width)

    def at_nodes(
        self, colours: Float[Tensor, "cells 3"], background: tuple[float, float, float]
    ) -> Float[Tensor, "rows columns 3"]:
        """The same at the nodes alone."""
        below = rgb_beside(background, colours)
        seen = self.cells.mixed(colours).reshape(*self.share.shape[:2], 3)
        return self.share * seen + (1.0 - self.share) * below

    def flat_at_nodes(
        self, colour: tuple[float, float, float], background: tuple[float, float, float]
    ) -> Float[Tensor, "rows columns 3"]:
        """The same for cells of a single colour."""
        everywhere, below = (rgb_beside(rgb, self.share) for rgb in (colour, background))
        return self.share * everywhere + (1.0 - self.share) * below


@dataclass(frozen=True)
class GatherLookup:
    """Lookup of four cells per direction by index: little work, for a CPU.

    Attributes:
        cells: (n, 4) cell indices.
        weights: (n, 4, 1) bilinear weights.
    """

    cells: Int64[Tensor, "n 4"]
    weights: Float[Tensor, "n 4 1"]

    @staticmethod
    def of_rays(rays: Float64[np.ndarray, "*shape 3"], up: Float64[np.ndarray, " 3"], like: Tensor) -> GatherLookup:
        """The lookup for some directions, with another tensor's dtype and device."""
        cells, weights = (torch.from_numpy(array).to(like.device) for array in cells_of(rays.reshape(-1, 3), up))
        return GatherLookup(cells, weights.to(like.dtype)[:, :, None])

    def mixed(self, colours: Float[Tensor, "cells 3"]) -> Float[Tensor, "n 3"]:
        """The directions' colours."""
        return (colours[self.cells] * self.weights).sum(dim=1)


@dataclass(frozen=True)
class MatrixLookup:
    """Lookup by matrix products over all cells, with mostly zero weights.

    The backward pass of matrix products sums in a fixed order on a GPU as well; that of an index lookup sums in any
    order, or has to sort first.

    Attributes:
        by_row: (n, ROWS) weights.
        by_column: (n, COLUMNS) weights.
    """

    by_row: Float[Tensor, "n rows"]
    by_column: Float[Tensor, "n columns"]

    def mixed(self, colours: Float[Tensor, "cells 3"]) -> Float[Tensor, "n 3"]:
        """The directions' colours."""
        by_columns = colours.reshape(ROWS, COLUMNS, 3).transpose(0, 1).reshape(COLUMNS, ROWS * 3)
        along = (self.by_column @ by_columns).reshape(-1, ROWS, 3)
        return (self.by_row[:, :, None] * along).sum(dim=1)


def gather_view(camera: Camera, up: Float64[np.ndarray, " 3"], like: Tensor) -> PanoramaView:
    """A camera's view of a panorama with the given pole, with another tensor's dtype."""
    nodes = directions(camera, STEP_PX)
    share = torch.from_numpy(cover(nodes, up)).to(like.dtype)[:, :, None]
    return PanoramaView(camera, share, GatherLookup.of_rays(nodes, up, like))


def matrix_view(camera: Camera, up: Float64[np.ndarray, " 3"], like: Tensor) -> PanoramaView:
    """The same, computed on the other tensor's device: the host's work does not grow with the photo's size."""
    device, dtype = like.device, like.dtype
    east, north = horizontal_axes(up)
    axes = upload(torch.from_numpy(camera.cam_from_world[:3, :3] @ np.stack([east, north, up], axis=1)), device)
    x, y = (
        (STEP_PX * torch.arange(nodes_along(size), dtype=torch.float64, device=device) + 0.5 - centre) / focal
        for size, centre, focal in ((camera.width, camera.cx, camera.fx), (camera.height, camera.cy, camera.fy))
    )
    rays = x[None, :, None] * axes[0] + y[:, None, None] * axes[1] + axes[2]
    elevation = torch.asin((rays[:, :, 2] / rays.norm(dim=2)).clamp(-1.0, 1.0)) / math.pi  # half turns
    azimuth = torch.atan2(rays[:, :, 1], rays[:, :, 0]) / (2.0 * math.pi)
    share = (180.0 * elevation - NOTHING_UP_TO_DEG) / (FULL_FROM_DEG - NOTHING_UP_TO_DEG)
    row = ((elevation + 0.5) * ROWS - 0.5).clamp(0.0, ROWS - 1.0).reshape(-1, 1).to(dtype)
    column = ((azimuth + 0.5) * COLUMNS - 0.5).reshape(-1, 1).to(dtype)
    across = (column - torch.arange(COLUMNS, device=device)).abs()
    by_column = (1.0 - torch.minimum(across, COLUMNS - across)).clamp(min=0.0)
    by_row = (1.0 - (row - torch.arange(ROWS, device=device)).abs()).clamp(min=0.0)
    return PanoramaView(camera, share.clamp(0.0, 1.0).to(dtype)[:, :, None], MatrixLookup(by_row, by_column))


def composite_over(
    colour: Float[Tensor, "h w 3"],
    alpha: Float[Tensor, "h w"],
    background: tuple[float, float, float],
    behind: Float[Tensor, "h w 3"],
) -> Float[Tensor, "h w 3"]:
    """Replace a render's background; differentiable with respect to all tensors.

    Args:
        colour: The render over ``background``.
        alpha: The render's opacity.
        background: The render's background colour.
        behind: What replaces it.
    """
    return colour + (1.0 - alpha)[:, :, None] * (behind - rgb_beside(background, behind))


def between_nodes(
    values: Float[Tensor, "rows columns 3"], height: int, width: int, step: int = STEP_PX
) -> Float[Tensor, "h w 3"]:
    """Interpolate bilinearly from nodes to every pixel.

    Args:
        values: Values at the nodes: every ``step``-th pixel of every ``step``-th row, from the first on.
        height: Image height, pixels.
        width: Image width, pixels.
        step: Spacing of the nodes, pixels.
    """
    down, right = (
        _between(size, count, step, values) for size, count in ((height, values.shape[0]), (width, values.shape[1]))
    )
    across = right @ values.transpose(0, 1).reshape(values.shape[1], -1)  # two plain products: a fifth of batched ones
    lines = across.reshape(width, -1, 3).transpose(0, 1).reshape(values.shape[0], -1)
    return (down @ lines).reshape(height, width, 3)


def cover(rays: Float64[np.ndarray, "*shape 3"], up: Float64[np.ndarray, " 3"]) -> Float32[np.ndarray, "*shape"]:
    """The panorama's share of the backdrop by direction: 1 above the horizon, 0 well below."""
    sine = rays @ up / np.linalg.norm(rays, axis=-1)
    elevation = np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0)))
    share = (elevation - NOTHING_UP_TO_DEG) / (FULL_FROM_DEG - NOTHING_UP_TO_DEG)
    return np.asarray(np.clip(share, 0.0, 1.0).astype(np.float32))


def cells_of(
    rays: Float64[np.ndarray, "n 3"], up: Float64[np.ndarray, " 3"]
) -> tuple[Int64[np.ndarray, "n 4"], Float32[np.ndarray, "n 4"]]:
    """The four cells around each direction, and their bilinear weights; near the poles only one row."""
    east, north = horizontal_axes(up)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    row = (np.arcsin(np.clip(rays @ up, -1.0, 1.0)) / math.pi + 0.5) * ROWS - 0.5
    column = (np.arctan2(rays @ north, rays @ east) / (2.0 * math.pi) + 0.5) * COLUMNS - 0.5
    row = np.clip(row, 0.0, ROWS - 1.0)
    above, left = np.floor(row).astype(np.int64), np.floor(column).astype(np.int64)
    by_row, by_column = row - above, column - left
    rows = np.minimum(np.stack([above, above, above + 1, above + 1], axis=1), ROWS - 1)
    columns = np.stack([left, left + 1, left, left + 1], axis=1) % COLUMNS
    share = np.stack(
        [(1 - by_row) * (1 - by_column), (1 - by_row) * by_column, by_row * (1 - by_column), by_row * by_column], axis=1
    )
    return rows * COLUMNS + columns, share.astype(np.float32)


def write_panorama(path: Path, panorama: Panorama | None) -> None:
    """Write a panorama; without one, a file that says so."""
    up = np.zeros(3) if panorama is None else panorama.up
    colours = np.zeros((0, 3), np.float32) if panorama is None else panorama.colours.detach().cpu().numpy()
    with new_file(path) as file:
        np.savez(file, allow_pickle=False, up=up, colours=colours)


def read_panorama(path: Path) -> Panorama | None:
    """Read a file of ``write_panorama``; None if it says that there is no panorama.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise ValueError("too large")
        arrays = read_archive(path)
        up, colours = arrays["up"], arrays["colours"]
        if colours.shape == (0, 3):
            return None
        return panorama_of(up, colours)
    except (OSError, ValueError, KeyError) as error:
        raise StageError(
            f"The trained sky cannot be read: {error}.", hint="Run again with --rerun-from train."
        ) from error


def panorama_of(up: np.ndarray, colours: np.ndarray) -> Panorama:
    """A panorama from a file's arrays.

    Raises:
        ValueError: if the arrays are not a panorama's.
    """
    if up.shape != (3,) or up.dtype != np.float64 or not abs(float(np.linalg.norm(up)) - 1.0) < 1e-6:
        raise ValueError("its pole is not a direction")
    if colours.shape != (ROWS * COLUMNS, 3) or colours.dtype != np.float32 or not np.isfinite(colours).all():
        raise ValueError("its colours are not those of its cells")
    return Panorama(up, torch.from_numpy(colours))


def nodes_along(size: int) -> int:
    """Number of nodes along a side of an image: the last one is at its last pixel or slightly outside."""
    return -((1 - size) // STEP_PX) + 1


def _between(size: int, count: int, step: int, like: Tensor) -> Float[Tensor, "size count"]:
    """Weights of the nodes for each pixel along one side."""
    place = torch.arange(size, dtype=like.dtype, device=like.device) / step
    nodes = torch.arange(count, dtype=like.dtype, device=like.device)
    return (1.0 - (place[:, None] - nodes).abs()).clamp(min=0.0)
