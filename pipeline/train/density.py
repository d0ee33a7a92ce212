"""Density control by the gradient of the loss by a Gaussian's place on the image plane: what it observes, its steps.

`train.density=published`: Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", SIGGRAPH 2023, section 5: the norm of the gradient, summed with its sign over the pixels. `absolute`: Ye et
al., "AbsGS", ACM MM 2024: the pixels' magnitudes are summed, which do not cancel in a Gaussian that is too large for
what it covers.

Both keep to our cap, our schedule of growth and our opacity of two that take the place of one (see `densify.py`);
published are what is ranked and its threshold, the learning rates, the opacity resets and the pruning by size.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensifiedGaussians, DensitySchedule, DensityStatistics, grow, prune_mask
from splatpipe.pipeline.train.stream import TrainingPhoto


@dataclass(frozen=True)
class DensityStep:
    """A step of density control.

    Attributes:
        schedule: Of density control.
        extent: Of the scene, world units.
        limit: The most Gaussians that may be left, where any are added.
        iteration: The one that ends.
        unwanted: (n,) Gaussians that have to go, whatever their size and opacity.
        ranked: What techniques make of the score; None for nothing.
    """

    schedule: DensitySchedule
    extent: float
    limit: int
    iteration: int
    unwanted: Bool[Tensor, " n"]
    ranked: Callable[[Float[Tensor, " n"]], Float[Tensor, " n"]] | None = None


class Density:
    """Density control, with what it has observed since its last step.

    Args:
        count: Gaussians in the model.
        magnitudes: Ranked by the sum of the pixels' magnitudes, not of their gradients.
        device: Where the model is; None for the CPU.

    Attributes:
        statistics: The score's sums.
    """

    def __init__(self, count: int, magnitudes: bool, device: torch.device | None = None) -> None:
        self.magnitudes = magnitudes
        self.statistics = DensityStatistics(count, device)

    def observe(
        self,
        rendered: Render,
        gradient_px: Float[Tensor, "m 2"],
        schedule: DensitySchedule,
        photo: TrainingPhoto,
    ) -> None:
        """Add an iteration after its step, which leaves the gradient on the image plane.

        A window's gradients count as its part in those of the whole photo: what is ranked and its threshold mean the
        same however a photo is divided.

        Args:
            rendered: What was compared with the photo, of the n Gaussians that are trained.
            gradient_px: By the means on the image plane, pixels; with ``magnitudes`` the sums of those. Sparse, of what
                is trained and visible, or of all that was drawn, those n first.
            schedule: Of density control.
            photo: What was trained on.
        """
        whole = photo.camera.whole()
        size = (photo.share * whole.width, photo.share * whole.height)
        if gradient_px.is_sparse:
            self.statistics.observe_rows(gradient_px.indices()[0], gradient_px.values(), *size)
        else:
            self.statistics.observe(gradient_px[: len(rendered.visible)], rendered.visible, *size)
        if schedule.prune_screen_px > 0.0:
            self.statistics.observe_radii(rendered.radii)

    def control(self, gaussians: Gaussians, step: DensityStep) -> tuple[DensifiedGaussians, dict[str, int]]:
        """Prune, then clone or split the Gaussians of the largest mean score, up to the limit.

        Returns:
            The new rows of the model, and the counts of a ``DensityEvent``; nothing is changed.
        """
        schedule, extent, iteration = step.schedule, step.extent, step.iteration
        gone = prune_mask(gaussians, schedule, extent, iteration, self.statistics.max_radius_px)
        if not bool((gone | step.unwanted).all()):  # a model is never emptied
            gone |= step.unwanted
        pruned = int(gone.sum())
        score = torch.where(gone, 0.0, self.statistics.score())
        score = score if step.ranked is None else step.ranked(score)
        growth, counts = grow(gaussians, score, step.limit - len(gaussians) + pruned, schedule, extent, iteration)
        return growth.select(~gone[growth.source]), {**counts, "pruned": pruned}

    def restart(self, count: int) -> None:
        """Forget what was observed: the model has new rows."""
        self.statistics = DensityStatistics(count, self.statistics.seen.device)

    def to_arrays(self) -> dict[str, Tensor]:
        """The sums by name, for a checkpoint; not copied."""
        return self.statistics.to_arrays()

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError: if something is missing.
            RuntimeError: if it is of another number of Gaussians.
        """
        for name, tensor in self.statistics.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise RuntimeError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])
