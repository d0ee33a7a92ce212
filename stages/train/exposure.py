"""What exposure and white balance did to each photo, so that the splat need not explain it.

An affine map of the colours for every training photo, trained beside the Gaussians, as in Kerbl et al., "A Hierarchical
3D Gaussian Representation for Real-Time Rendering of Very Large Datasets" (SIGGRAPH 2024), and before in Rematas et
al., "Urban Radiance Fields" (CVPR 2022). Over the photos the maps' mean is the identity: the splat alone has the
neutral appearance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.stages.line import TrainConfig
from splatpipe.stages.train.side import SideModel

LAST_RATE = 0.1  # of the first; exponential in between
_NAME = "deviations"


class Exposure(SideModel):
    """An affine map of the colours for each photo.

    Args:
        names: Of the photos trained on.
    """

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__({_NAME: torch.zeros(len(names), 12)})
        self._row = {name: row for row, name in enumerate(sorted(names))}

    def map_of(self, name: str) -> Float[Tensor, "3 4"]:
        """What a photo's map is now: its colours are A c + b of the splat's, [A b]."""
        return torch.eye(3, 4) + self.tensors[_NAME][self._row[name]].view(3, 4)

    def shown(self, picture: Float[Tensor, "h w 3"], name: str) -> Float[Tensor, "h w 3"]:
        """A render as the photo's exposure would show it; differentiable."""
        return affine_colour(picture, self.map_of(name))

    def step(self, name: str, iteration: int, options: TrainConfig) -> None:
        """Step a photo's map against its gradient, and let the maps' mean be the identity again.

        Args:
            name: The photo's.
            iteration: From 1.
            options: Resolved.
        """
        deviations = self.tensors[_NAME]
        row = self._row[name]
        if deviations.grad is not None:
            deviations.grad[row] += options.exposure_decay * deviations.detach()[row]
        share = min(1.0, iteration / options.iterations)
        rows = torch.zeros(len(self._row), dtype=torch.bool)
        rows[row] = True
        self.descend({_NAME: options.lr_exposure * math.exp(math.log(LAST_RATE) * share)}, rows)
        with torch.no_grad():
            deviations -= deviations.mean(dim=0)

    def maps(self) -> dict[str, list[list[float]]]:
        """Every photo's map, rows of A with b at their end, by name."""
        with torch.no_grad():
            return {name: self.map_of(name).tolist() for name in self._row}


def exposures_json(exposure: Exposure | None) -> str:
    """The text of `exposures.json`."""
    model = "off" if exposure is None else "affine"
    fields = {"model": model, "views": {} if exposure is None else exposure.maps()}
    return json.dumps(fields, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
