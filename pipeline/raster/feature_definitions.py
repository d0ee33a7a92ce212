"""What projecting Gaussians and blending their features means, for every backend: views, options and results.

The line's own renders (``definitions``) are made in one pass from raw parameters. Here activated values are taken, in
steps with a gradient each, and what gsplat and the line do differently is an option.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int32
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera


@dataclass(frozen=True, eq=False)
class View:
    """A pinhole view.

    Attributes:
        camera: Size, intrinsics and pose; the pose may scale.
        centre: Centre of projection in the world: the inverse pose's translation.
    """

    camera: Camera
    centre: Float64[np.ndarray, " 3"]


@dataclass(frozen=True)
class ProjectionOptions:
    """How Gaussians are projected.

    Attributes:
        near: Gaussians whose centre is nearer are skipped, world units along the view axis, ≥ 0.
        far: Gaussians whose centre is farther are skipped.
        blur_px2: Added to the variances on screen.
        plane_sigmas: Gaussians that reach the camera plane within this many standard deviations are skipped; 0: none.
        compensate: Find the opacity factors √(det Σ' / det(Σ' + blur)) of the anti-aliased variant.
        compensation_min: Floor of the ratio under that root.
        radius_clip: Gaussians whose radii on screen are both at most this are skipped, pixels.
        slants: Find how the depth varies within the Gaussians.
    """

    near: float
    far: float
    blur_px2: float
    plane_sigmas: float
    compensate: bool
    compensation_min: float
    radius_clip: float
    slants: bool


@dataclass(frozen=True, eq=False)
class Projected:
    """Gaussians projected to each of v views; zeros where not visible.

    Attributes:
        means2d: Centres, pixels; the first pixel's centre is (0.5, 0.5).
        depths: z of the centre along the view axis, world units.
        covariances: xx, xy, yy of Σ' with the blur, px².
        determinants: Their determinants, without the cancellation in xx · yy - xy²; no gradient of their own, because
            that of what is made of them is by the covariances.
        compensations: Factors for the opacities; None if not wanted.
        slants: Covariances of the depth and the place on screen; None if not wanted.
        radii: Half the width and height of the box around the ellipse in which alpha ≥ 1/255, rounded up to pixels.
    """

    means2d: Float[Tensor, "v n 2"]
    depths: Float[Tensor, "v n"]
    covariances: Float[Tensor, "v n 3"]
    determinants: Float[Tensor, "v n"]
    compensations: Float[Tensor, "v n"] | None
    slants: Float[Tensor, "v n 2"] | None
    radii: Int32[Tensor, "v n 2"]


@dataclass(frozen=True)
class BlendOptions:
    """How features are blended.

    Attributes:
        width: Of the images, pixels.
        height: Of the images, pixels.
        alpha_max: Cap on a pixel's alpha, below 1.
    """

    width: int
    height: int
    alpha_max: float


@dataclass(frozen=True)
class Steps:
    """A backend: see ``feature_reference`` for the arguments.

    Attributes:
        project: From activated Gaussians to the screen.
        sh_colours: Colours of spherical harmonics.
        blend: Features of the projected Gaussians to images.
    """

    project: Callable[..., Projected]
    sh_colours: Callable[..., Tensor]
    blend: Callable[..., tuple[Tensor, Tensor]]
