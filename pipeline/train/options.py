"""Options of training. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import Fraction, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig

Length = Literal["auto"] | PositiveInt
LONGEST_BUDGET_S = 30 * 86_400.0
LARGEST_MEMORY = 1 << 50
FILM_FROM_BUDGET_S = 600.0  # a shorter time budget has no time for a film
LengthOrZero = Literal["auto"] | NonNegativeInt


class TrainConfig(StageConfig):
    """The published 3D Gaussian splatting schedule; `auto` lengths are resolved from `iterations` (see plan.json).

    At 30,000 iterations and more every `auto` is the published value; shorter runs shrink it as its text says.
    """

    iterations: PositiveInt = 30_000
    """Optimisation steps, one photo each; a time budget plans its own."""
    time_budget_s: Annotated[float, Field(ge=0.0, le=LONGEST_BUDGET_S)] = 0.0
    """Seconds for the whole command: resolution, cap and iterations are planned to fill what is left. 0: none."""
    max_memory_bytes: Annotated[int, Field(ge=0, le=LARGEST_MEMORY)] = 0
    """Most resident memory that training may take, its libraries included: caps the Gaussians. 0: no limit."""
    seed: NonNegativeInt = 0
    """Seed of the order of photos and of density control."""
    max_gaussians: PositiveInt = 1_000_000
    """Hard cap on Gaussians, at most 1.8 kB of memory each; where it binds, the largest scores are densified first."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics that are trained."""
    sh_every: Length = "auto"
    """Iterations until one degree more is trained. Auto: 1000, at most a fifth of the run."""
    ssim_weight: Fraction = 0.2
    """Share of 1 - SSIM in the loss; the rest is L1."""
    loss: Literal["native", "kornia"] = "native"
    """Who computes the loss and its gradient: our kernels, or kornia's SSIM under torch, some 50 times slower."""
    exposure: Literal["off", "affine"] = "off"
    """What exposure and white balance did to each photo: not modelled, or as an affine map of its colours that is
    trained along. The splat keeps the photos' mean appearance."""
    exposure_decay: NonNegativeFloat = 1e-3
    """How strongly the maps are drawn to the identity: this times their deviation joins the loss's gradient."""
    lr_exposure: PositiveFloat = 1e-3
    """Learning rate of the maps at the start; a tenth of it at the end."""
    antialias: bool = True
    """Anti-aliased projection (mip): for renders much smaller or larger than the photos."""
    filter_3d: bool = False
    """3D smoothing filter (Mip-Splatting): no Gaussian finer than the photos could show; for close-up views."""
    background: Literal["black", "white", "random"] = "random"
    """What is behind the Gaussians in training; `random` (a colour an iteration) forbids holes."""
    coarse_levels: Annotated[int, Field(ge=0, le=4)] = 0
    """Start with photos halved this many times and double them on the way: faster, a little smoother."""
    coarse_until: LengthOrZero = "auto"
    """Iteration from which photos have their full size. Auto: `densify_until`."""
    densify: bool = True
    """Clone, split and prune Gaussians (adaptive density control)."""
    densify_from: Length = "auto"
    """First iteration of density control. Auto: 500, at most a fifth of the run."""
    densify_until: Length = "auto"
    """Last iteration of density control. Auto: half of the run; for `mcmc` five sixths of it."""
    densify_every: Length = "auto"
    """Iterations between its steps. Auto: 100, at most a tenth of the run."""
    density: Literal["published", "absolute", "mcmc"] = "absolute"
    """Where Gaussians are added: where the screen gradient is large, summed as `published` or as `absolute` magnitudes;
    or `mcmc`: where opacity is high, dead ones moving there."""
    densify_gradient: Literal["auto"] | PositiveFloat = "auto"
    """Gaussians are densified whose score is above this: the image-plane gradient (NDC); `mcmc` has no score.
    Auto: 1.2e-3 for `absolute`, 2e-4 for `published`."""
    split_extent: PositiveFloat = 0.01
    """Those larger than this share of the scene's extent are split, smaller ones cloned."""
    split_shrink: Annotated[float, Field(ge=1.0, le=10.0)] = 1.6
    """The two halves of a split are this many times smaller."""
    prune_opacity: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.005
    """Gaussians below this opacity are removed."""
    prune_extent: NonNegativeFloat = 0.1
    """Those larger than this share of the extent are removed after the first opacity reset; 0 for never."""
    prune_screen_px: NonNegativeFloat = 0.0
    """Those with a larger radius on screen are removed, too (published: 20); 0 for never: it eats aerial ground."""
    prune_free_space: NonNegativeInt = 1
    """Gaussians before the surface for at least so many photos, or right before a camera, are removed; 0 for never."""
    reset_every: LengthOrZero = "auto"
    """Iterations between opacity resets, 0 for none. Auto: 3000; below 10,000 iterations and for `mcmc` none."""
    reset_opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.01
    """An opacity reset leaves no Gaussian above this."""
    lr_boost: Literal["auto"] | PositiveFloat = "auto"
    """All learning rates but opacity's are multiplied by this, the last one of positions by its square. Auto:
    the root of 30,000 / `iterations`, from 1 to 4: a short run needs longer steps to get as far."""
    lr_means: PositiveFloat = 1.6e-4
    """Learning rate of positions at the start, times the scene's extent."""
    lr_means_final: PositiveFloat = 1.6e-6
    """The same at the end; exponential in between."""
    lr_sh: PositiveFloat = 2.5e-3
    """Learning rate of colour (degree 0)."""
    lr_sh_rest_divisor: Annotated[float, Field(ge=1.0)] = 20.0
    """Higher degrees learn this many times slower."""
    lr_opacity: PositiveFloat = 0.15
    """Learning rate of opacity logits. Published: 0.05, at which surfaces become opaque too late."""
    lr_scales: PositiveFloat = 5e-3
    """Learning rate of log-scales."""
    lr_quats: PositiveFloat = 1e-3
    """Learning rate of rotations."""
    sparse_adam: bool = True
    """Step only Gaussians that the photo saw; off: all of them, as first published (momentum goes on unseen)."""
    spread_weight: NonNegativeFloat = 0.0
    """Weight of the spread of the depths along a pixel's ray in the loss: layers become one surface. Tried: 0.05."""
    dropout: Literal["auto"] | Annotated[float, Field(ge=0.0, le=0.9)] = "auto"
    """Share of the Gaussians left out of an iteration at random, rising to this at the end (DropGaussian).
    Auto: 0.2 up to 16 photos, evenly less up to 32, from there on 0."""
    sky: Literal["off", "model"] = "model"
    """`model`: the sky, found in the photos or drawn in `sky_masks/`, has a colour by direction of its own and no
    Gaussians; the deliverable leaves it out. Where no photo shows any it stays off."""
    sky_opacity_weight: NonNegativeFloat = 0.1
    """Weight of the mean opacity before the sky in the loss."""
    robust: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Moving things: up to about this share of all pixels, a quarter of a photo at most, is left out of the loss where
    a photo differs, visit after visit, from what the others agree on; 0: none. Tried: 0.05."""
    stop_when_flat: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """Where going on would take off less than this share of the training photos' loss, the schedule is run down within
    a tenth of the iterations done; 0 for never. The presets have 0.1."""
