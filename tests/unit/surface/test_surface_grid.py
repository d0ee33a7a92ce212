"""The raster grid: whole cells, the CRS of the run, and PROJ's own coordinates to a tenth of a millimetre."""

import numpy as np
import pyproj
import pytest
from hills import GERMANY, IDENTITY, box, hill_grid, placed

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.rasters.grid import Grid, cell_size, make_grid
from splatpipe.pipeline.surface.rasters.map_crs import open_map
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

LATTICE_M = 2e-4  # 0.05 mm a direction by the earth's curvature between nodes, each of two, and as much for projections
ODD = "+proj=tmerc +lat_0=50 +lon_0=10 +k=1 +ellps=bessel +towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7 +units=m"
FEET = "+proj=tmerc +lat_0=52 +lon_0=10 +k=1 +datum=WGS84 +units=us-ft"


def local(grid_box: np.ndarray, count: int = 500) -> np.ndarray:
    return np.random.default_rng(4).uniform(grid_box[0], grid_box[1], (count, 3))


@pytest.mark.parametrize("crs", ["EPSG:25832", "EPSG:3857", "EPSG:2180", ODD, FEET])
def test_grid_is_proj_to_a_fifth_of_a_millimetre_over_three_kilometres(crs: str) -> None:
    frame = placed(crs, "unknown", Origin(52.2, 20.97, 110.0) if crs == "EPSG:2180" else GERMANY)
    scene = box(1500.0, 1500.0, -20.0, 60.0)
    grid = make_grid(frame, scene, 0.03)
    points = local(scene)
    exact = grid.crs.crs_from_local(points)
    units = np.array([grid.crs.unit_m, grid.crs.unit_m, grid.crs.height_unit_m])
    assert (np.abs(grid.crs_from_local(points) - exact) * units).max() < LATTICE_M
    assert np.abs(grid.local_from_crs(exact) - points).max() < LATTICE_M
    cells = grid.cells_from_local(points)
    assert np.abs(grid.local_from_cells(cells) - points).max() < 2.0 * LATTICE_M


def test_centre_of_a_cell_agrees_with_pyproj() -> None:
    grid = hill_grid(placed("EPSG:25832", "ellipsoidal"), 0.03)
    tile = next(t for t in grid.tiles() if t.column > 0 and t.row > 0)
    heights = np.full((tile.height, tile.width), 123.4)
    centre = grid.centres_in_local(tile, heights)[7, 9]
    x, y = grid.transform @ (tile.column + 9.5, tile.row + 7.5)
    lon, lat = pyproj.Transformer.from_crs("EPSG:25832", "EPSG:4979", always_xy=True).transform(x, y)
    ecef = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    there = np.array(ecef.transform(lon, lat, 123.4))
    origin = np.array(ecef.transform(GERMANY.longitude, GERMANY.latitude, GERMANY.height_m))
    up = np.array(ecef.transform(GERMANY.longitude, GERMANY.latitude, GERMANY.height_m + 1.0)) - origin
    assert abs(float(np.linalg.norm(there - origin)) - float(np.linalg.norm(centre))) < LATTICE_M
    assert abs(float((there - origin) @ up) - centre[2]) < LATTICE_M


def test_unknown_places_stay_unknown_and_change_no_other() -> None:
    grid = make_grid(placed(), box(1500.0, 1500.0, -20.0, 60.0), 0.03)
    points = local(box(1500.0, 1500.0, -20.0, 60.0), 50)
    with_holes = points.copy()
    with_holes[::7] = np.nan
    found, whole = grid.cells_from_local(with_holes), grid.cells_from_local(points)
    hole = np.isnan(with_holes).any(axis=1)
    assert np.isnan(found[hole]).all() and np.array_equal(found[~hole], whole[~hole])


def test_grids_with_the_same_cell_have_common_grid_lines() -> None:
    one, other = (make_grid(placed(), box(half, half), 0.03) for half in (10.0, 17.77))
    for grid in (one, other):
        corner = np.array(grid.transform @ (0.0, 0.0)) / grid.cell
        np.testing.assert_allclose(corner, np.round(corner), rtol=0.0, atol=1e-6)
    west, south, east, north = other.bounds
    assert west <= one.bounds[0] and south <= one.bounds[1] and east >= one.bounds[2] and north >= one.bounds[3]


def test_grid_covers_the_scene_and_tiles_cover_the_grid_once() -> None:
    scene = box(40.0, 25.0)
    grid = make_grid(placed(), scene, 0.07)
    cells = grid.cells_from_local(local(scene))
    assert (cells[:, :2] >= 0.0).all() and (cells[:, :2] <= [grid.width, grid.height]).all()
    seen = np.zeros((grid.height, grid.width), np.uint8)
    for tile in grid.tiles(100):
        seen[tile.row : tile.row + tile.height, tile.column : tile.column + tile.width] += 1
    assert (seen == 1).all()


def test_cells_are_round_in_the_unit_of_the_crs_and_of_the_requested_size_on_the_ground() -> None:
    assert cell_size(open_map(placed()), 0.027963) == 0.028
    assert cell_size(open_map(placed()), 0.02) == 0.02  # though a metre of UTM is 0.9996 of the ground's
    assert cell_size(open_map(placed("EPSG:3857", "unknown")), 0.02) == pytest.approx(0.02 * 1.63, rel=0.01)
    assert cell_size(open_map(placed(FEET, "unknown")), 0.02) == 0.0656


def test_heights_follow_the_crs_and_eastings_in_feet_have_heights_in_feet() -> None:
    frame = Frame("enu", IDENTITY, Origin(40.7, -73.9, 30.0), "EPSG:5703", crs="EPSG:2263", approximate_crs=True)
    crs = open_map(frame)
    assert crs.vertical is not None and crs.vertical.to_authority() == ("EPSG", "6360")  # NAVD88 in US survey feet
    there = crs.crs_from_local(np.zeros((1, 3)))[0]
    assert there[2] == pytest.approx(30.0 * 3937.0 / 1200.0)
    assert crs.described_heights() == "EPSG:5703 (NAVD88 height), US survey foot"
    assert open_map(placed("EPSG:25832", "ellipsoidal")).vertical is None
    assert open_map(placed("EPSG:25832", "EPSG:7837")).compound.sub_crs_list[1].to_authority() == ("EPSG", "7837")
    assert open_map(placed("EPSG:25832", "unknown")).described_heights() == "datum unknown, metre"


@pytest.mark.parametrize("crs, origin", [("EPSG:4326", GERMANY), ("EPSG:2053", Origin(-29.0, 29.0, 900.0))])
def test_degrees_and_axes_to_the_west_become_the_utm_zone(crs: str, origin: Origin) -> None:
    grid = make_grid(placed(crs, "unknown", origin), box(20.0, 10.0), 0.05)
    assert "UTM zone" in grid.crs.horizontal.name and grid.cell == 0.05
    assert abs(grid.width * 0.05 - 40.0) < 1.0


def test_heights_of_a_geographic_crs_stay_in_its_datum() -> None:
    crs = open_map(placed("EPSG:4326+7837", "EPSG:7837"))
    assert crs.heights == "EPSG:7837" and crs.compound.is_compound
    assert crs.crs_from_local(np.zeros((1, 3)))[0, 2] == pytest.approx(110.0)


def test_files_contain_the_code_of_the_crs() -> None:
    for text in ("EPSG:25832", "EPSG:25832+7837", "EPSG:5555", "EPSG:4326", ""):
        heights = {"EPSG:25832+7837": "EPSG:7837", "EPSG:5555": "EPSG:5783"}.get(text, "unknown")
        assert open_map(placed(text, heights)).horizontal.to_json_dict()["id"]["authority"] == "EPSG"


def test_frame_of_scale_bars_has_a_grid_in_its_own_metres() -> None:
    frame = Frame("arbitrary", IDENTITY, metres=True)
    grid = make_grid(frame, box(3.0, 2.0), 0.01)
    assert (grid.width, grid.height) == (600, 400) and grid.crs.world is None
    assert grid.crs.horizontal.is_engineering and grid.bounds == pytest.approx((-3.0, -2.0, 3.0, 2.0))
    points = local(box(3.0, 2.0))
    np.testing.assert_allclose(grid.crs_from_local(points), points, atol=1e-12)


def test_scene_of_a_single_place_is_one_cell() -> None:
    grid = make_grid(placed(), box(0.0, 0.0), 0.5)
    assert grid.width in (1, 2) and grid.height in (1, 2)
    assert sum(1 for _ in grid.tiles()) == 1


@pytest.mark.parametrize(
    "frame, scene, gsd_m, message",
    [
        (Frame("arbitrary", IDENTITY), box(1.0, 1.0), 0.02, "no metric scale"),
        (placed(), box(5000.0, 5000.0), 0.001, "too large"),
        (placed(), box(40_000.0, 0.1), 0.02, "too large"),
        (placed(), box(3_000.0, 3_000.0), 0.01, "too large"),
        (placed(), box(10.0, 10.0), 0.0, "not valid for a surface"),
        (placed(), box(10.0, 10.0), float("nan"), "not valid for a surface"),
        (placed(), box(float("inf"), 10.0), 0.02, "no extent"),
        (placed(), -box(10.0, 10.0), 0.02, "no extent"),
    ],
)
def test_scenes_without_a_grid_are_reported(frame: Frame, scene: np.ndarray, gsd_m: float, message: str) -> None:
    with pytest.raises(SplatpipeError, match=message) as error:
        make_grid(frame, scene, gsd_m)
    assert error.value.hint


def test_pyprojs_settings_are_unchanged_after_a_grid() -> None:
    before = pyproj.datadir.get_data_dir(), pyproj.network.is_network_enabled()
    grid: Grid = hill_grid()
    assert (pyproj.datadir.get_data_dir(), pyproj.network.is_network_enabled()) == before
    assert grid.crs.world is not None
