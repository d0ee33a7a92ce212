"""Edges of near things in a depth map, trimmed by what the photo shows there."""

import numpy as np
from jaxtyping import Float32, UInt8

from splatpipe.pipeline.mvs.edges import too_wide

RED, GREEN = (170, 60, 50), (70, 120, 60)
EDGE = 30  # column where the roof truly ends


def roof_over_lawn(
    wider: int, lawn: tuple[int, int, int] = GREEN, below: float = 16.0
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w 3"]]:
    """Depths whose roof, 12 m away, ends so many pixels too late, and the photo."""
    depth = np.full((40, 60), below, np.float32)
    depth[:, : EDGE + wider] = 12.0
    noise = np.random.default_rng(1).integers(-20, 21, (40, 60, 3))
    colour = np.where(np.arange(60)[None, :, None] < EDGE, RED, lawn) + noise
    return depth, np.clip(colour, 0, 255).astype(np.uint8)


def test_what_is_too_wide_and_looks_like_what_is_behind_is_found_and_nothing_else() -> None:
    wrong = too_wide(*roof_over_lawn(wider=3))
    assert wrong[:, EDGE : EDGE + 3].mean() > 0.98
    assert wrong[:, :EDGE].sum() + wrong[:, EDGE + 3 :].sum() <= 3
    assert too_wide(*roof_over_lawn(wider=0)).sum() <= 3


def test_where_both_sides_look_alike_nothing_is_said() -> None:
    assert not too_wide(*roof_over_lawn(wider=3, lawn=RED)).any()


def test_a_slope_is_no_edge() -> None:
    assert not too_wide(*roof_over_lawn(wider=3, below=12.2)).any()


def test_places_without_depth_are_no_side() -> None:
    depth, colour = roof_over_lawn(wider=3)
    depth[:, EDGE + 3 :] = 0.0
    assert not too_wide(depth, colour).any()
    assert not too_wide(np.zeros_like(depth), colour).any()
