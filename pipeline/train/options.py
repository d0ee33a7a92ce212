"""Options of training. Light to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from splatpipe.pipeline.engine.ranges import NonNegativeFloat, NonNegativeInt, PositiveInt
from splatpipe.pipeline.engine.stage import StageConfig

LONGEST_BUDGET_S = 30 * 86_400.0
LARGEST_MEMORY = 1 << 50
FILM_FROM_BUDGET_S = 600.0  # a shorter time budget has no time for a film


class TrainConfig(StageConfig):
    """3D Gaussian splatting; lengths and learning rates follow from the iterations (see `schedule` in plan.json).

    At 30,000 iterations and more the lengths are the published ones; shorter runs have shorter ones.
    """

    iterations: Literal["auto"] | PositiveInt = "auto"
    """Optimisation steps, each on one photo or a window of it. Auto: enough to show every part of every photo often
    enough at each size, at least `least_iterations`. A time budget plans its own number."""
    least_iterations: PositiveInt = 30_000
    """Minimum for `iterations=auto`, however few photos there are."""
    length_growth: Annotated[float, Field(ge=0.0, le=1.0)] = 1.0
    """How `iterations=auto` grows beyond `least_iterations`, as a power of what the photos ask for: 1 shows every photo
    as often, however many there are; with 0.5, four times the photos take twice the iterations."""
    max_megapixels: Annotated[float, Field(ge=0.0, le=200.0)] = 0.0
    """Largest size of training photos, reached from smaller ones in steps; 0: that of the dataset."""
    time_budget_s: Annotated[float, Field(ge=0.0, le=LONGEST_BUDGET_S)] = 0.0
    """Time budget of the whole command, seconds: photo size, cap on Gaussians and iterations are planned to fill the
    time that the other stages leave. 0: none."""
    max_memory_bytes: Annotated[int, Field(ge=0, le=LARGEST_MEMORY)] = 0
    """Limit on the resident memory of training, including its libraries; on a CUDA device, on device memory. Caps the
    number of Gaussians. 0: no limit."""
    seed: NonNegativeInt = 0
    """Random seed of the order of photos and of density control."""
    max_gaussians: PositiveInt = 1_000_000
    """Hard cap on the number of Gaussians, which take up to 1.3 kB of memory each; at the cap, those with the largest
    scores are densified first."""
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Degree of the spherical harmonics (SH)."""
    loss: Literal["native", "kornia"] = "native"
    """Implementation of the loss and its gradient: splatpipe's own kernels (`native`), or kornia's SSIM in torch, about
    50 times slower."""
    exposure: Literal["auto", "off", "affine"] = "auto"
    """Model of each photo's exposure and white balance: none (`off`), or an affine map of its colours that is trained
    along with the splat (`affine`); the splat keeps the mean appearance of the photos. Auto: `affine` if the photos
    show the same points 6 % apart or more."""
    antialias: bool = True
    """Anti-aliased projection (mip), for renders at much smaller or larger scales than the photos."""
    background: Literal["black", "white", "random"] = "random"
    """Background colour in training; `random` (a new colour in each iteration) prevents holes."""
    coarse_levels: Annotated[int, Field(ge=0, le=4)] = 0
    """Start with photos halved this many times and double them during training: faster, slightly smoother."""
    densify: bool = True
    """Clone, split and prune Gaussians (adaptive density control)."""
    density: Literal["published", "absolute"] = "absolute"
    """Densification criterion: the screen-space gradient, accumulated as magnitudes (`absolute`) or as in the original
    method (`published`), which also uses the original learning rates, opacity resets and pruning by size on screen."""
    prune_free_space: NonNegativeInt = 1
    """Floater pruning: remove Gaussians in front of the surface in at least this many photos, or right in front of a
    camera; 0: never."""
    distortion_weight: NonNegativeFloat = 0.0
    """Weight of the distortion loss, which contracts the depths along each pixel's ray, so that layers merge into one
    surface. Tested value: 0.05."""
    dropout: Literal["auto"] | Annotated[float, Field(ge=0.0, le=0.9)] = "auto"
    """Fraction of Gaussians dropped at random in each iteration, rising to this value at the end (DropGaussian). Auto:
    0.2 up to 16 photos, falling linearly to 0 at 32."""
    sky: Literal["off", "model"] = "model"
    """`model`: the sky, detected in the photos or drawn in `sky_masks/`, is modelled as a colour per direction, without
    Gaussians, and is not part of the delivered splat. Off if no photo shows sky."""
    robust: Annotated[float, Field(ge=0.0, le=0.5)] = 0.0
    """Moving objects: up to about this fraction of all pixels, and at most a quarter of a photo, is left out of the
    loss where a photo repeatedly contradicts the others; 0: none. Tested value: 0.05."""
    stop_when_flat: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    """If further training at the current size would reduce the training loss by less than this fraction, move on to
    larger photos at once; at the largest size, end within another tenth of the iterations done. 0: never; the presets
    use 0.1."""

    def unfit_for_cuda(self) -> str:
        """Why these options cannot be used on a CUDA device; empty if they can."""
        if self.loss == "kornia":
            return "train.loss=kornia does not have a reproducible gradient on a CUDA device."
        return ""


class SplatDepthsConfig(StageConfig):
    enabled: bool = False
    """Flatten a copy of the splat and render depth maps of all photos from it for the surface products; where photos
    have no texture, it is more complete than their own depths."""
