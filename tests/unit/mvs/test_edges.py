"""Edges of near objects in a depth map, aligned to the photo's."""

import numpy as np
from jaxtyping import Float32, UInt8

from splatpipe.pipeline.mvs.edges import pixels_behind

RED, GREEN = (170, 60, 50), (70, 120, 60)
EDGE = 30  # column where the roof truly ends


def roof_over_lawn(
    wider: int, lawn: tuple[int, int, int] = GREEN, below: float = 16.0
) -> tuple[Float32[np.ndarray, "h w"], UInt8[np.ndarray, "h w 3"]]:
    """Return depths whose roof, 12 m away, extends a given number of pixels too far, and the photo."""
    depth = np.full((40, 60), below, np.float32)
    depth[:, : EDGE + wider] = 12.0
    noise = np.random.default_rng(1).integers(-20, 21, (40, 60, 3))
    colour = np.where(np.arange(60)[None, :, None] < EDGE, RED, lawn) + noise
    return depth, np.clip(colour, 0, 255).astype(np.uint8)


def test_pixels_that_look_like_the_background_get_its_depth() -> None:
    depth, colour = roof_over_lawn(wider=3)
    rows, columns, behind = pixels_behind(depth, colour)
    strip = (columns >= EDGE) & (columns < EDGE + 3)
    assert strip.sum() > 0.9 * 3 * len(depth)
    assert (~strip).sum() <= 3
    assert np.abs(behind - 16.0).max() < 1e-3
    assert len(rows) == len({*zip(rows.tolist(), columns.tolist(), strict=True)})


def test_a_correct_edge_is_unchanged() -> None:
    assert len(pixels_behind(*roof_over_lawn(wider=0))[0]) <= 3


def test_edges_between_similar_sides_are_unchanged() -> None:
    assert not len(pixels_behind(*roof_over_lawn(wider=3, lawn=RED))[0])


def test_a_slope_is_no_edge() -> None:
    assert not len(pixels_behind(*roof_over_lawn(wider=3, below=12.2))[0])


def test_places_without_depth_are_no_side() -> None:
    depth, colour = roof_over_lawn(wider=3)
    depth[:, EDGE + 3 :] = 0.0
    assert not len(pixels_behind(depth, colour)[0])
    assert not len(pixels_behind(np.zeros_like(depth), colour)[0])
