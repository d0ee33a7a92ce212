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
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.side import SideModel

LAST_RATE = 0.1  # of the first; exponential in between
_NAME = "deviations"


class Exposure(SideModel):
    """An affine map of the colours for each photo.

    Args:
        names: Of the photos trained on.
        maps: How many each has.
    """

    model = "affine"

    def __init__(self, names: Sequence[str], maps: int = 1) -> None:
        super().__init__({_NAME: torch.zeros(len(names) * maps, 12)})
        self._maps = maps
        self._centred_every = 1
        self._row = {name: row for row, name in enumerate(sorted(names))}

    def map_of(self, name: str) -> Float[Tensor, "3 4"]:
        """What a photo's map is now: its colours are A c + b of the splat's, [A b]."""
        return torch.eye(3, 4) + self._deviation(name).view(3, 4)

    def shown(self, picture: Float[Tensor, "h w 3"], name: str) -> Float[Tensor, "h w 3"]:
        """A render as the photo's exposure would show it; differentiable."""
        return affine_colour(picture, self.map_of(name))

    @torch.no_grad()
    def step(self, name: str, iteration: int, options: TrainConfig) -> None:
        """Step a photo's maps against their gradient, and let their mean over the photos be the identity again.

        Args:
            name: The photo's.
            iteration: From 1.
            options: Resolved.
        """
        deviations, own = self._deviations(), self._own(name)
        if deviations.grad is not None:
            deviations.grad[own] += self._pull(deviations.detach()[own], options)
        share = min(1.0, iteration / options.iterations)
        rows = torch.zeros(len(deviations), dtype=torch.bool)
        rows[own] = True
        self.descend({_NAME: options.lr_exposure * math.exp(math.log(LAST_RATE) * share)}, rows)
        if iteration % self._centred_every == 0:
            self._centre()

    def _pull(self, deviation: Float[Tensor, "maps 12"], options: TrainConfig) -> Float[Tensor, "maps 12"]:
        """The gradient of what the loss has against a photo's maps themselves."""
        return options.exposure_decay * deviation

    def _centre(self) -> None:
        """Take out the maps' mean deviation."""
        deviations = self._deviations()
        deviations -= deviations.mean(dim=0)

    def _deviations(self) -> Float[Tensor, "rows 12"]:
        """What is trained: the maps less the identity."""
        return self.tensors[_NAME]

    def _own(self, name: str) -> slice:
        """A photo's rows."""
        return slice(self._row[name] * self._maps, (self._row[name] + 1) * self._maps)

    def _deviation(self, name: str) -> Float[Tensor, "maps 12"]:
        return self._deviations()[self._own(name)]

    def maps(self) -> dict[str, list[list[float]]]:
        """Every photo's map, rows of A with b at their end, by name in order."""
        with torch.no_grad():
            return {name: self.map_of(name).tolist() for name in self._row}


def exposures_json(exposure: Exposure | None) -> str:
    """The text of `exposures.json`."""
    fields = {"model": "off", "views": {}} if exposure is None else {"model": exposure.model, "views": exposure.maps()}
    return json.dumps(fields, indent=1, ensure_ascii=False, allow_nan=False) + "\n"
