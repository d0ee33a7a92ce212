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

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.raster.rasterizer import Render
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.densify import DensifiedGaussians, DensitySchedule, grow, prune_mask
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.techniques.techniques import Techniques


class Density:
    """Density control, with sums over the photos since its last step.

    Args:
        count: Number of Gaussians in the model.
        device: The model's device; None for the CPU.

    Attributes:
        score_sum: (n,) sum of the photos' scores.
        seen: (n,) number of photos that saw the Gaussian.
        max_radius_px: (n,) largest radius on screen; 0 where unseen.
    """

    def __init__(self, count: int, device: torch.device | None = None) -> None:
        self.score_sum, self.seen, self.max_radius_px = (torch.zeros(count, device=device) for _ in range(3))

    def observe(
        self,
        rendered: Render,
        gradient_px: Float[Tensor, "m 2"],
        schedule: DensitySchedule,
        photo: TrainingPhoto,
    ) -> None:
        """Add the NDC norm of an iteration's image-plane gradients, after its step has produced them.

        A window's gradients are scaled to its share of the whole photo, so that the score and its threshold mean the
        same however a photo is divided. Non-finite scores count as 0.

        Args:
            rendered: The render compared with the photo, cut down to the n trained Gaussians.
            gradient_px: With respect to the image-plane means, pixels, or their summed magnitudes.
                Either sparse, of the trained and visible Gaussians, or of all rendered ones, the n trained ones first.
            schedule: The density-control schedule.
            photo: The photo trained on.
        """
        whole = photo.camera.uncropped()
        values = gradient_px.values() if gradient_px.is_sparse else gradient_px[: len(rendered.visible)]
        width, height = photo.share * whole.width, photo.share * whole.height
        score = torch.hypot(values[:, 0] * (0.5 * width), values[:, 1] * (0.5 * height)).nan_to_num_(0.0, 0.0, 0.0)
        if gradient_px.is_sparse:
            self.score_sum.index_add_(0, gradient_px.indices()[0], score)
        else:
            self.score_sum += score.mul_(rendered.visible)
        self.seen += rendered.visible
        if schedule.prune_screen_px > 0.0:
            torch.maximum(self.max_radius_px, rendered.radii, out=self.max_radius_px)

    def score(self) -> Float[Tensor, " n"]:
        """Mean score over the photos that saw the Gaussian."""
        return self.score_sum / self.seen.clamp(min=1.0)

    def control(
        self,
        gaussians: Gaussians,
        schedule: DensitySchedule,
        extent: float,
        limit: int,
        iteration: int,
        techniques: Techniques,
    ) -> tuple[DensifiedGaussians, dict[str, int]]:
        """Prune, then clone or split the Gaussians of largest mean score, up to the limit; changes nothing itself.

        Args:
            gaussians: The model.
            schedule: The density-control schedule.
            extent: Scene extent, world units.
            limit: Maximum number of Gaussians afterwards, if any are added.
            iteration: The iteration that ends.
            techniques: They reject Gaussians, and adjust the scores.

        Returns:
            The new rows of the model, and the counts of a ``DensityEvent``.
        """
        rejected = techniques.prune_mask(gaussians, iteration)
        gone = prune_mask(gaussians, schedule, extent, iteration, self.max_radius_px)
        if rejected is not None and not bool((gone | rejected).all()):  # a model is never emptied
            gone |= rejected
        pruned = int(gone.sum())
        score = techniques.adjust_scores(torch.where(gone, 0.0, self.score()), gaussians, schedule)
        growth, counts = grow(gaussians, score, limit - len(gaussians) + pruned, schedule, extent, iteration)
        return growth.select(~gone[growth.source]), {**counts, "pruned": pruned}

    def restart(self, count: int) -> None:
        """Reset the sums, because the model has new rows."""
        self.score_sum, self.seen, self.max_radius_px = (self.seen.new_zeros(count) for _ in range(3))

    def to_arrays(self) -> dict[str, Tensor]:
        """The sums by name, for a checkpoint; not copied."""
        return {"score_sum": self.score_sum, "seen": self.seen, "max_radius_px": self.max_radius_px}

    def load(self, arrays: Mapping[str, Tensor]) -> None:
        """The inverse of ``to_arrays``.

        Raises:
            KeyError: if something is missing.
            RuntimeError: if it is for a different number of Gaussians.
        """
        for name, tensor in self.to_arrays().items():
            if arrays[name].shape != tensor.shape:
                raise RuntimeError(f"{name} is {tuple(arrays[name].shape)}, not {tuple(tensor.shape)}")
            tensor.copy_(arrays[name])
