"""What exposure and white balance did to each photo, so that the splat need not explain it.

An affine map of the colours for every training photo, trained beside the Gaussians, as in Kerbl et al., "A Hierarchical
3D Gaussian Representation for Real-Time Rendering of Very Large Datasets" (SIGGRAPH 2024), and before in Rematas et
al., "Urban Radiance Fields" (CVPR 2022). Over the photos the maps' mean is the identity: the splat alone has the
neutral appearance.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.json_file import json_text
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.train.hooks import Shot, Technique
from splatpipe.pipeline.train.side import SideModel

FIRST_RATE = 1e-3  # of learning: a photo has some hundred visits, in which its exposure moves by a tenth at most
LAST_RATE = 0.1  # of the first; exponential in between
DECAY = 1e-3  # times the maps' deviation from the identity joins the loss's gradient: what no pixel tells stays there
_NAME = "deviations"


class Exposure(SideModel, Technique):
    """An affine map of the colours for each photo.

    Args:
        names: Names of the photos trained on.
        first_rate: Learning rate at the start.
        decay: How strongly the maps are drawn to the identity.
    """

    name = "exposure"

    def __init__(self, names: Sequence[str], first_rate: float = FIRST_RATE, decay: float = DECAY) -> None:
        super().__init__({_NAME: torch.zeros(len(names), 12)})
        self._first_rate, self._decay = first_rate, decay
        self._row = {name: row for row, name in enumerate(sorted(names))}

    def map_of(self, name: str) -> Float[Tensor, "3 4"]:
        """What a photo's map is now: its colours are A c + b of the splat's, [A b]."""
        deviations = self._deviations()
        return torch.eye(3, 4, device=deviations.device) + deviations[self._row[name]].view(3, 4)

    def shown(self, picture: Float[Tensor, "h w 3"], shot: Shot) -> Float[Tensor, "h w 3"]:
        """A render as the photo's exposure would show it."""
        return self.applied(picture, shot.photo.camera.name)

    def applied(self, picture: Float[Tensor, "h w 3"], name: str) -> Float[Tensor, "h w 3"]:
        """A picture through a photo's map; differentiable."""
        return affine_colour(picture, self.map_of(name))

    @staticmethod
    def given(maps: Mapping[str, Sequence[Sequence[float]]]) -> Exposure:
        """Maps as ``maps`` tells them, of which nothing is trained.

        Raises:
            ValueError: if one is no map.
        """
        found = Exposure(tuple(maps))
        for name, rows in maps.items():
            deviation = torch.tensor(rows, dtype=torch.float32) - torch.eye(3, 4)
            found.tensors[_NAME].detach()[found._row[name]] = deviation.flatten()
        found.give()
        return found

    def after_step(self, shot: Shot) -> None:
        """Step the photo's map."""
        if self.is_given:
            return
        self.step(shot.photo.camera.name, shot.now.share)

    @torch.no_grad()
    def step(self, name: str, share: float) -> None:
        """Step a photo's map against its gradient, and let the photos' mean map be the identity again.

        Args:
            name: The photo's.
            share: Fraction of the schedule done, 0..1.
        """
        deviations, row = self._deviations(), self._row[name]
        if deviations.grad is not None:
            deviations.grad[row] += self._decay * deviations.detach()[row]
        rows = torch.arange(len(deviations), device=deviations.device) == row
        self.descend({_NAME: self._first_rate * math.exp(math.log(LAST_RATE) * share)}, rows)
        self._centre()

    def _centre(self) -> None:
        """Take out the maps' mean deviation."""
        deviations = self._deviations()
        deviations -= deviations.mean(dim=0)

    def _deviations(self) -> Float[Tensor, "rows 12"]:
        """What is trained: the maps less the identity."""
        return self.tensors[_NAME]

    def maps(self) -> dict[str, list[list[float]]]:
        """Every photo's map, rows of A with b at their end, by name in order."""
        with torch.no_grad():
            return {name: self.map_of(name).tolist() for name in self._row}


def exposures_json(exposure: Exposure | None) -> str:
    """The text of `exposures.json`."""
    fields = {"model": "off", "views": {}} if exposure is None else {"model": "affine", "views": exposure.maps()}
    return json_text(fields)


def read_exposures(path: Path, stage: str) -> dict[str, list[list[float]]]:
    """The photos' maps, as ``Exposure.given`` takes them; none where exposure was not modelled.

    Args:
        path: What ``exposures_json`` told.
        stage: That left it.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))["views"]
        return {str(name): [[float(value) for value in row] for row in rows] for name, rows in found.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint=f"Run again with --rerun-from {stage}.") from error
