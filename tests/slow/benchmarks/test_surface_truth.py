"""The surface products' benchmark: the demo's own truth is perfect by it, and errors are reported."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
import rasterio
import surface_checks
import trimesh
from PIL import Image
from rasterio.transform import Affine
from rays import first_hits
from repository import benchmark
from surface_checks import matching, measure_dsm, measure_facades, measure_points, target_difference
from surface_products import Facade, Raster, plan_crs, read_cloud, read_facades, read_mesh, read_raster, true_frame
from surface_scene import GSD_M, SceneTruth, TruthGrid, site_of, straight, true_picture
from surface_truth import Demand, measure
from triangle_distances import spread, surface_of

from splatpipe.demo.truth import depth_maps, parts
from splatpipe.demo.truth.orthographic import AHEAD_M, facade_view, top_view, views, wall_planes
from splatpipe.demo.truth.relief import relief, relief_in
from splatpipe.demo.truth.truth import Triangles, depth_map, true_surface
from splatpipe.demo.truth.visibility import TrueView, photos_that_see
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.survey.crs.world import open_world

CRS = "EPSG:32633"


CELL_M = 0.2


@pytest.fixture(scope="module")
def surface() -> Triangles:
    return true_surface()


@pytest.fixture(scope="module")
def truth(surface: Triangles) -> SceneTruth:
    """The truth with photos that see through everything, which is fast: occlusion is covered by other tests."""
    cameras = [camera.scaled(118, 88) for camera in depth_maps.true_cameras()[1]]
    true_views = [TrueView(camera, np.full((88, 118), np.inf, np.float32)) for camera in cameras]
    return SceneTruth(surface, parts.parts_of(surface), true_views)


def grid_of(cell: float) -> Raster:
    """An empty grid in the demo's CRS that covers everything flown over, on whole cells."""
    world = open_world(true_frame(CRS))
    (west, north), (east, south) = world.crs_from_local(np.array([[-25.0, 25.0, 0.0], [25.0, -25.0, 0.0]]))[:, :2]
    left, top = np.floor(west / cell), np.ceil(north / cell)
    shape = (1, int(np.ceil(top - south / cell)), int(np.ceil(east / cell - left)))
    affine = np.array([[cell, 0.0, left * cell], [0.0, -cell, top * cell]])
    return Raster(np.zeros(shape), np.ones(shape[1:], bool), affine, CRS)


@pytest.fixture(scope="module")
def perfect(truth: SceneTruth) -> tuple[Raster, TruthGrid]:
    """The true surface model as a product, and the truth on its grid."""
    world, grid = open_world(true_frame(CRS)), grid_of(CELL_M)
    site = site_of(truth, grid, world.crs_from_local)
    heights = np.full(grid.there.shape, np.nan)
    rows, columns = site.relief.height.shape
    heights[site.top : site.top + rows, site.left : site.left + columns] = site.relief.height
    there = np.isfinite(heights)
    return Raster(np.where(there, heights, 0.0)[None], there, grid.affine, CRS), site


def measured_rows(site: TruthGrid, raster: Raster) -> dict[str, dict[str, float]]:
    return {row["what"]: row for row in measure_dsm(site, raster)}


def test_reliefs_are_where_parallel_rays_hit(surface: Triangles) -> None:
    rng = np.random.default_rng(0)
    for view in (top_view(0.53), facade_view("south", 0.307), facade_view("east", 0.307)):
        found = relief_in(view, surface)
        for row, column in zip(*(rng.integers(0, size, 5) for size in found.height.shape), strict=True):
            start = view.from_grid(np.array([column + 0.5, row + 0.5, 0.0]))
            with np.errstate(invalid="ignore"):  # triangles that are seen edge-on
                hit = first_hits(start, view.ahead[None], surface)[0]
            assert -found.height[row, column] == pytest.approx(hit, abs=1e-6)


def test_a_relief_knows_its_slopes() -> None:
    """A plane of slope 1 over a grid of half metres, and an invisible sliver."""
    plane = np.array([[[0, 0, 0], [8, 0, 4.0], [0, 8, 0]], [[1, 1, 9], [1, 1, 9], [2, 2, 9.0]]], np.float64)
    found = relief(plane, 4, 4, 0.5)
    np.testing.assert_allclose(found.height[0], [0.25, 0.75, 1.25, 1.75])
    np.testing.assert_allclose(found.cosine, np.sqrt(0.5))
    assert (found.triangle == 0).all()
    empty = relief(plane + np.array([100.0, 0.0, 0.0]), 4, 4, 0.5)
    assert np.isneginf(empty.height).all() and (empty.triangle == -1).all() and (empty.cosine == 0.0).all()


def test_views_look_where_they_say() -> None:
    for view in views(0.1):
        np.testing.assert_allclose(view.from_grid(view.to_grid(np.ones((2, 3)))), 1.0, atol=1e-12)
        assert np.linalg.norm(view.ahead) == pytest.approx(1.0)
    assert top_view().ahead.tolist() == [0.0, 0.0, -1.0]
    for name, (wall, span, _) in wall_planes().items():
        view = facade_view(name)
        assert view.ahead @ wall.n == pytest.approx(-1.0) and abs(wall.n[2]) < 1e-12
        left, right = view.to_grid(np.stack([wall.origin, wall.point(span, 0.0)]))
        assert left[0] < right[0] and left[2] == pytest.approx(AHEAD_M[name])


def test_parts_are_where_they_are_built(surface: Triangles) -> None:
    of = parts.parts_of(surface)
    tops = {part: surface[of == part][..., 2] for part in range(len(parts.NAMES))}
    assert np.abs(tops[parts.GROUND]).max() < 0.02
    assert tops[parts.SHEETED].min() > 2.4 and tops[parts.SHEETED].max() < 3.9
    assert tops[parts.TILED].max() < 9.2 and tops[parts.TILED].min() > 4.5
    assert tops[parts.PLAIN].max() < 8.9
    assert (of == parts.HOUSE).sum() > 4000


def test_the_truth_is_perfect_and_all_of_it_counts(perfect: tuple[Raster, TruthGrid]) -> None:
    raster, site = perfect
    rows = measured_rows(site, raster)
    for what in ("roofs and ground", "roofs", "ground", "metal roof"):
        assert rows[what]["within_3"] == rows[what]["complete"] == 1.0
        assert rows[what]["p95"] == 0.0 and rows[what]["cells"] > 100
    both = rows["roofs"]["cells"] + rows["ground"]["cells"]
    assert rows["roofs and ground"]["cells"] == both
    assert both * CELL_M**2 > 500.0  # in the 1,500 m² flown over


def test_a_model_one_gsd_too_high_is_noticed(perfect: tuple[Raster, TruthGrid]) -> None:
    raster, site = perfect
    rows = measured_rows(site, replace(raster, bands=raster.bands + GSD_M))
    assert rows["ground"]["bias"] == pytest.approx(1.0, abs=1e-6)
    assert 0.75 < rows["roofs"]["bias"] < 0.99


def test_a_model_that_ends_early_or_has_no_data_is_incomplete(perfect: tuple[Raster, TruthGrid]) -> None:
    raster, site = perfect
    there = raster.there.copy()
    there[:, : there.shape[1] // 2] = False
    row = measured_rows(site, replace(raster, there=there))["roofs and ground"]
    assert row["complete"] == row["within_3"] < 0.7
    cut = Raster(raster.bands[:, :100, :100], raster.there[:100, :100], raster.affine, CRS)
    small = site_of(site.truth, cut, open_world(true_frame(CRS)).crs_from_local)
    row = measured_rows(small, cut)["roofs and ground"]
    assert row["complete"] == row["within_3"] < 0.5


def test_a_smoothed_model_is_wrong_at_the_eaves_which_count_separately(perfect: tuple[Raster, TruthGrid]) -> None:
    raster, site = perfect
    held = raster.bands[0]
    smooth = sum(np.roll(held, (r, c), (0, 1)) for r in (-1, 0, 1) for c in (-1, 0, 1)) / 9.0
    rows = measured_rows(site, replace(raster, bands=smooth[None]))
    assert rows["ground"]["within_3"] > 0.99 and rows["apart: near steps"]["within_3"] < 0.9


def wall_facade(name: str, surface: Triangles, ahead: float = 0.0) -> Facade:
    """A wall's true elevation, exactly as large as the wall; its depths with an error."""
    wall, span, high = wall_planes()[name]
    pixel = 0.05
    view = replace(facade_view(name, pixel), origin=wall.point(0.0, high, AHEAD_M[name]))
    view = replace(view, width=round(span / pixel), height=round(high / pixel))
    depth = relief_in(view, surface).height + AHEAD_M[name] + ahead
    corners = np.stack([wall.point(0.0, high), wall.point(span, high), wall.point(span, 0.0), wall.point(0.0, 0.0)])
    return Facade(name, corners, np.where(np.isfinite(depth), depth, np.nan))


def test_elevations_are_judged_by_their_walls(truth: SceneTruth) -> None:
    facades = [wall_facade(name, truth.triangles) for name in ("south", "north", "west")]
    facades[1] = wall_facade("north", truth.triangles, 1.0 * GSD_M)
    facades[2].depth[:, : facades[2].depth.shape[1] // 2] = np.nan
    rows = {row["what"]: row for row in measure_facades(truth, facades)}
    assert rows["south"]["cells"] > 1000 and abs(rows["south"]["bias"]) < 0.01 and rows["south"]["nmad"] < 0.05
    assert rows["south"]["complete"] > 0.97 and rows["south"]["within_25"] > 0.95
    assert rows["south"]["corners"] == pytest.approx(0.0, abs=1e-6)
    assert rows["north"]["bias"] == pytest.approx(1.0, abs=0.05)
    assert rows["west"]["complete"] < 0.7 and rows["west"]["within_25"] < 0.7
    assert rows["east"]["complete"] == 0.0 and rows["east"]["corners"] is None
    assert rows["all walls"]["corners"] is None and rows["all walls"]["complete"] < 0.8
    moved = replace(facades[0], corners=facades[0].corners + 0.1 * wall_planes()["south"][0].u)
    corners = {row["what"]: row.get("corners") for row in measure_facades(truth, [moved])}
    assert corners["south"] == pytest.approx(0.1 / GSD_M)


def test_an_elevation_seen_from_inside_matches_no_wall(surface: Triangles) -> None:
    facade = wall_facade("south", surface)
    mirrored = replace(facade, corners=facade.corners[[1, 0, 3, 2]])
    assert matching([facade], "south") is facade
    assert matching([mirrored], "south") is None and matching([facade], "north") is None


def plate(size: float = 16.0) -> tuple[Triangles, list[TrueView]]:
    """A level square about the house's place, and nine photos of it from above."""
    a, b, c, d = (np.array([x * size / 2, y * size / 2, 0.0]) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
    triangles = np.array([[a, b, c], [a, c, d]])
    true_views = []
    for x in (-4.0, 0.0, 4.0):
        for y in (-4.0, 0.0, 4.0):
            pose = np.array([[1.0, 0, 0, -x], [0, -1, 0, y], [0, 0, -1, 20.0], [0, 0, 0, 1]])
            camera = Camera(f"{x}{y}", 120, 90, 60.0, 60.0, 60.0, 45.0, pose)
            true_views.append(TrueView(camera, depth_map(camera, triangles).astype(np.float32)))
    return triangles, true_views


def test_photos_see_what_is_not_occluded() -> None:
    true_views = plate()[1]
    places = np.array([[0.0, 0, 0], [3.0, 1, 0], [0, 0, -0.5], [500.0, 0, 0]])
    up = np.tile([0.0, 0.0, 1.0], (4, 1))
    assert photos_that_see(places, up, true_views).tolist() == [9, 9, 0, 0]
    level = np.tile([1.0, 0.0, 0.0], (4, 1))
    assert photos_that_see(places, level, true_views)[0] == 6  # three are straight above: seen as a line


def test_clouds_and_meshes_are_judged_on_both_sides(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_checks, "SAMPLES", 8_000)
    triangles, true_views = plate()
    scene = SceneTruth(triangles, np.full(2, parts.GROUND, np.int8), true_views)
    rng = np.random.default_rng(0)
    true = surface_of(triangles, 0.1, rng)
    points = spread(triangles, 40_000, rng)[0]
    row = measure_points(scene, true, points, true.distances)
    assert row["precision"] == row["recall"] == row["f1"] == 1.0 and row["true places"] > 1_000
    floating = np.concatenate([points, points + np.array([0.0, 0.0, 3 * GSD_M])])
    assert measure_points(scene, true, floating, true.distances)["precision"] == pytest.approx(0.5, abs=0.02)
    half = surface_of(triangles[:1], 0.1, rng)
    row = measure_points(scene, true, points[points[:, 0] > points[:, 1]], half.distances)
    assert row["precision"] == 1.0 and row["recall"] == pytest.approx(0.5, abs=0.03)
    nothing = measure_points(scene, true, np.zeros((0, 3)), lambda places: np.full(len(places), np.inf))
    assert nothing["f1"] == 0.0


def test_targets_are_located() -> None:
    """Painted at eight times the size, 18 px wide, off a pixel's centre: in place, displaced, missing."""
    y, x = (np.mgrid[:1280, :1280] + 0.5) / 8.0
    place = np.array([80.375, 79.625])
    u, v = x - place[0], y - place[1]
    inside = np.maximum(np.abs(u), np.abs(v)) < 9
    grey = np.where(inside, np.where(u * v > 0, 215.0, 40.0), 120.0).reshape(160, 8, 160, 8).mean(axis=(1, 3))
    picture = np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)
    np.testing.assert_allclose(target_difference(picture, place), 0.0, atol=0.15)
    np.testing.assert_allclose(target_difference(picture, place - [2.0, -1.0]), [2.0, -1.0], atol=0.15)
    assert np.isnan(target_difference(np.full_like(picture, 120), place)).all()
    assert np.isnan(target_difference(picture, np.array([20.0, 140.0]))).all()


def test_the_true_image_is_aligned_with_the_products_pixels(perfect: tuple[Raster, TruthGrid], tmp_path: Path) -> None:
    """On an image whose colours encode their position, east and south."""
    view = top_view(0.1)
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    linear = np.stack([x / view.width, y / view.height, np.full_like(x, 0.5)], axis=-1)
    coded = 1.055 * linear ** (1 / 2.4) - 0.055
    Image.fromarray((np.clip(coded, 0, 1) * 255 + 0.5).astype(np.uint8)).save(tmp_path / "top.png")
    site = perfect[1]
    picture, whole = true_picture(tmp_path / "top.png", top_view(), site)
    rows, columns = (part[::97] for part in np.nonzero(whole))
    places = site.way.back(np.column_stack([columns + 0.5, rows + 0.5, np.zeros(len(rows))]))
    share = (view.to_grid(places)[:, :2] / [view.width, view.height]).clip(0.02, 1.0)
    expected = (1.055 * share ** (1 / 2.4) - 0.055) * 255
    far = (share > 0.03).all(axis=1)
    assert far.sum() > 100 and np.abs(picture[rows, columns, :2] - expected)[far].max() < 1.6
    assert 0.3 < whole.mean() < 0.9 and not whole[0, 0]


def test_transformation_to_a_crs_is_linear_enough_and_invertible() -> None:
    world, grid = open_world(true_frame(CRS)), grid_of(1.0)
    way = straight(lambda points: grid.to_grid(world.crs_from_local(points)), grid.cell)
    points = np.random.default_rng(0).uniform([-20, -20, 0], [20, 20, 9], (50, 3))
    np.testing.assert_allclose(way.back(way(points)), points, atol=1e-6)
    np.testing.assert_allclose(grid.from_grid(way(points)), world.crs_from_local(points), atol=2e-3)


def write_products(out: Path, raster: Raster, surface: Triangles) -> None:
    """The true surface model, a cloud and a mesh as files, a façade's elevation."""
    world = open_world(true_frame(CRS))
    profile = {"driver": "GTiff", "dtype": "float32", "nodata": -9999.0, "count": 1}
    height, width = raster.there.shape
    at = Affine(*raster.affine[0], *raster.affine[1])
    with rasterio.open(out / "dsm.tif", "w", width=width, height=height, crs=CRS, transform=at, **profile) as file:
        file.write(np.where(raster.there, raster.bands[0], -9999.0).astype(np.float32), 1)
    facade = wall_facade("south", surface)
    height, width = facade.depth.shape
    place = Affine(0.05, 0.0, 0.0, 0.0, -0.05, 0.0)
    with rasterio.open(out / "south.tif", "w", width=width, height=height, transform=place, **profile) as file:
        file.write(np.where(np.isfinite(facade.depth), facade.depth, -9999.0).astype(np.float32), 1)
    corners = world.crs_from_local(facade.corners).tolist()
    text = json.dumps({"facades": [{"name": "south", "corners": corners, "depth": "south.tif"}]})
    (out / "facades.json").write_text(text)


def test_files_are_measured_and_missing_ones_fail(
    perfect: tuple[Raster, TruthGrid], truth: SceneTruth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_products(tmp_path, perfect[0], truth.triangles)
    folder = tmp_path / "depths"
    folder.mkdir()
    for view in truth.true_views:
        depth = np.where(np.isfinite(view.depth), view.depth, 0.0).astype(np.float32)
        depth_maps.save(folder / f"{view.camera.name}.npz", view.camera, depth, np.zeros(depth.shape, np.uint8))
    tables = measure(tmp_path, ["dsm", "ortho", "facades"], "none", None, folder)
    assert set(tables) == {"dsm", "facades"}
    rows = {row["what"]: row for row in tables["dsm"]}
    assert rows["roofs and ground"]["p95"] < 0.01 and rows["roofs and ground"]["complete"] == 1.0
    walls = {row["what"]: row for row in tables["facades"]}
    assert walls["south"]["nmad"] < 0.05 and walls["north"]["complete"] == 0.0
    bias = Demand("bias", "dsm", "roofs", "bias", 0.5)
    assert bias.judge(tables)["holds"] == "yes"
    assert bias.judge({"dsm": [{"what": "roofs", "bias": -0.6}]})["holds"] == "NO"
    assert Demand("PSNR", "ortho", 0, "psnr", 24.0, least=True).judge(tables)["holds"] == "NO"
    with pytest.raises(UsageError):
        measure(tmp_path, ["ortho"], "none", None, folder)
    with pytest.raises(UsageError):
        measure(tmp_path, ["dsm"], "cameras", None, folder)


def test_readers_know_their_frames(tmp_path: Path) -> None:
    world = open_world(true_frame(CRS))
    corners = np.array([[[0.0, 0, 0], [4, 0, 0], [4, 0, 3]]])
    mesh = trimesh.Trimesh(corners[0], [[0, 1, 2]], process=False)
    mesh.export(tmp_path / "mesh.ply")
    y_up = trimesh.Trimesh(corners[0][:, [0, 2, 1]] * [1, 1, -1], [[0, 1, 2]], process=False)
    y_up.export(tmp_path / "mesh.glb")
    for name in ("mesh.ply", "mesh.glb"):
        np.testing.assert_allclose(read_mesh(tmp_path / name), corners, atol=1e-6)
    header = laspy.LasHeader(point_format=6, version="1.4")
    there = world.crs_from_local(corners[0])
    header.offsets, header.scales = np.floor(there.min(axis=0)), np.full(3, 0.001)
    cloud = laspy.LasData(header)
    cloud.xyz = there
    cloud.write(tmp_path / "cloud.laz")
    found = read_cloud(tmp_path / "cloud.laz", world.local_from_crs, lambda points: points)
    np.testing.assert_allclose(found, corners[0], atol=0.002)
    compound = "EPSG:25833+7837"
    assert plan_crs(rasterio.CRS.from_user_input(compound).to_wkt()) == "EPSG:25833"


@pytest.mark.parametrize(
    "text",
    ["", "{}", '[{"name": "a"}]', '[{"name": "a", "corners": [[0, 0, 0]], "depth": "none.tif"}]', '{"facades": 3}'],
)
def test_invalid_elevations_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "facades.json").write_text(text)
    with pytest.raises(UsageError):
        read_facades(tmp_path / "facades.json", lambda points: points)


def test_a_raster_without_a_crs_is_refused_and_nan_is_no_data(tmp_path: Path) -> None:
    at = Affine(1.0, 0.0, 0.0, 0.0, -1.0, 0.0)
    heights = np.array([[1.0, np.nan], [3.0, 4.0]], np.float32)
    for name, crs in (("with.tif", CRS), ("without.tif", None)):
        profile = {"driver": "GTiff", "dtype": "float32", "count": 1, "width": 2, "height": 2}
        with rasterio.open(tmp_path / name, "w", crs=crs, transform=at @ Affine.translation(9, 9), **profile) as file:
            file.write(heights, 1)
    assert read_raster(tmp_path / "with.tif").there.tolist() == [[True, False], [True, True]]
    with pytest.raises(UsageError):
        read_raster(tmp_path / "without.tif")


def test_noisy_depths_have_the_stated_errors() -> None:
    """A level plane 20 m below: 0.3 px of parallax over a base of 4 m, 10 % without depth, 2 % nonsense."""
    camera = Camera("a", 400, 300, 280.0, 280.0, 200.0, 150.0, np.eye(4))
    depth, sure = np.full((300, 400), 20.0, np.float32), np.full((300, 400), 6, np.uint8)
    found, confidence = depth_maps.noisy(camera, depth, sure, 4.0, np.random.default_rng(0))
    there = found > 0.0
    assert (~there).mean() == pytest.approx(0.10, abs=0.002) and (confidence[~there] == 0).all()
    apart = found[there] - 20.0
    assert 1.4826 * np.median(np.abs(apart)) == pytest.approx(0.3 * 20.0**2 / (280.0 * 4.0), rel=0.06)
    assert (np.abs(apart) > 1.0).mean() == pytest.approx(0.02, abs=0.006)
    assert confidence[there].mean() == pytest.approx(0.7 * 6, rel=0.05)
    again, _ = depth_maps.noisy(camera, depth, sure, 4.0, np.random.default_rng(0))
    np.testing.assert_array_equal(found, again)


def test_depth_maps_read_back_from_their_files(tmp_path: Path) -> None:
    true_views = plate()[1]
    cameras = [view.camera for view in true_views]
    depths = [np.where(np.isfinite(view.depth), view.depth, 0.0).astype(np.float32) for view in true_views]
    confidence = depth_maps.confirmations(cameras, depths, 4)
    assert confidence[45, 60] == 8 and confidence[0, 0] == 0 == depths[4][0, 0]
    depth_maps.save(tmp_path / "a.npz", cameras[4], depths[4], confidence)
    camera, depth, sure = depth_maps.load(tmp_path / "a.npz")
    assert (camera.name, camera.width, camera.fx) == (cameras[4].name, 120, 60.0)
    np.testing.assert_array_equal(camera.cam_from_world, cameras[4].cam_from_world)
    np.testing.assert_array_equal(depth, depths[4])
    np.testing.assert_array_equal(sure, confidence)


def test_nothing_to_measure_is_reported(tmp_path: Path) -> None:
    done = subprocess.run(benchmark("surface_truth", tmp_path), capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "has none of" in done.stderr
