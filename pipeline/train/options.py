"""Options of training. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeFloat, NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig

LONGEST_BUDGET_S = 30 * 86_400.0
LARGEST_MEMORY = 1 << 50
FILM_FROM_BUDGET_S = 600.0  # a shorter time budget has no time for a film
_CONSTANT = "This is now set by constants: remove it."
_NO_GAIN = "This was removed, as it never gave a measurable gain: remove it."
GONE = {
    **dict.fromkeys(
        (
            *("sh_every", "ssim_weight", "exposure_decay", "coarse_until", "sky_opacity_weight"),
            *("densify_from", "densify_until", "densify_every", "densify_gradient", "split_extent", "split_shrink"),
            *("prune_opacity", "prune_extent", "prune_screen_px", "reset_every", "reset_opacity", "sparse_adam"),
            *("lr_boost", "lr_means", "lr_means_final", "lr_sh", "lr_sh_rest_divisor", "lr_opacity", "lr_scales"),
            *("lr_quats", "lr_exposure"),
        ),
        _CONSTANT,
    ),
    **dict.fromkeys(
        (
            *("exposure_side", "exposure_levels", "exposure_smoothness", "refine_cameras", "refine_decay"),
            *("lr_cameras", "opacity_decay", "scale_decay", "depth_weight", "sh_limit", "max_anisotropy", "filter_3d"),
        ),
        _NO_GAIN,
    ),
}
"""Options that other versions had, and what to do instead."""


class TrainConfig(StageConfig):
    """3D Gaussian splatting; lengths and learning rates follow from the iterations (see `schedule` in plan.json).

    At 30,000 iterations and more the lengths are the published ones, a shorter run's are shorter.
    """

    iterations: Literal["auto"] | PositiveInt = "auto"
    """Optimisation steps, one photo or a window of it each. Auto: as many as show every part of every photo often
    enough at each size, at least `least_iterations`. A time budget plans its own."""
    least_iterations: PositiveInt = 30_000
    """Fewest that `iterations=auto` takes, however few the photos."""
    max_megapixels: Annotated[float, Field(ge=0.0, le=200.0)] = 0.0
    """Photos are trained on at this size at most, from smaller to larger; 0: at the dataset's."""
    time_budget_s: Annotated[float, Field(ge=0.0, le=LONGEST_BUDGET_S)] = 0.0
    """Seconds for the whole command: resolution, cap and iterations are planned to fill what is left. 0: none."""
    max_memory_bytes: Annotated[int, Field(ge=0, le=LARGEST_MEMORY)] = 0
    """Most resident memory that training may take, its libraries included; on a CUDA device, most of the device's. Caps
    the Gaussians. 0: no limit."""
    seed: NonNegativeInt = 0
    """Seed of the order of photos and of density control."""
    max_gaussians: PositiveInt = 1_000_000
    """Hard cap on Gaussians, at most 1.3 kB of memory each; where it binds, the largest scores are densified first."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics that are trained."""
    loss: Literal["native", "kornia"] = "native"
    """Who computes the loss and its gradient: our kernels, or kornia's SSIM under torch, some 50 times slower."""
    exposure: Literal["auto", "off", "affine"] = "auto"
    """What exposure and white balance did to each photo: not modelled, or as an affine map of its colours that is
    trained along; the splat keeps the photos' mean appearance. Auto: `affine` where the photos show the same points
    6 % apart or more."""
    antialias: bool = True
    """Anti-aliased projection (mip): for renders much smaller or larger than the photos."""
    background: Literal["black", "white", "random"] = "random"
    """What is behind the Gaussians in training; `random` (a colour an iteration) forbids holes."""
    coarse_levels: Annotated[int, Field(ge=0, le=4)] = 0
    """Start with photos halved this many times and double them on the way: faster, a little smoother."""
    densify: bool = True
    """Clone, split and prune Gaussians (adaptive density control)."""
    density: Literal["published", "absolute"] = "absolute"
    """Where Gaussians are added: where the screen gradient is large, summed as `absolute` magnitudes or as `published`,
    which takes that method's rates, resets of opacity and pruning by size on screen, too."""
    prune_free_space: NonNegativeInt = 1
    """Gaussians before the surface for at least so many photos, or right before a camera, are removed; 0 for never."""
    distortion_weight: NonNegativeFloat = 0.0
    """Weight of the spread of the depths along a pixel's ray in the loss: layers become one surface. Tried: 0.05."""
    dropout: Literal["auto"] | Annotated[float, Field(ge=0.0, le=0.9)] = "auto"
    """Share of the Gaussians left out of an iteration at random, rising to this at the end (DropGaussian).
    Auto: 0.2 up to 16 photos, evenly less up to 32, from there on 0."""
    sky: Literal["off", "model"] = "model"
    """`model`: the sky, found in the photos or drawn in `sky_masks/`, has a colour by direction of its own and no
    Gaussians; the deliverable leaves it out. Where no photo shows any it stays off."""
    robust: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Moving things: up to about this share of all pixels, a quarter of a photo at most, is left out of the loss where
    a photo differs, visit after visit, from what the others agree on; 0: none. Tried: 0.05."""
    stop_when_flat: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Where going on would take off less than this share of the training photos' loss, larger photos come at once; at
    the largest size the schedule is run down within a tenth of the iterations done. 0 for never; presets have 0.1."""

    def unfit_for_cuda(self) -> str:
        """Why these options do not train on a CUDA device; empty where they do."""
        if self.loss == "kornia":
            return "train.loss=kornia does not have a reproducible gradient on a CUDA device."
        return ""


class SplatDepthsConfig(StageConfig):
    enabled: bool = False
    """Flatten a copy of the splat and render depths of all photos from it, for surface products: where photos have no
    texture it knows more than they do."""
