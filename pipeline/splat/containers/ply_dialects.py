"""Splats of other trainers that differ from the 3DGS layout, read as what they are.

Two scales: "2D Gaussian Splatting for Geometrically Accurate Radiance Fields" (Huang et al., SIGGRAPH 2024).
``filter_3D``: the smoothing filter of "Mip-Splatting: Alias-free 3D Gaussian Splatting" (Yu et al., CVPR 2024), the
standard deviation of a kernel that each Gaussian is convolved with before it is drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatpipe.pipeline.splat.model.gaussians import Gaussians

DC = ("f_dc_0", "f_dc_1", "f_dc_2")
SCALE = ("scale_0", "scale_1", "scale_2")
BYTE_COLOURS = ("red", "green", "blue")
FILTER = "filter_3D"
MAX_LOGIT = 20.0  # an opacity of 1 (or 0) in float32
MIN_ACTIVATED = 100  # Gaussians: by chance, a few may have logits between 0 and 1


@dataclass(frozen=True)
class PlyDialect:
    """How a splat's properties differ from the 3DGS layout.

    Attributes:
        byte_colours: Colours are bytes, without view dependence, instead of ``f_dc``.
        flat: Gaussians have two scales; the third is zero.
        filtered: Gaussians are to be convolved with an isotropic one of their own.
    """

    byte_colours: bool = False
    flat: bool = False
    filtered: bool = False

    @property
    def replaced(self) -> tuple[str, ...]:
        """Properties of the 3DGS layout that it does without."""
        return (DC if self.byte_colours else ()) + (SCALE[2:] if self.flat else ())

    def notes(self, path: Path) -> tuple[str, ...]:
        """What the user should know."""
        found = []
        if self.byte_colours:
            found.append(f"{path} has colours as bytes (red, green, blue) in place of f_dc: they are read as such.")
        if self.flat:
            found.append(f"{path} has two scales, as of 2D Gaussian splatting: its Gaussians are flat.")
        if self.filtered:
            found.append(f"{path} has a filter of its own for each Gaussian ({FILTER}): it is applied to them.")
        return tuple(found)


def dialect_of(kinds: Mapping[str, str]) -> PlyDialect:
    """The dialect of a vertex element.

    Args:
        kinds: numpy types of its properties, by name.
    """
    coloured = all(kinds.get(name) == "u1" for name in BYTE_COLOURS) and not any(name in kinds for name in DC)
    flat = all(name in kinds for name in SCALE[:2]) and SCALE[2] not in kinds
    return PlyDialect(coloured, flat, kinds.get(FILTER) in ("f4", "f8"))


def convolved(
    log_scales: Float[Tensor, "n 3"], logits: Float[Tensor, " n"], filters: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, " n"]]:
    """Convolve Gaussians with isotropic ones, keeping their integral: they become wider and more transparent.

    Args:
        log_scales: Logarithms of standard deviations.
        logits: Of opacities.
        filters: Standard deviations of the kernels, in the unit of the scales.

    Returns:
        Log scales and logits, float32.
    """
    before = log_scales.double()
    after = 0.5 * torch.logaddexp(2.0 * before, 2.0 * filters.double().abs().log()[:, None])
    log_opacities = torch.nn.functional.logsigmoid(logits.double()) + (before - after).sum(1)
    # logit = log(p) - log(1 - p)
    new = log_opacities - torch.log1p(-log_opacities.exp().clamp(max=1.0 - 1e-12))
    return after.float(), new.clamp(-MAX_LOGIT, MAX_LOGIT).float()


def stored_activated(gaussians: Gaussians) -> bool:
    """Whether opacities and scales appear to be stored as they are, not as logits and logarithms.

    No trained splat has all logits between 0 and 1 and all Gaussians larger than 1 along every axis.
    """
    if len(gaussians) < MIN_ACTIVATED:
        return False
    opacities, scales = gaussians.opacity_logits, gaussians.log_scales
    low, high = opacities.aminmax()
    return bool(low >= 0.0 and high <= 1.0 and high - low > 0.0 and scales.min() > 0.0)


def take_logarithms(gaussians: Gaussians) -> None:
    """Turn stored opacities and scales into logits and logarithms, in place."""
    for piece in gaussians.pieces():
        piece.opacity_logits.copy_(torch.logit(piece.opacity_logits.double()).clamp(-MAX_LOGIT, MAX_LOGIT))
        piece.log_scales.log_()
