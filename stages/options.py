"""The options of the stages, with their defaults, and all joined; the docstring under each is its help text. Light to
import."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator

from splatpipe.pipeline.engine.stage import StageConfig
from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig, NonNegativeInt, PositiveInt, SparseConfig

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFloat = Annotated[float, Field(gt=0.0)]
NonNegativeFloat = Annotated[float, Field(ge=0.0)]
Length = Literal["auto"] | PositiveInt
LONGEST_BUDGET_S = 30 * 86_400.0
LARGEST_MEMORY = 1 << 50
FILM_FROM_BUDGET_S = 600.0  # a shorter time budget has no time for a film
LengthOrZero = Literal["auto"] | NonNegativeInt


class IngestConfig(StageConfig):
    masks: bool = True
    """Honour `masks/` (black is ignored) and `sky_masks/` (white is sky, for `train.sky`) beside or inside the photo
    folder, of the same names as the photos."""
    min_size: PositiveInt = 320
    """Pictures whose longer side is shorter, in pixels, are left out: thumbnails and icons."""
    max_megapixels: Annotated[float, Field(gt=0.0, le=4000.0)] = 500.0
    """Larger pictures are left out undecoded: a small file can claim any size."""
    positions: str = "auto"
    """File of the photos' positions, over what these say: `geo.txt` (ODM) or a CSV with a header. `auto`: `geo.txt` or
    `positions.csv` in the photo folder or beside it; `none`: only what the photos say."""
    lens: str = "auto"
    """File of a calibrated lens, or several: COLMAP's `cameras.txt`, Metashape's XML, Pix4D's `.cam` or
    `calibrated_camera_parameters.txt`. `auto`: `lens.xml`, `lens.txt` or `lens.cam` in the photo folder or beside it;
    `none`: only what the photos say. `sparse.lens` tells whether it is refined or held."""


class GeorefConfig(StageConfig):
    max_position_error_m: Literal["auto"] | PositiveFloat = "auto"
    """Photo positions further than this from the robust fit are named and left out of it. Auto: the positions' noise is
    told from the residuals, and those that are off by far more are left out; poor positions place the model poorly, and
    how poorly is told."""
    control: str = "auto"
    """File of control and check points: `gcp_list.txt` (ODM) or a CSV with a header. `auto`: `gcp_list.txt` or
    `control.csv` in the photo folder or beside it; `none`: no control."""
    crs: Annotated[str, Field(max_length=500)] = "auto"
    """CRS of coordinates that are read out: `EPSG:25832`, with heights `EPSG:25832+7837`, `+proj=…`, `WGS84 UTM 32N`.
    Auto: the control file's, without one the capture's UTM zone."""
    vertical: Annotated[str, Field(max_length=40)] = "auto"
    """Vertical datum of the photos' heights: `ellipsoidal`, `EPSG:n` or `unknown`. Auto: what the files declare."""
    approximate_crs: bool = False
    """Take a CRS though the grid of its best way to WGS 84 is missing, or EPSG knows none from its (modern) datum; what
    that costs is stated in `georef.json`."""
    pixel_origin: Literal["corner", "centre"] = "corner"
    """What the pixel coordinates (0, 0) of marks mean: the top-left corner of the first pixel, or its centre."""
    check_points: Annotated[str, Field(max_length=20_000)] = "auto"
    """Points that take no part and tell the accuracy: names, separated by commas. `auto`: those that the file names so,
    else, of six or more, every third; `none`: every point is control."""
    control_sigma_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.02
    """Horizontal standard deviation (each of two) of control points whose file states none; raised where they disagree
    with each other by more."""
    control_sigma_vertical_m: Annotated[float, Field(ge=1e-4, le=1e3)] = 0.03
    """The same of their heights."""
    mark_sigma_px: Annotated[float, Field(ge=0.01, le=100.0)] = 0.5
    """Standard deviation of a mark in a photo, pixels."""
    adjust: Literal["auto", "off"] = "auto"
    """`auto`: control enters a bundle adjustment; where it moves what the photos show by half a pixel or more, the bent
    model is used. `off`: it only places the model."""

    @field_validator("crs", "vertical")
    @classmethod
    def _known(cls, text: str, field: Any) -> str:
        """Told now, not after hours; PROJ is only loaded where something is named."""
        if text.strip().lower() == "auto":
            return "auto"
        from splatpipe.pipeline.scene.crs_names import checked

        return checked(text, str(field.field_name))


class UndistortConfig(StageConfig):
    max_megapixels: Annotated[float, Field(gt=0.005, le=200.0)] = 0.5
    """Photos are reduced to this size for training and evaluation."""


class InitializeConfig(StageConfig):
    max_gaussians: PositiveInt = 1_000_000
    """At most this many sparse points become Gaussians, those seen in most photos first."""
    opacity: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.3
    """Opacity at the start. Published: 0.1, from which walls stay a fog whose depth lies behind its front."""
    max_angle: Annotated[float, Field(gt=0.0, le=1.0)] = 0.1
    """Cap on a Gaussian's size for outliers, as a share of its distance to the nearest camera."""
    dense: Literal["off", "sweep"] = "off"
    """`sweep` adds points where the sparse ones are thin, by a plane sweep between neighbouring photos."""
    dense_points: PositiveInt = 50_000
    """At most this many are added, evenly spread. Stay well below `train.max_gaussians`: a full start cannot grow."""


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
    max_anisotropy: NonNegativeFloat = 0.0
    """No axis of a Gaussian is longer than this many times its middle one (at least 1): no needles. 0: no limit."""
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


class EvaluateConfig(StageConfig):
    every: NonNegativeInt = 8
    """Every n-th registered photo in name order, starting with the first, is held out of training; 0 for none."""
    views: str = ""
    """Names of photos to hold out instead, separated by commas."""


class ExportConfig(StageConfig):
    sky: bool = False
    """Hand over the sky of `train.sky`, too: `sky.ply`, a dome of Gaussians around the splat, in its frame."""
    title: Annotated[str, Field(max_length=200)] = "3D model"
    """What `viewer.html` is called, e.g. the building and the date."""
    viewer_megabytes: NonNegativeFloat = 60.0
    """A `viewer.html` that would be larger reads `splat.spz` beside it, which takes `splatpipe view`; 0 for none."""


class FlythroughConfig(StageConfig):
    seconds: Annotated[float, Field(ge=0.0, le=600.0)] = 10.0
    """Length of `flythrough.webm`, a film along a smooth way through the cameras; 0: none. A time budget keeps time for
    10 seconds, from ten minutes on."""
    fps: Annotated[int, Field(ge=1, le=120)] = 25
    """Frames a second."""
    size: Annotated[str, Field(pattern=r"^(auto|[0-9]{2,4}x[0-9]{2,4})$")] = "auto"
    """Width and height in pixels, even, such as 1280x720. Auto: 16:9, as many pixels as the photos have in training."""

    @field_validator("size")
    @classmethod
    def _even(cls, text: str) -> str:
        if text != "auto" and any(int(side) % 2 or not 16 <= int(side) <= 8192 for side in text.split("x")):
            raise ValueError("a film's width and height are even, from 16 to 8192")
        return text

    @property
    def film_size(self) -> tuple[int, int] | None:
        """``size`` as numbers; None for auto."""
        width, _, height = self.size.partition("x")
        return (int(width), int(height)) if height else None


class LineConfig(StageConfig):
    """Everything that changes the answer, a section a stage."""

    ingest: IngestConfig = IngestConfig()
    features: FeaturesConfig = FeaturesConfig()
    matches: MatchesConfig = MatchesConfig()
    sparse: SparseConfig = SparseConfig()
    georef: GeorefConfig = GeorefConfig()
    undistort: UndistortConfig = UndistortConfig()
    initialize: InitializeConfig = InitializeConfig()
    train: TrainConfig = TrainConfig()
    evaluate: EvaluateConfig = EvaluateConfig()
    export: ExportConfig = ExportConfig()
    flythrough: FlythroughConfig = FlythroughConfig()
