"""Depth disagreement between views, from exact depth maps of planes and boxes."""

from dataclasses import replace

import numpy as np
import pytest

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.render.consistency import (
    NO_SURFACE,
    SAMPLE_EVERY,
    depth_differences,
    depth_disagreement,
    neighbouring_pairs,
)

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
WALL = 10.0
PATCH = (slice(24, 40), slice(40, 60))  # rows and columns: 4 × 5 samples


def camera(x: float, turned: float = 0.0) -> Camera:
    pose = np.eye(4)
    cos, sin = np.cos(turned), np.sin(turned)
    pose[:3, :3] = [[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]]
    pose[:3, 3] = -pose[:3, :3] @ [x, 0.0, 0.0]
    return Camera(f"at {x}", WIDTH, HEIGHT, FOCAL, FOCAL + 2.0, WIDTH / 2 + 1.0, HEIGHT / 2, pose)


def true_depth(view: Camera, box: bool = False) -> np.ndarray:
    """Depth of a wall at z = 10, with a board of two units at z = 5 in front of it."""
    rows, columns = np.mgrid[: view.height, : view.width]
    rays = np.stack(((columns + 0.5 - view.cx) / view.fx, (rows + 0.5 - view.cy) / view.fy, np.ones(rows.shape)), 2)
    directions = rays @ view.cam_from_world[:3, :3]
    depth = WALL / directions[..., 2]
    if box:
        nearer = 5.0 / directions[..., 2]
        hit = view.centre() + nearer[..., None] * directions
        on = (np.abs(hit[..., 0]) < 1.0) & (np.abs(hit[..., 1]) < 1.0)
        depth = np.where(on, nearer, depth)
    return depth.astype(np.float32)


LEFT, RIGHT = camera(-0.5), camera(0.5)


def test_true_depths_agree_wherever_both_views_see() -> None:
    found = depth_differences(LEFT, true_depth(LEFT), RIGHT, true_depth(RIGHT))
    # A pixel is 10 / 80 wide there, and the right view lacks what the left sees within 8 of them from its border.
    assert found.size == (HEIGHT // SAMPLE_EVERY) * ((WIDTH - 8) // SAMPLE_EVERY)
    assert np.abs(found).max() < 1e-6


def test_turned_and_smaller_neighbour_agrees_within_half_a_pixel() -> None:
    turned = camera(1.0, turned=-0.2)
    smaller = turned.scaled(60, 45)
    for neighbour in (turned, smaller):
        both = (LEFT, neighbour), (neighbour, LEFT)
        figures = depth_disagreement([depth_differences(a, true_depth(a), b, true_depth(b)) for a, b in both])
        assert figures.pixels > 300 and figures.share == 0.0
        assert figures.median is not None and figures.median < 0.003


def test_a_surface_in_one_view_only_is_a_contradiction() -> None:
    floating = true_depth(LEFT)
    floating[PATCH] = 6.0
    found = depth_differences(LEFT, floating, RIGHT, true_depth(RIGHT))
    wrong = found[found > 0.05]
    assert wrong.size == 20
    np.testing.assert_allclose(wrong, WALL / 6.0 - 1.0, rtol=1e-6)
    figures = depth_disagreement([found])
    assert figures.share == pytest.approx(20 / found.size) and figures.pixels == found.size


def test_occlusion_is_no_contradiction() -> None:
    hidden = true_depth(RIGHT)
    hidden[PATCH] = 6.0
    found = depth_differences(LEFT, true_depth(LEFT), RIGHT, hidden)
    everywhere = depth_differences(LEFT, true_depth(LEFT), RIGHT, true_depth(RIGHT))
    assert 0 < everywhere.size - found.size <= 20
    assert np.abs(found).max() < 1e-6


def test_real_board_in_front_of_the_wall_contradicts_nothing() -> None:
    both = (LEFT, RIGHT), (RIGHT, LEFT)
    found = [depth_differences(a, true_depth(a, box=True), b, true_depth(b, box=True)) for a, b in both]
    without = [depth_differences(a, true_depth(a), b, true_depth(b)) for a, b in both]
    figures = depth_disagreement(found)
    assert figures.share == 0.0 and figures.median is not None and figures.median < 1e-6
    assert figures.pixels < depth_disagreement(without).pixels  # some of the wall is hidden from the other


def test_looking_through_everything_is_the_largest_contradiction() -> None:
    for nothing in (0.0, float("nan"), float("inf")):
        holes = true_depth(RIGHT)
        holes[:] = nothing
        found = depth_differences(LEFT, true_depth(LEFT), RIGHT, holes)
        assert found.size > 0 and set(found.tolist()) == {NO_SURFACE}
        assert depth_differences(RIGHT, holes, LEFT, true_depth(LEFT)).size == 0


def test_views_without_overlap_have_no_figures() -> None:
    away = camera(0.0, turned=np.pi)
    found = depth_differences(LEFT, true_depth(LEFT), away, np.ones((HEIGHT, WIDTH), np.float32))
    assert found.size == 0
    figures = depth_disagreement([found])
    assert (figures.median, figures.share, figures.pixels) == (None, None, 0)
    tiny = replace(LEFT, width=1, height=1)
    assert depth_differences(tiny, np.ones((1, 1), np.float32), LEFT, true_depth(LEFT)).size == 0


def test_each_view_is_paired_with_the_one_that_shares_most_points() -> None:
    seen = [np.arange(start, start + 10) for start in (0, 4, 7, 30)]
    assert neighbouring_pairs(seen) == [(0, 1), (1, 2)]
    assert neighbouring_pairs([np.arange(5)] * 3, most=1) == [(0, 1)]


def test_pairs_are_spread_evenly_and_no_more_than_asked_for() -> None:
    seen = [np.arange(10 * n, 10 * n + 15) for n in range(40)]
    pairs = neighbouring_pairs(seen, most=5)
    assert len(pairs) == 5
    assert [a for a, _ in pairs] == pytest.approx([0, 10, 19, 29, 38], abs=1)


@pytest.mark.parametrize("seen", [[], [np.arange(3)], [np.empty(0, np.int64)] * 2, [np.arange(3), np.arange(5, 8)]])
def test_without_shared_points_there_are_no_pairs(seen: list[np.ndarray]) -> None:
    assert neighbouring_pairs(seen) == []
