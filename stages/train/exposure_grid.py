"""What a camera's own processing did to each photo, by place and brightness: vignetting, local tone mapping, HDR.

A bilateral grid of affine colour maps for every training photo, trained beside the Gaussians, as in Wang et al.,
"Bilateral Guided Radiance Field Processing" (SIGGRAPH 2024): a pixel's map is interpolated from the nodes around its
place and the luminance that the splat gives it, and neighbouring nodes are held together by their squared differences.

The grid is smaller than theirs (16 × 16 × 8). Linear interpolation over cells of width w is off by c w² / 8 from a fall
of c r² towards the corners: for a lens that loses 40 % there, 8 nodes a side leave less than one step of 8 bits, 4
leave four. The tone curve of a photo that is not stylised is smooth enough for maps at 4 brightnesses, between which
they change linearly. What a larger grid could hold besides is shadows and reflections, which belong to the splat.

At each brightness the mean of the maps, over the photos and all places, is the identity: a splat that is brighter, or
of another contrast, in all photos alike is so itself. A fall of light towards the corners of all photos is none of it
and may stay in the grids.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatpipe.pipeline.raster.colour import bilateral_colour
from splatpipe.stages.options import TrainConfig
from splatpipe.stages.train.exposure import Exposure

ENTRIES = 12  # of a map


class GridExposure(Exposure):
    """A bilateral grid of affine maps for each photo.

    Args:
        names: Of the photos trained on.
        side: Nodes along each side of a picture, from edge to edge.
        levels: Nodes from black to white.
    """

    model = "bilateral"

    def __init__(self, names: Sequence[str], side: int, levels: int) -> None:
        super().__init__(names, maps=levels * side * side)
        self._shape = (levels, side, side, ENTRIES)
        self._centred_every = len(names)  # that visits all grids, and in between their mean moves by about a step

    def map_of(self, name: str) -> Float[Tensor, "3 4"]:
        """The mean of a photo's maps."""
        return torch.eye(3, 4) + self._deviation(name).mean(dim=0).view(3, 4)

    def shown(self, picture: Float[Tensor, "h w 3"], name: str) -> Float[Tensor, "h w 3"]:
        """A render as the photo's grid would show it; differentiable."""
        return bilateral_colour(picture, torch.eye(3, 4).flatten() + self._grid(name))

    def maps(self) -> dict[str, list[list[float]]]:
        """The mean of every photo's maps, by name in order."""
        means = torch.from_numpy(self.grids()).mean(dim=(1, 2, 3)).view(-1, 3, 4).tolist()
        return dict(zip(self._row, means, strict=True))

    def grids(self) -> Float32[np.ndarray, "photos levels rows columns 12"]:
        """Every photo's maps, in the order of ``maps``."""
        with torch.no_grad():
            return (torch.eye(3, 4).flatten() + self._all() - self._excess()).numpy()

    def _pull(self, deviation: Float[Tensor, "maps 12"], options: TrainConfig) -> Float[Tensor, "maps 12"]:
        decay = options.exposure_decay / self._maps * deviation
        rough = options.exposure_smoothness * roughness_gradient(deviation.view(self._shape))
        return decay + rough.view(-1, ENTRIES)

    def _centre(self) -> None:
        self._all().sub_(self._excess())

    def _all(self) -> Float[Tensor, "photos levels rows columns 12"]:
        return self._deviations().view(-1, *self._shape)

    def _grid(self, name: str) -> Float[Tensor, "levels rows columns 12"]:
        return self._deviation(name).view(self._shape)

    def _excess(self) -> Float[Tensor, "1 levels 1 1 12"]:
        """Each level's mean over photos and places."""
        return self._all().detach().mean(dim=(0, 2, 3), keepdim=True)


def roughness_gradient(
    grid: Float[Tensor, "levels rows columns 12"],
) -> Float[Tensor, "levels rows columns 12"]:
    """The gradient of the mean squared difference between neighbouring nodes, added up over the three directions."""
    gradient = torch.zeros_like(grid)
    for axis in range(3):
        difference = grid.diff(dim=axis)
        part = 2.0 / difference.numel() * difference
        gradient.narrow(axis, 1, part.shape[axis]).add_(part)
        gradient.narrow(axis, 0, part.shape[axis]).sub_(part)
    return gradient


def make_exposure(names: Sequence[str], options: TrainConfig) -> Exposure | None:
    """The model of the photos' colours that the options ask for, nothing of it trained.

    Args:
        names: Of the photos trained on.
        options: The training's.
    """
    if options.exposure == "off":
        return None
    if options.exposure == "affine":
        return Exposure(names)
    return GridExposure(names, options.exposure_side, options.exposure_levels)


def write_grids(path: Path, exposure: Exposure | None) -> None:
    """Write the grids as `.npz`, ``grids`` (photos, levels, rows, columns, 12), in the order of `exposures.json`.

    Without grids the file is written too, with none of them.
    """
    empty = np.zeros((0, 0, 0, 0, ENTRIES), np.float32)
    grids = exposure.grids() if isinstance(exposure, GridExposure) else empty
    with path.open("wb") as file:
        np.savez(file, allow_pickle=False, grids=grids)
