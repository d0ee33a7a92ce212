"""The definition of a render for every backend: options, outputs and the rasterizer's constants."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from jaxtyping import Bool, Float
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.splat.model.gaussians import Gaussians

ALPHA_MAX = 0.99
"""Cap on a pixel's alpha, so that division by 1 - alpha is safe."""
ALPHA_MIN = 1.0 / 255.0
"""Contributions below this (one 8-bit step) are skipped."""
TRANSMITTANCE_MIN = 1e-4
"""The Gaussian that would take a pixel's transmittance below this is not blended, and ends the pixel."""
MEDIAN_TRANSMITTANCE = 0.5
"""The median depth is that of the Gaussian that takes the transmittance down to this."""
MEDIAN_SHIFT_MAX = 0.5
"""Maximum difference of that depth from the Gaussian's centre, as a share: anything longer is not a surface."""
BLUR_PX2 = 0.3
"""Added to the variances on screen: no Gaussian is thinner than about a pixel (EWA's low-pass filter)."""
FRUSTUM_MARGIN = 0.3
"""The projection's linearization is clamped at the frustum plus this share of its half-width: it diverges outside."""
PLANE_SIGMAS = 2.0
"""A Gaussian that reaches the camera plane within this many standard deviations is skipped: the linearization would
spread one that lies beside the image over all of it."""
COMPENSATION_MIN = 2.5e-5
"""Floor of det(Σ') / det(Σ' + blur) in the anti-aliased variant; its root is the least opacity factor, 0.005."""
QUAT_EPSILON = 1e-12
"""Added to a quaternion's squared norm before the root: the zero quaternion is the identity, with zero gradient."""
RADIUS_SIGMAS = 3.0
"""`Render.radii` are this many standard deviations along the longer axis on screen, as published."""

# Beyond these limits a Gaussian is skipped like one with a NaN: nothing useful lies there, and float32 soon overflows.
MAX_SCREEN_PX = 1e7
MAX_VARIANCE_PX2 = 1e12
MAX_QUAT_NORM2 = 1e36
MAX_COLOUR = 1e6
MAX_DEPTH = 1e9


@dataclass(frozen=True)
class RenderOptions:
    """How to render.

    Attributes:
        sh_degree: SH degree used, 0..3; at most the Gaussians' own.
        background: Red, green, blue behind everything, 0..1.
        antialias: Scale opacities by √(det Σ' / det(Σ' + 0.3 I)), floored: a Gaussian keeps its energy when the blur
            widens it ("Mip-Splatting", Yu et al. 2024, the 2D Mip filter).
        near: Gaussians nearer than this are skipped, world units along the view axis, > 0.
        depth: Also render depths; otherwise all are zero and a render is faster.
        depth_origin: Squared depths are measured from it: otherwise float32 loses most of the variance of a depth of
            100 m.
        magnitudes: The probe's gradient sums the pixels' absolute values, separately in x and y, which do not cancel.
    """

    sh_degree: int
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    antialias: bool = False
    near: float = 0.01
    depth: bool = True
    depth_origin: float = 0.0
    magnitudes: bool = False

    def for_depths(self) -> RenderOptions:
        """The same options for depths only: what the rays through the pixels' centres meet.

        Not anti-aliased: the opacity factor for the part of a pixel that a small Gaussian covers would let rays through
        what they hit, and the median depth would lie behind the surface.
        """
        return replace(self, sh_degree=0, background=(0.0, 0.0, 0.0), antialias=False, depth=True)


@dataclass(frozen=True, eq=False)
class Render:
    """A rendered view.

    Attributes:
        colour: Red, green, blue with the background, not clamped at 1.
        alpha: 1 - the remaining transmittance.
        depth_sum: Σ z α T, z along the view axis where the pixel's ray peaks in the Gaussian, world units. Not its
            centre's depth: a wall is made of Gaussians several pixels wide. Linear in screen position, as in Zhang et
            al., "RaDe-GS: Rasterizing Depth in Gaussian Splatting" (2024).
        depth_square_sum: Σ (z - depth_origin)² α T.
        median_depth: The z of the Gaussian that takes T down to 0.5; 0 where none does. No gradient.
        visible: Gaussians whose ellipse (alpha ≥ 1/255) reaches the image.
        radii: Three standard deviations along the longer axis on screen, pixels; 0 where not visible. No gradient.
    """

    colour: Float[Tensor, "h w 3"]
    alpha: Float[Tensor, "h w"]
    depth_sum: Float[Tensor, "h w"]
    depth_square_sum: Float[Tensor, "h w"]
    median_depth: Float[Tensor, "h w"]
    visible: Bool[Tensor, " n"]
    radii: Float[Tensor, " n"]


def check(gaussians: Gaussians, camera: Camera, options: RenderOptions, means2d_probe: Tensor | None) -> None:
    """Reject arguments that no backend can render.

    Raises:
        ValueError: if the image has no pixel or too many, the Gaussians lack the SH degree, the near plane or
            a focal length is not positive and finite, or the probe has the wrong shape.
    """
    if not (1 <= camera.width <= 65536 and 1 <= camera.height <= 65536):
        raise ValueError(f"a picture of {camera.width} × {camera.height} pixels cannot be rendered")
    if not 0 <= options.sh_degree <= gaussians.sh_degree:
        raise ValueError(f"SH degree {options.sh_degree} of Gaussians that hold degree {gaussians.sh_degree}")
    if not (options.near > 0.0 and math.isfinite(options.near)):
        raise ValueError(f"near plane at {options.near}")
    if not all(f > 0.0 and math.isfinite(f) for f in (camera.fx, camera.fy)):
        raise ValueError(f"focal lengths {camera.fx}, {camera.fy}")
    if means2d_probe is not None and tuple(means2d_probe.shape) != (len(gaussians), 2):
        raise ValueError(f"means2d_probe is {tuple(means2d_probe.shape)}, not ({len(gaussians)}, 2)")
