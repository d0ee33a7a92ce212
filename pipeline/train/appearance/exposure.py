"""Per-photo exposure and white balance, so that the splat does not have to explain them.

An affine map of the colours for every training photo, trained beside the Gaussians, as in Kerbl et al., "A Hierarchical
3D Gaussian Representation for Real-Time Rendering of Very Large Datasets" (SIGGRAPH 2024), and before in Rematas et
al., "Urban Radiance Fields" (CVPR 2022). The mean of the maps over all photos is the identity, so the splat alone has
the neutral appearance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import json_text, read_json
from splatpipe.pipeline.raster.colour import affine_colour
from splatpipe.pipeline.train.appearance.auxiliary_model import AuxiliaryModel
from splatpipe.pipeline.train.hooks import RenderedView, Technique

FIRST_RATE = 1e-3  # learning rate: a photo has about a hundred visits, which change its exposure by at most a tenth
LAST_RATE = 0.1  # last over first learning rate; exponential in between
DECAY = 1e-3  # weight decay towards the identity: unconstrained coefficients stay there
_NAME = "deviations"


class Exposure(AuxiliaryModel, Technique):
    """An affine map of the colours for each photo.

    Args:
        names: Names of the photos trained on.
        first_rate: Learning rate at the start.
        decay: Weight decay of the maps towards the identity.
    """

    name = "exposure"

    def __init__(self, names: Sequence[str], first_rate: float = FIRST_RATE, decay: float = DECAY) -> None:
        super().__init__({_NAME: torch.zeros(len(names), 12)})
        self._first_rate, self._decay = first_rate, decay
        self._row = {name: row for row, name in enumerate(sorted(names))}

    def map_of(self, name: str) -> Float[Tensor, "3 4"]:
        """A photo's current map [A b]: its colours are A c + b for colours c of the splat."""
        deviations = self._deviations()
        return torch.eye(3, 4, device=deviations.device) + deviations[self._row[name]].view(3, 4)

    def apply_appearance(self, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView) -> Float[Tensor, "h w 3"]:
        """A render as the photo's exposure would show it."""
        return self.applied(picture, rendered_view.photo.camera.name)

    def applied(self, picture: Float[Tensor, "h w 3"], name: str) -> Float[Tensor, "h w 3"]:
        """An image with a photo's map applied; differentiable."""
        return affine_colour(picture, self.map_of(name))

    @staticmethod
    def given(maps: Mapping[str, Sequence[Sequence[float]]]) -> Exposure:
        """Fixed maps, as returned by ``maps``; they are not trained.

        Raises:
            ValueError: if one is not a map.
        """
        found = Exposure(tuple(maps))
        for name, rows in maps.items():
            deviation = torch.tensor(rows, dtype=torch.float32) - torch.eye(3, 4)
            found.tensors[_NAME].detach()[found._row[name]] = deviation.flatten()
        found.give()
        return found

    def after_step(self, rendered_view: RenderedView) -> None:
        """Step the photo's map."""
        if self.is_given:
            return
        self.step(rendered_view.photo.camera.name, rendered_view.now.share)

    @torch.no_grad()
    def step(self, name: str, share: float) -> None:
        """Take an optimizer step on a photo's map, and restore the identity as the mean map.

        Args:
            name: Name of the photo.
            share: Fraction of the schedule done, 0..1.
        """
        deviations, row = self._deviations(), self._row[name]
        if deviations.grad is not None:
            deviations.grad[row] += self._decay * deviations.detach()[row]
        rows = torch.arange(len(deviations), device=deviations.device) == row
        self.descend({_NAME: self._first_rate * math.exp(math.log(LAST_RATE) * share)}, rows)
        self._centre()

    def _centre(self) -> None:
        """Subtract the maps' mean deviation."""
        deviations = self._deviations()
        deviations -= deviations.mean(dim=0)

    def _deviations(self) -> Float[Tensor, "rows 12"]:
        """The trained values: the maps less the identity."""
        return self.tensors[_NAME]

    def maps(self) -> dict[str, list[list[float]]]:
        """Every photo's map as rows [A b], by name, sorted."""
        with torch.no_grad():
            return {name: self.map_of(name).tolist() for name in self._row}


def exposures_json(exposure: Exposure | None) -> str:
    """The text of `exposures.json`."""
    fields = {"model": "off", "views": {}} if exposure is None else {"model": "affine", "views": exposure.maps()}
    return json_text(fields)


def read_exposures(path: Path, stage: str) -> dict[str, list[list[float]]]:
    """The photos' maps, as ``Exposure.given`` takes them; empty if exposure was not modelled.

    Args:
        path: File with the text of ``exposures_json``.
        stage: The stage that wrote it.

    Raises:
        StageError: if it is not such a file.
    """
    try:
        found = read_json(path)["views"]
        return {str(name): [[float(value) for value in row] for row in rows] for name, rows in found.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise StageError(f"{path.name} cannot be read.", hint=f"Run again with --rerun-from {stage}.") from error
