"""Moving objects: leave out of the loss what one photo shows and the other photos contradict.

Trimming a photometric loss by the residual's quantile, with neighbourhood votes, is the idea of Sabour et al.,
"RobustNeRF: Ignoring Distractors with Robust Losses" (CVPR 2023); residuals remembered by photo, and a trimmed share
that grows in training, are from Sabour et al., "SpotLessSplats: Ignoring Distractors in 3D Gaussian Splatting" (2024).
Neither learned features nor weights are used here. Fine detail and areas not learned yet are told apart from motion by
three tests of our own:

- residuals are compared between cells, not pixels, less the photo's median (exposure), and a difference that a
  neighbouring cell explains does not count (edges and texture slightly off are not a car), nor does a model's hole;
- a cell's residual is a running mean over the visits to its photo;
- the other photos that see the cell's surface, as modelled, have to agree with the model there: if they do not either,
  the place is hard or not learned yet, and nothing contradicts the photo.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn import functional

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.appearance.neighbour_cameras import NeighbourCameras
from splatpipe.pipeline.train.appearance.photo_cells import PhotoCells
from splatpipe.pipeline.train.hooks import RenderedView, Technique
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.schedule import ScheduleStep

GRID = 64  # cells along either side of a photo, whatever its size: a car in a drone photo spans two
MIN_CELL_PX = 4  # smaller photos have fewer cells: a cell has to average out detail
RESIDUAL_MOMENTUM = 0.5  # weight of earlier visits in a cell's residual
SEARCH_RADIUS_CELLS = 1  # cells: the model may show this far away what the photo shows here
MIN_RESIDUAL = 0.05  # residual of a left-out cell, colours in 0..1: anything less is shading, not another object
MIN_VOTES = 4  # minimum among a cell and its eight neighbours: two by two are an object, a single one is noise
RIM_THRESHOLD_SHARE = 0.5  # residual over the threshold above which neighbours of a left-out cell are left out too
MAX_SHARE_OF_PHOTO = 0.25  # may be left out: more than that is a wrong model, not a passer-by
MAX_WITNESSES = 24  # nearest photos that are compared at a place
MIN_ALPHA = 0.8  # opacity of a judged pixel: below it the model has a hole rather than a contradiction
SURFACE_ALPHA = 0.5  # opacity of a cell with a valid depth
UNKNOWN = -1.0  # residual of a cell that no visit has shown


def share_at(robust: float, begin: int, iteration: int) -> float:
    """The share left out at an iteration: it rises from the first step of density control.

    Args:
        robust: The maximum, reached at twice ``begin``.
        begin: First iteration of density control: before it, the model is too rough to contradict a photo.
        iteration: Its number, from 1.
    """
    return robust * min(1.0, max(0.0, iteration / begin - 1.0))


class RobustMask(Technique):
    """The residuals of every photo, and the pixels that they leave out of the loss.

    Args:
        names: Names of the photos trained on.
        most: Maximum share of the cells that may stand out.
        begin: First iteration of density control.

    Attributes:
        scores: (n, GRID, GRID) residual of each cell, ``UNKNOWN`` where there is none.
        threshold: (1,) residual above which a cell stands out among all photos' cells; infinite in the first epoch.
        left_out: (n,) share of each photo left out at its last visit.
        witnesses: The photos' cameras in the order of ``scores``; not in the checkpoint; None if unknown.
    """

    name = "robust"

    def __init__(self, names: Sequence[str], most: float = 0.0, begin: int = 1) -> None:
        self._most, self._begin = most, begin
        self._row = {name: row for row, name in enumerate(sorted(names))}
        self.scores = torch.full((len(names), GRID, GRID), UNKNOWN)
        self.threshold = torch.full((1,), torch.inf)
        self.left_out = torch.zeros(len(names))
        self.witnesses: NeighbourCameras | None = None
        self._before: tuple[int, Tensor, Tensor] | None = None  # this iteration's row, and its values before

    def watch(self, cameras: Iterable[Camera]) -> None:
        """Set the photos' cameras, of any image size; without them nothing is contradicted or left out."""
        ordered = sorted(cameras, key=lambda camera: self._row[camera.name])
        self.witnesses = NeighbourCameras.of(ordered, MAX_WITNESSES) if ordered else None

    def move_to(self, device: torch.device) -> None:
        """Move all tensors to the training device."""
        self.scores, self.threshold = self.scores.to(device), self.threshold.to(device)
        self.left_out = self.left_out.to(device)
        self.witnesses = None if self.witnesses is None else self.witnesses.to(device)

    def settings(self, settings: RenderOptions, model: Gaussians, camera: Camera, now: ScheduleStep) -> RenderOptions:
        """Turn on depths, which locate the cells' surfaces in other photos."""
        self._before = None
        return replace(settings, depth=True)

    def roll_back(self) -> None:
        """Undo what was recorded of the photo: it will be visited again."""
        if self._before is not None:
            row, scores, left_out = self._before
            self.scores[row], self.left_out[row] = scores, left_out
            self._before = None

    def mask_pixels(
        self, photo: TrainingPhoto, picture: Float[Tensor, "h w 3"], rendered_view: RenderedView
    ) -> TrainingPhoto:
        """The photo without what the other photos contradict."""
        return self.leave_out_contradicted(photo, rendered_view.rendered, picture)

    def after_epoch(self, iteration: int) -> None:
        """Set the threshold for the next epoch."""
        self.end_epoch(share_at(self._most, self._begin, iteration))

    def summary(self) -> dict[str, int | float]:
        """The share that the last visits left out."""
        return {"robust_left_out": round(self.share_left_out(), 5)}

    def leave_out_contradicted(
        self, photo: TrainingPhoto, rendered: Render, rendered_colour: Float[Tensor, "h w 3"]
    ) -> TrainingPhoto:
        """Record a photo's residuals and return it without what the other photos contradict, or unchanged.

        Args:
            photo: The photo.
            rendered: Its rendered view, with depths.
            rendered_colour: The render as compared with the photo.
        """
        with torch.no_grad():
            row = self._row[photo.camera.name]
            self._before = row, self.scores[row].clone(), self.left_out[row].clone()
            opaque = rendered.alpha >= MIN_ALPHA
            counts = opaque if photo.mask is None else photo.mask & opaque
            self._remember(row, *cell_residuals(rendered_colour, photo.colour, counts, photo.camera))
            cells = PhotoCells(photo.camera, GRID, GRID)
            out = cells.spread(self._left_out_cells(row, rendered, cells))
            self.left_out[row] = out.float().mean()
        if out.device.type == "cpu" and not bool(out.any()):  # on a device, the check would synchronize
            return photo
        return replace(photo, mask=~out if photo.mask is None else photo.mask & ~out)

    def _remember(self, row: int, now: Float[Tensor, "g g"], judged: Bool[Tensor, "g g"] | None) -> None:
        """Blend a visit's residuals into the stored ones; cells that its window does not show stay unchanged."""
        before = self.scores[row]
        mixed = torch.where(before < 0.0, now, RESIDUAL_MOMENTUM * before + (1.0 - RESIDUAL_MOMENTUM) * now)
        # nothing to compare: the old residual fades
        faded = torch.where(before < 0.0, before, RESIDUAL_MOMENTUM * before)
        after = torch.where(now < 0.0, faded, mixed)
        self.scores[row] = after if judged is None else torch.where(judged, after, before)

    def _left_out_cells(self, row: int, rendered: Render, cells: PhotoCells) -> Bool[Tensor, "g g"]:
        scores, threshold = self.scores[row], self.threshold
        most = torch.quantile(scores, 1.0 - MAX_SHARE_OF_PHOTO)
        high, low = torch.maximum(threshold, most), torch.maximum(RIM_THRESHOLD_SHARE * threshold, most)
        core = _majority(scores > high)
        core &= self._contradicted(row, core, rendered, cells)
        return (_near(core) & (scores > low)) | core

    def _contradicted(
        self, row: int, core: Bool[Tensor, "g g"], rendered: Render, cells: PhotoCells
    ) -> Bool[Tensor, "g g"]:
        """Those of the cells where most of the other photos that see the place agree with the model."""
        if self.witnesses is None:
            return torch.zeros_like(core)
        alpha, depth_sum = cells.means(torch.stack((rendered.alpha, rendered.depth_sum))).double()
        asked = (core & (alpha >= SURFACE_ALPHA)).flatten()
        numbers = _cell_indices(asked)
        middles = (torch.stack((numbers % GRID, numbers // GRID), dim=1) + 0.5) / GRID
        depths = (depth_sum / alpha).flatten()[numbers]
        places = self.witnesses.places(row, middles.double(), depths)
        found = self.witnesses.agree(row, places, self.scores, self.threshold)
        if len(found) == len(asked):
            return torch.logical_and(asked, found).view_as(core)
        result = torch.zeros_like(asked)
        result[numbers] = found
        return result.view_as(core)

    def end_epoch(self, share: float) -> None:
        """Set the threshold from all photos' cells.

        Args:
            share: Maximum share of the cells that may stand out.
        """
        known = self.scores[self.scores >= 0.0].cpu().numpy()
        if share <= 0.0 or len(known) == 0:
            self.threshold.fill_(torch.inf)
            return
        place = min(len(known) - 1, int((1.0 - share) * len(known)))
        self.threshold.fill_(max(MIN_RESIDUAL, float(np.partition(known, place)[place])))

    def share_left_out(self) -> float:
        """Mean over the photos of the share left out at their last visits."""
        return float(self.left_out.mean())

    def to_arrays(self) -> dict[str, Tensor]:
        """Mutable state by name, for a checkpoint; not copied."""
        return {"scores": self.scores, "threshold": self.threshold, "left_out": self.left_out}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError, ValueError: if a tensor is missing or has a different shape.
        """
        for name, tensor in self.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise ValueError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])


def cell_residuals(
    rendered_colour: Float[Tensor, "h w 3"], colour: Float[Tensor, "h w 3"], counts: Bool[Tensor, "h w"], camera: Camera
) -> tuple[Float[Tensor, "g g"], Bool[Tensor, "g g"] | None]:
    """Difference between each cell's mean colour and the closest one of the model there and nearby, mean of channels.

    Args:
        rendered_colour: The model's render.
        colour: The photo's colours.
        counts: The pixels to compare.
        camera: The photo's camera, or its window's.

    Returns:
        The residuals, ``UNKNOWN`` where less than half of a cell counts; and the cells that the window judges, None for
        all.
    """
    whole = camera.uncropped()
    size = (min(GRID, max(1, whole.height // MIN_CELL_PX)), min(GRID, max(1, whole.width // MIN_CELL_PX)))
    cells = PhotoCells(camera, *size)
    weight, judged = cells.means(counts[None].float()), cells.judged(rendered_colour)
    known = weight[0] >= 0.5  # half of the visible part: the rim of a neighbouring cell is evidence too
    chosen = known if judged is None else known & judged
    model, picture = (
        cells.means(picture.permute(2, 0, 1) * counts) / weight.clamp(min=1e-6) for picture in (rendered_colour, colour)
    )
    model = model - _medians(model - picture, chosen)[:, None, None]
    usable = _nearby(known[None].float())[0] > 0.0
    apart = torch.where(usable, (_nearby(model) - picture[:, None]).abs().mean(dim=0), torch.inf)
    residual = torch.where(chosen, apart.amin(dim=0), UNKNOWN)
    return _over_grid(residual), None if judged is None else _over_grid(judged.float()) > 0.0


def _over_grid(cells: Float[Tensor, "gh gw"]) -> Float[Tensor, "g g"]:
    return functional.interpolate(cells[None, None], size=(GRID, GRID), mode="nearest")[0, 0]


def _medians(planes: Float[Tensor, "c gh gw"], known: Bool[Tensor, "gh gw"]) -> Float[Tensor, " c"]:
    """The lower median of each plane's known cells, without synchronizing to count them; infinite if there are none."""
    ordered = torch.where(known, planes, torch.inf).flatten(1).sort(dim=1).values
    middle = (known.sum() - 1).clamp(min=0) // 2
    return ordered.index_select(1, middle[None])[:, 0]


def _cell_indices(asked: Bool[Tensor, " cells"]) -> Int64[Tensor, " k"]:
    """Indices of the cells to work on: the requested ones, or all on a device, where counting would synchronize."""
    if asked.device.type == "cpu":
        return torch.nonzero(asked).flatten()
    return torch.arange(len(asked), device=asked.device)


def _nearby(planes: Float[Tensor, "c gh gw"]) -> Float[Tensor, "c k gh gw"]:
    """The values up to ``SEARCH_RADIUS_CELLS`` cells around each cell; zeros beyond the border."""
    side = 2 * SEARCH_RADIUS_CELLS + 1
    return functional.unfold(planes[None], side, padding=SEARCH_RADIUS_CELLS).view(
        len(planes), side * side, *planes.shape[1:]
    )


def _majority(cells: Bool[Tensor, "g g"]) -> Bool[Tensor, "g g"]:
    """The cells that have enough of their neighbourhood with them."""
    votes = 9.0 * functional.avg_pool2d(cells[None, None].float(), 3, stride=1, padding=1)[0, 0]
    return cells & (votes > MIN_VOTES - 0.5)


def _near(cells: Bool[Tensor, "g g"]) -> Bool[Tensor, "g g"]:
    return functional.max_pool2d(cells[None, None].float(), 3, stride=1, padding=1)[0, 0] > 0.0
