"""Density control by the gradient of the loss with respect to a Gaussian's image-plane mean: statistics and steps.

`train.density=published`: Kerbl, Kopanas, Leimkühler, Drettakis: "3D Gaussian Splatting for Real-Time Radiance Field
Rendering", SIGGRAPH 2023, section 5: the norm of the gradient, summed with its sign over the pixels. `absolute`: Ye et
al., "AbsGS", ACM MM 2024: the magnitudes of the pixels' gradients are summed, which do not cancel in a Gaussian that
is too large for the detail it covers.

Both use our cap, our growth schedule and our opacity for two Gaussians that replace one (see `densify.py`). With
`published`, the ranked score and its threshold, the learning rates, the opacity resets and the pruning by size are
those of the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensifiedGaussians, DensitySchedule, DensityStatistics, grow, prune_mask
from splatpipe.pipeline.train.photos.stream import TrainingPhoto


@dataclass(frozen=True)
class DensityStep:
    """A step of density control.

    Attributes:
        schedule: The density-control schedule.
        extent: Scene extent, world units.
        limit: Maximum number of Gaussians after the step, if any are added.
        iteration: The iteration that ends.
        prune_mask: (n,) Gaussians to remove, whatever their size and opacity.
        score_adjustment: How techniques modify the score; None for unmodified.
    """

    schedule: DensitySchedule
    extent: float
    limit: int
    iteration: int
    prune_mask: Bool[Tensor, " n"]
    score_adjustment: Callable[[Float[Tensor, " n"]], Float[Tensor, " n"]] | None = None


class Density:
    """Density control, with the statistics since its last step.

    Args:
        count: Number of Gaussians in the model.
        magnitudes: Rank by the summed magnitudes of the pixels' gradients, not by their signed sum.
        device: The model's device; None for the CPU.

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
        """Add an iteration's statistics, after its step has produced the image-plane gradient.

        A window's gradients are scaled to its share of the whole photo, so that the score and its threshold mean the
        same however a photo is divided.

        Args:
            rendered: The render compared with the photo, cut down to the n trained Gaussians.
            gradient_px: With respect to the image-plane means, pixels; with ``magnitudes``, the summed magnitudes.
                Either sparse, of the trained and visible Gaussians, or of all rendered ones, the n trained ones first.
            schedule: The density-control schedule.
            photo: The photo trained on.
        """
        whole = photo.camera.uncropped()
        size = (photo.share * whole.width, photo.share * whole.height)
        if gradient_px.is_sparse:
            self.statistics.observe_rows(gradient_px.indices()[0], gradient_px.values(), *size)
        else:
            self.statistics.observe(gradient_px[: len(rendered.visible)], rendered.visible, *size)
        if schedule.prune_screen_px > 0.0:
            self.statistics.observe_radii(rendered.radii)

    def control(self, gaussians: Gaussians, step: DensityStep) -> tuple[DensifiedGaussians, dict[str, int]]:
        """Prune, then clone or split the Gaussians of largest mean score, up to the limit; changes nothing itself.

        Returns:
            The new rows of the model, and the counts of a ``DensityEvent``.
        """
        schedule, extent, iteration = step.schedule, step.extent, step.iteration
        gone = prune_mask(gaussians, schedule, extent, iteration, self.statistics.max_radius_px)
        if not bool((gone | step.prune_mask).all()):  # a model is never emptied
            gone |= step.prune_mask
        pruned = int(gone.sum())
        score = torch.where(gone, 0.0, self.statistics.score())
        score = score if step.score_adjustment is None else step.score_adjustment(score)
        growth, counts = grow(gaussians, score, step.limit - len(gaussians) + pruned, schedule, extent, iteration)
        return growth.select(~gone[growth.source]), {**counts, "pruned": pruned}

    def restart(self, count: int) -> None:
        """Reset the statistics, because the model has new rows."""
        self.statistics = DensityStatistics(count, self.statistics.seen.device)

    def to_arrays(self) -> dict[str, Tensor]:
        """The sums by name, for a checkpoint; not copied."""
        return self.statistics.to_arrays()

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError: if something is missing.
            RuntimeError: if it is for a different number of Gaussians.
        """
        for name, tensor in self.statistics.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise RuntimeError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])
