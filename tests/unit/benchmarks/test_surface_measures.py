"""benchmarks: surface metrics report the errors that exist, and no others."""

import numpy as np
import pytest
from roof_edges import edge_distances, edge_figures
from surface_measures import figures, fitted_colours, harmonic, near_steps, psnr, reached, relief_errors, rmse
from triangle_distances import areas, point_triangle, spread, surface_of, thinned

GSD = 0.028
CELL = 2 * GSD
SIZE = 120


def house() -> tuple[np.ndarray, np.ndarray]:
    """A gabled roof (slope 0.8) above level ground, at the centres of cells, and the cosine of its normals."""
    x, y = np.meshgrid((np.arange(SIZE) + 0.5) * CELL, (np.arange(SIZE) + 0.5) * CELL)
    roof = (np.abs(x - 3.0) < 1.5) & (np.abs(y - 3.0) < 2.0)
    heights = np.where(roof, 5.0 - 0.8 * np.abs(x - 3.0), 0.0)
    return heights, np.where(roof, 1.0 / np.hypot(1.0, 0.8), 1.0)


def judged(found: np.ndarray, **more: np.ndarray) -> dict[str, float]:
    heights, cosine = house()
    counts = ~near_steps(heights, 4 * GSD, 2) & more.get("where", np.ones(heights.shape, bool))
    return figures(relief_errors(found, heights, cosine)[counts], GSD)


def on_roof() -> np.ndarray:
    return house()[1] < 1.0


def test_the_truth_is_perfect() -> None:
    row = judged(house()[0])
    assert (row["bias"], row["nmad"], row["p95"], row["complete"], row["within_2"]) == (0.0, 0.0, 0.0, 1.0, 1.0)


def test_a_model_that_is_too_high_has_that_bias_normal_to_its_slopes() -> None:
    raised = house()[0] + GSD
    assert judged(raised, where=~on_roof())["bias"] == pytest.approx(1.0)
    assert judged(raised, where=on_roof())["bias"] == pytest.approx(1.0 / np.hypot(1.0, 0.8))
    assert judged(house()[0] - GSD, where=~on_roof())["bias"] == pytest.approx(-1.0)


def test_a_shift_by_half_a_cell_affects_only_slopes() -> None:
    """Away from steps the ground is unaffected; a slope is off by its rise, the two in opposite directions."""
    heights = house()[0]
    shifted = 0.5 * (heights + np.roll(heights, 1, axis=1))
    assert judged(shifted, where=~on_roof())["p95"] == 0.0
    row = judged(shifted, where=on_roof())
    off = 0.5 * CELL * 0.8 / np.hypot(1.0, 0.8) / GSD
    assert row["p95"] == pytest.approx(off) and off > 0.6
    assert max(abs(row["bias"]), row["nmad"]) > 0.6  # the median of two values may be either: then the bias shows it


def test_a_shift_by_a_whole_cell_is_tolerated_at_steps_only() -> None:
    heights = house()[0]
    assert judged(np.roll(heights, 2, axis=0), where=~on_roof())["within_3"] == 1.0
    assert judged(np.roll(heights, 4, axis=0), where=~on_roof())["within_3"] < 1.0


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_noise_is_measured_correctly(sigma: float) -> None:
    """The NMAD of 10,000 normal errors is their deviation to 2 %."""
    noise = np.random.default_rng(1).normal(0.0, sigma * GSD, (SIZE, SIZE))
    row = judged(house()[0] + noise, where=~on_roof())
    assert row["nmad"] == pytest.approx(sigma, rel=0.05) and abs(row["bias"]) < 0.05 * sigma
    assert row["p95"] == pytest.approx(1.96 * sigma, rel=0.05)


def test_outliers_are_noticed() -> None:
    """6 % of gross errors hardly affect bias and NMAD, but fail the share."""
    found, rng = house()[0], np.random.default_rng(2)
    found[rng.random(found.shape) < 0.06] += 1.0
    row = judged(found)
    assert abs(row["bias"]) < 0.01 and row["nmad"] < 0.1 and row["within_3"] < 0.95 and row["p95"] > 3.0


def test_missing_cells_count_as_wrong() -> None:
    found, rng = house()[0], np.random.default_rng(3)
    found[rng.random(found.shape) < 0.3] = np.nan
    row = judged(found)
    assert row["complete"] == pytest.approx(0.7, abs=0.02) == row["within_3"]
    assert row["p95"] is None and row["bias"] == 0.0
    found[rng.random(found.shape) < 0.5] = np.nan
    assert judged(found)["nmad"] is None  # most is missing: no median of it
    none = judged(np.full_like(found, np.nan))
    assert none["complete"] == none["within_3"] == 0.0 and none["bias"] is None


def test_nothing_to_measure_is_no_figure() -> None:
    assert figures(np.zeros(0), GSD) == {"cells": 0}


def test_steps_are_found_and_slopes_are_not_steps() -> None:
    heights, cosine = house()
    near = near_steps(heights, 4 * GSD, 2)
    inside = np.zeros_like(near)
    rows, columns = np.nonzero(cosine < 1.0)
    inside[rows.min() + 2 : rows.max() - 1, columns.min() + 2 : columns.max() - 1] = True
    assert not near[inside].any()  # the ridge and both slopes count
    assert near[rows.min() - 2, 60] and not near[rows.min() - 3, 60]
    nothing = heights.copy()
    nothing[5, 5] = -np.inf
    assert near_steps(nothing, 4 * GSD, 1)[5, 6] and not near_steps(nothing, 4 * GSD, 1)[5, 8]


def test_psnr_counts_missing_pixels_as_black() -> None:
    rng = np.random.default_rng(4)
    truth = rng.integers(60, 200, (80, 80, 3), np.uint8)
    every = np.ones((80, 80), bool)
    assert psnr(truth, truth, every) == 1000.0
    assert psnr((truth + 1).astype(np.uint8), truth, every) == pytest.approx(48.13, abs=0.01)
    holed = truth.copy()
    holed[:16] = 0
    assert psnr(holed, truth, every) < 13.0
    darker = (truth * 0.5).astype(np.uint8)
    assert psnr(fitted_colours(darker, truth, every), truth, every) > 45.0 > 15.0 > psnr(darker, truth, every)


def test_rmse_fails_if_one_is_not_found() -> None:
    assert rmse(np.array([[3.0, 4.0], [0.0, 0.0]])) == pytest.approx(np.sqrt(12.5))
    assert rmse(np.array([[0.0, 0.0], [np.nan, np.nan]])) is None
    assert rmse(np.zeros((0, 2))) is None


def roof_picture(shift: float = 0.0, blur: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """A tiled roof on a lawn, turned by 17°, shifted eastwards, 8 bits, and its mask."""
    import cv2

    x, y = np.meshgrid(np.arange(0.0, 300.0, 0.25), np.arange(0.0, 300.0, 0.25))
    x, y = x + 0.125 - shift, y + 0.125
    u, v = (x - 150) * 0.956 + (y - 150) * 0.292, (y - 150) * 0.956 - (x - 150) * 0.292
    roof = (np.abs(u) < 90) & (np.abs(v) < 60)
    tiles = 150 + 12 * (np.sin(u / 1.2) > 0) + 8 * (np.sin(v / 1.9) > 0)
    lawn = 70 + 10 * np.sin(x / 3.1) * np.cos(y / 2.3)
    grey = cv2.resize(np.where(roof, tiles, lawn).astype(np.float32), (300, 300), interpolation=cv2.INTER_AREA)
    mask = cv2.resize(roof.astype(np.float32), (300, 300), interpolation=cv2.INTER_AREA) > 0.5
    grey = cv2.GaussianBlur(grey, (0, 0), blur)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8), mask


def edges_of(picture: np.ndarray) -> dict[str, float]:
    truth, mask = roof_picture()
    return edge_figures(edge_distances(picture, truth, mask, np.ones(mask.shape, bool)))


def test_edges_of_the_true_image_are_found_in_place() -> None:
    row = edges_of(roof_picture()[0])
    assert row["edges"] > 150 and row["median"] == 0.0 and row["p95"] == 0.0 and row["lost"] == 0.0
    noisy = roof_picture()[0] + np.random.default_rng(5).normal(0, 4, (300, 300, 1))
    row = edges_of(np.clip(noisy, 0, 255).astype(np.uint8))
    assert row["median"] <= 0.5 and row["p95"] <= 1.0


@pytest.mark.parametrize("shift", [1.0, 2.0, 5.0])
def test_a_roof_that_leans_is_caught(shift: float) -> None:
    """Eastwards by some pixels: the long sides lie 73° to that, the short ones 17°."""
    row = edges_of(roof_picture(shift)[0])
    assert row["p95"] == pytest.approx(0.956 * shift, abs=0.4)  # a quarter pixel's steps, and corners
    assert row["median"] == pytest.approx(0.292 * shift, abs=0.35) or row["median"] > 0.292 * shift


def test_a_wall_beside_its_roof_is_caught() -> None:
    """A strip of bright wall, 6 px, leans out on one side: a quarter of the edges."""
    picture, mask = roof_picture()
    moved = roof_picture(6.0)[1]
    picture[moved & ~mask] = 235
    row = edges_of(picture)
    assert row["p95"] > 3.0


def test_a_roof_that_is_smeared_or_gone_is_lost() -> None:
    picture, mask = roof_picture()
    gone = picture.copy()
    gone[mask] = 70
    assert edges_of(gone)["lost"] > 0.8 and edges_of(gone)["median"] is None
    assert edges_of(roof_picture(0.0, 8.0)[0])["lost"] > 0.9
    assert edges_of(np.zeros_like(picture))["lost"] == 1.0


def test_a_torn_edge_is_caught() -> None:
    """Every fourth stretch of 8 rows is shifted by 4 px."""
    picture, other = roof_picture()[0], roof_picture(4.0)[0]
    torn = np.where((np.arange(300) // 8 % 4 == 0)[:, None, None], other, picture)
    assert edges_of(torn)["p95"] > 3.0 and edges_of(torn)["median"] <= 1.0


BOX = np.array([[[0, 0, 0], [4, 0, 0], [4, 0, 3]], [[0, 0, 0], [4, 0, 3], [0, 0, 3]]], np.float64)  # a wall, 4 × 3 m


def test_distances_to_triangles_are_exact() -> None:
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    points = np.array([[0.2, 0.2, 0.5], [-3, -4, 0], [2, 0, 0], [1, 1, 0], [0.5, -1, 1], [0.3, 0.3, 0]])
    expected = [0.5, 5.0, 1.0, np.sqrt(0.5), np.sqrt(2.0), 0.0]
    np.testing.assert_allclose(point_triangle(points, np.repeat(triangle, 6, axis=0)), expected, atol=1e-12)
    sliver = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]]])
    np.testing.assert_allclose(point_triangle(np.array([[1.5, 2.0, 0.0]]), sliver), [2.0])


def test_distances_to_a_surface_are_those_to_its_nearest_triangle() -> None:
    """Exact near the surface; farther away distances may be too long, beyond any bound, but never too short."""
    rng = np.random.default_rng(6)
    triangles = rng.random((60, 1, 3)) * 4.0 + rng.normal(0.0, 0.4, (60, 3, 3))
    points = spread(triangles, 500, rng)[0] + rng.normal(0.0, 0.03, (500, 3))
    every = np.stack([point_triangle(points, np.repeat(t[None], 500, axis=0)) for t in triangles]).min(axis=0)
    found = surface_of(triangles, 0.03, rng).distances(points)
    assert (found >= every - 1e-12).all() and (found - every < 1e-12).mean() > 0.99
    assert areas(BOX).sum() == pytest.approx(12.0)


def test_places_are_spread_evenly() -> None:
    places, rows = spread(BOX, 20_000, np.random.default_rng(7))
    assert (rows == 0).mean() == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(places.mean(axis=0), [2.0, 0.0, 1.5], atol=0.03)
    np.testing.assert_allclose(places.std(axis=0), [4 / 12**0.5, 0.0, 3 / 12**0.5], rtol=0.03)


def test_a_doubled_wall_costs_precision_and_half_a_wall_recall() -> None:
    rng = np.random.default_rng(8)
    surface, bound = surface_of(BOX, 0.05, rng), 2 * GSD
    wall = spread(BOX, 30_000, rng)[0]
    assert reached(surface.distances(wall), bound) == 1.0
    doubled = np.concatenate([wall, wall + np.array([0.0, 3.0 * GSD, 0.0])])
    assert reached(surface.distances(thinned(doubled, GSD)), bound) == pytest.approx(0.5, abs=0.02)
    half = surface_of(BOX[:1], 0.05, rng)
    assert reached(half.distances(wall), bound) == pytest.approx(0.5, abs=0.03)
    assert harmonic(1.0, 0.5) == pytest.approx(2 / 3) and harmonic(0.0, 0.0) == 0.0
    assert reached(np.zeros(0), bound) == 0.0


def test_one_point_per_voxel_is_kept() -> None:
    points = np.concatenate([np.zeros((50, 3)), np.full((1, 3), 1.0)])
    assert len(thinned(points, GSD)) == 2 and len(thinned(np.zeros((0, 3)), GSD)) == 0
