"""Façades of a house with known walls: detected, measured, drawn, and read by other programs."""

import json
import shutil
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pyogrio
import pytest
import rasterio
from house_photos import run_surface
from house_site import EAVES_M, RIDGE_M, ROOF, WALLS, ExactDepths, depths_of, photo_camera, photo_of
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.sources import DepthSource
from splatpipe.pipeline.surface.facades import elevation as elevation_module
from splatpipe.pipeline.surface.facades.elevation import Elevation, ElevationPhotos, draw_elevation, wall_plane
from splatpipe.pipeline.surface.facades.facades import FacadesTask, make_facades
from splatpipe.pipeline.surface.facades.facets import Facets, facets_of, upright_facets
from splatpipe.pipeline.surface.facades.openings import outlines, projections, recesses
from splatpipe.pipeline.surface.facades.walls import MIN_HEIGHT_M, Wall, find_walls
from splatpipe.pipeline.surface.heights.holes import fill_holes
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs, open_map
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

PIXEL_M = 0.04
FRAME = Frame("enu", Similarity.identity(), Origin(47.83, 13.51, 512.0), "ellipsoidal", crs="EPSG:32633")
WALLS_OF_THE_HOUSE = {  # left and right end, seen from the front; top
    "south": ((-4.0, -3.0), (4.0, -3.0), EAVES_M),
    "north": ((4.0, 3.0), (-4.0, 3.0), EAVES_M),
    "east": ((4.0, -3.0), (4.0, 3.0), RIDGE_M),
    "west": ((-4.0, 3.0), (-4.0, -3.0), RIDGE_M),
}


@cache
def maps() -> tuple[ExactDepths, ...]:
    """Sixteen photos around the house, with 0.3 pixels of noise, which neighbours share, and holes."""
    random, found = np.random.default_rng(4), []
    for number, angle in enumerate(np.arange(16) * np.pi / 8 + 0.1):
        eye = (13.0 * np.cos(angle), 13.0 * np.sin(angle), 6.0)
        exact = depths_of(photo_camera(f"a{number}", eye, (0.0, 0.0, 1.5)).scaled(320, 240))
        field = cv2.GaussianBlur(random.standard_normal(exact.depth.shape), (0, 0), 1.5)
        share = 1.0 + 1.2 * field / field.std() / exact.camera.fx  # at a base of a quarter of the distance
        hole = cv2.GaussianBlur(random.standard_normal(exact.depth.shape), (0, 0), 4.0)
        depth = np.where(hole > np.quantile(hole, 0.93), 0.0, exact.depth * share).astype(np.float32)
        found.append(replace(exact, depth=depth, confidence=np.where(depth > 0.0, 4, 0).astype(np.uint8)))
    return tuple(found)


@cache
def photos() -> tuple[PhotoSource, ...]:
    sources = []
    for found in maps():
        photo = photo_of(found.camera)
        depths = DepthSource(found.camera, lambda found=found: found)
        sources.append(PhotoSource(found.camera, lambda photo=photo: photo, depths))
    return tuple(sources)


@cache
def facets() -> Facets:
    return upright_facets([photo.depths for photo in photos() if photo.depths is not None], threads=2)


@cache
def walls() -> dict[str, Wall]:
    return {wall.name: wall for wall in find_walls(facets())}


def drawn(name: str, threads: int = 1) -> Elevation:
    return draw_elevation(
        walls()[name], PIXEL_M, ElevationPhotos(photos(), PhotoGains.plain(16), threads), lambda done, total: None
    )


@cache
def south() -> Elevation:
    return drawn("south")


@cache
def crs() -> MapCrs:
    return open_map(FRAME)


def places_of(elevation: Elevation) -> np.ndarray:
    """Local places of all cells, as the depth has them; nan where there is none."""
    lattice = elevation.plane.lattice
    centres = lattice.centres(next(lattice.tiles(4096)))
    return elevation.plane.local_from_plane(
        np.concatenate([centres, elevation.depth[..., None].astype(np.float64)], axis=-1)
    )


def panel(
    left: tuple[float, float], right: tuple[float, float], low: float, high: float, seed: int = 0, spread: float = 0.01
) -> Facets:
    """Facets of a wall, 0.2 m apart, three at each place."""
    random = np.random.default_rng(seed)
    along = np.subtract(right, left)
    length = float(np.hypot(*along))
    along = along / length
    s, up = (grid.ravel() for grid in np.meshgrid(np.arange(0.1, length, 0.2), np.arange(low + 0.1, high, 0.2)))
    s, up = np.tile(s, 3), np.tile(up, 3)
    facing = np.array([along[1], -along[0]])
    plan = np.array(left) + s[:, None] * along + random.normal(0.0, spread, len(s))[:, None] * facing
    turn = random.normal(0.0, 0.1, len(s))
    turned = np.stack(
        [facing[0] * np.cos(turn) - facing[1] * np.sin(turn), facing[0] * np.sin(turn) + facing[1] * np.cos(turn)]
    )
    return Facets(np.column_stack([plan, up]), turned.T, np.full(len(s), 0.04), np.full(len(s), 0.03))


def joined(*parts: Facets) -> Facets:
    fields = ("places", "facing", "areas", "pixels_m")
    return Facets(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def test_facets_are_upright_and_where_the_walls_are() -> None:
    exact = depths_of(photo_camera("f", (0.5, -13.0, 5.0), (0.0, 0.0, 1.5)).scaled(320, 240))
    found = facets_of(exact)
    house = np.abs(found.places[:, 1] + 3.0) < 0.01
    assert house.sum() > 20
    assert np.abs(found.facing[house] - [0.0, -1.0]).max() < 0.01
    assert found.areas[house].sum() == pytest.approx(8.0 * EAVES_M, rel=0.45)  # blocks at its edges are left out
    assert not len(facets_of(replace(exact, confidence=np.ones_like(exact.confidence))))


def test_facets_are_the_same_bits_for_any_number_of_threads() -> None:
    sources = [photo.depths for photo in photos()[:5] if photo.depths is not None]
    one, many = upright_facets(sources, threads=1), upright_facets(sources, threads=3)
    assert np.array_equal(one.places, many.places)
    assert np.array_equal(one.facing, many.facing)
    assert not len(upright_facets([], threads=1))


def test_the_four_walls_are_found_from_corner_to_corner() -> None:
    assert sorted(walls()) == sorted(WALLS_OF_THE_HOUSE)
    for name, (left, right, top) in WALLS_OF_THE_HOUSE.items():
        wall = walls()[name]
        assert np.abs(wall.left - left).max() < 0.02
        assert np.abs(wall.right - right).max() < 0.02
        assert abs(wall.low_m) < 0.25
        assert top - 0.2 < wall.high_m < top + 0.55


def test_pieces_of_one_wall_are_joined_and_others_are_not() -> None:
    near = find_walls(joined(panel((0, 0), (4, 0), 0, 4), panel((6, 0), (10, 0), 0, 4)))
    assert [(wall.name, round(wall.length_m, 1)) for wall in near] == [("south", 10.0)]
    apart = find_walls(joined(panel((0, 0), (4, 0), 0, 4), panel((9, 0), (14, 0), 0, 4)))
    assert [(wall.name, round(wall.length_m, 1)) for wall in apart] == [("south", 5.0), ("south-2", 4.0)]
    behind = find_walls(joined(panel((0, 0), (4, 0), 0, 4), panel((4, 1), (9, 1), 0, 4)))
    assert len(behind) == 2


def test_fences_cars_and_crowns_are_no_walls() -> None:
    random = np.random.default_rng(1)
    fence = panel((0, 0), (12, 0), 0, 1.6)
    van = panel((0, 9), (4.5, 9), 0.0, MIN_HEIGHT_M + 0.3)
    turn = random.uniform(0, 2 * np.pi, 4000)
    round_m = 2.0 + random.normal(0.0, 0.2, 4000)
    places = np.column_stack([20 + round_m * np.cos(turn), round_m * np.sin(turn), random.uniform(1, 6, 4000)])
    crown = Facets(places, np.column_stack([np.cos(turn), np.sin(turn)]), np.full(4000, 0.04), np.full(4000, 0.03))
    hedge = panel((0, -9), (12, -9), 0, 3.0, spread=0.4)
    assert find_walls(joined(fence, van, crown, hedge)) == []
    clipped = joined(panel((0, 0), (12, 0), 0, 2.3, spread=0.06), panel((12, 0), (12, 9), 0, 2.3, spread=0.06))
    assert find_walls(clipped) == []  # low hedges that meet, of one height and as even as a gardener cuts them
    low = joined(panel((0, 9), (4.5, 9), 0.0, MIN_HEIGHT_M + 0.3), panel((4.5, 9), (4.5, 13), 0.0, 3.0))
    assert [wall.name for wall in find_walls(low)] == ["east", "south"]  # a low one that belongs to a house
    assert find_walls(fence.select(np.zeros(0, np.int64))) == []


def test_depths_and_colours_are_those_of_the_wall() -> None:
    made = south()
    wall = made.wall
    places = places_of(made)
    x, up = places[..., 0], places[..., 2]
    known = np.isfinite(up)
    face = known & (np.abs(x) < 3.9) & (up > 0.1) & (up < EAVES_M - 0.4)
    off = places[..., 1][face] + 3.0
    assert abs(np.median(off)) < 0.5 * PIXEL_M
    assert 1.4826 * np.median(np.abs(off - np.median(off))) < 0.7 * PIXEL_M
    assert (np.abs(off) < 2.5 * PIXEL_M).mean() > 0.97
    lattice = made.plane.lattice
    height = wall.high_m - (np.arange(lattice.height) + 0.5) * PIXEL_M
    inner = made.depth[(height > 0.1) & (height < EAVES_M - 0.4)][:, 3:-3]
    assert np.isfinite(inner).mean() > 0.99
    red = (made.colour[..., 0] > 150) & (made.colour[..., 1] < 80)
    assert red[face].mean() > 0.99
    assert (made.colour[..., 3] > 0)[face].mean() > 0.99


def test_eaves_beyond_the_relief_are_not_smeared_over_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(elevation_module, "BEFORE_M", 0.3)  # the eaves hang half a metre out
    made = drawn("south")
    visible = made.colour[..., 3] > 0
    red = (made.colour[..., 0] > 150) & (made.colour[..., 1] < 80)
    up = made.plane.lattice.north_m - (np.arange(len(red)) + 0.5) * PIXEL_M
    below = (up > 0.1) & (up < EAVES_M - 0.15)  # above that there is the roof's own face, at the foot lawn
    assert visible[below].mean() > 0.85
    assert (visible & ~red)[below][:, 2:-2].mean() < 0.004
    assert np.nanmax(made.depth) < 0.3


def test_the_raster_extends_from_corner_to_corner() -> None:
    corners = south().corners()
    true = np.array([[-4.0, -3.0], [4.0, -3.0], [4.0, -3.0], [-4.0, -3.0]])
    assert np.abs(corners[:, :2] - true).max() < 2.0 * PIXEL_M
    assert np.ptp(corners[:2, 2]) < 1e-9
    assert corners[0, 2] > corners[2, 2]
    plane = south().plane
    assert np.allclose(plane.local_from_plane(plane.plane_from_local(corners)), corners)
    assert plane.plane_from_local(np.array([0.0, -13.0, 2.0]))[2] == pytest.approx(10.0, abs=0.1)  # towards the viewer


def test_threads_change_no_bit_of_an_elevation() -> None:
    many = drawn("south", threads=3)
    assert np.array_equal(many.depth, south().depth, equal_nan=True)
    assert np.array_equal(many.colour, south().colour)


def test_specks_are_removed_and_edges_kept() -> None:
    depth = np.zeros((600, 40), np.float32)
    depth[:, 20:] = -0.16
    depth[300:, :3] = np.nan
    speck = depth.copy()
    speck[100, 10], speck[256, 30], speck[0, 0] = 0.3, 0.1, -0.2
    assert np.array_equal(elevation_module.remove_specks(speck), depth, equal_nan=True)
    assert np.array_equal(elevation_module.remove_specks(depth), depth, equal_nan=True)


def test_a_hole_beside_a_window_is_filled_with_the_wall() -> None:
    depth = np.zeros((40, 60))
    depth[:, :20] = -0.16
    depth[18:22, 20:30] = np.nan
    upright, new = fill_holes(depth, 0.028, 16, upright=True)
    assert new.sum() == 40
    assert np.abs(upright[18:22, 22:30]).max() < 1e-9
    assert fill_holes(depth, 0.028, 16)[0][20, 22] == -0.16  # what lies behind an edge is hidden, seen from above


def test_an_elevation_of_too_many_pixels_is_refused() -> None:
    with pytest.raises(SplatpipeError, match="too large"):
        wall_plane(walls()["south"], 1e-5)


class Quiet:
    """A reporter that records what it receives."""

    def __init__(self) -> None:
        self.shares: list[float] = []
        self.warnings: list[str] = []

    def progress(self, done: float, total: float, what: str, unit: str = "") -> None:
        self.shares.append(done / total)

    def metric(self, name: str, value: float, step: int | None = None) -> None: ...

    def note(self, message: str) -> None: ...

    def warning(self, message: str, hint: str = "") -> None:
        self.warnings.append(message)


def task(*lines: tuple[float, float, float, float], area: PlanArea | None = None) -> FacadesTask:
    return FacadesTask(run_surface(FRAME, photos(), area), PIXEL_M, lines, threads=1)


@cache
def stated_line() -> tuple[float, float, float, float]:
    """Five metres in the middle of the south wall, in the CRS."""
    ends = crs().crs_from_local(np.array([[-2.5, -3.0, 0.0], [2.5, -3.0, 0.0]]))
    return tuple(ends[:, :2].ravel().tolist())


def test_files_of_a_stated_wall_are_read_by_other_programs(tmp_path: Path) -> None:
    report = Quiet()
    make_facades(task(stated_line()), tmp_path, report)
    data = json.loads((tmp_path / "facades.json").read_text())
    assert data["crs"] == "EPSG:32633"
    (each,) = data["facades"]
    corners = crs().local_from_crs(np.array(each["corners"]))
    assert np.abs(corners[:, :2] - [[-2.5, -3], [2.5, -3], [2.5, -3], [-2.5, -3]]).max() < PIXEL_M
    assert each["length_m"] == pytest.approx(5.0, abs=2e-3)
    assert each["plane"]["azimuth_deg"] == pytest.approx(180.0, abs=1.5)  # the grid's north is not the true one
    assert 0.002 < each["depth_sigma_median_m"] < 0.03
    with rasterio.open(tmp_path / each["depth"]) as raster:
        depth = raster.read(1, masked=True)
        assert raster.nodata == -9999.0
        assert (raster.width, raster.height) == (each["width_px"], each["height_px"])
        assert raster.bounds.left == pytest.approx(0.0, abs=PIXEL_M)
        assert raster.bounds.top == pytest.approx(each["corners"][0][2], abs=0.01)
    assert abs(float(np.ma.median(depth))) < 0.02
    with Image.open(tmp_path / each["picture"]) as picture:
        assert picture.mode == "RGBA"
        assert picture.size == (each["width_px"], each["height_px"])
    names = pyogrio.raw.read(tmp_path / each["dxf"], columns=["Layer"], force_2d=True)[3][0].tolist()
    assert {"EXTENT", "OUTLINE", "TEXT"} <= set(names)
    box = pyogrio.read_bounds(tmp_path / each["dxf"])[1][:, names.index("EXTENT")]
    assert box[0] == pytest.approx(0.0, abs=1e-3)
    assert box[2] == pytest.approx(each["length_m"], abs=1e-3)
    assert box[3] - box[1] == pytest.approx(each["height_m"], abs=1e-3)
    assert each["picture"].encode() in (tmp_path / each["dxf"]).read_bytes()
    svg = ElementTree.parse(tmp_path / each["svg"]).getroot()
    image = svg.find("{http://www.w3.org/2000/svg}image")
    assert image is not None
    assert float(image.get("width", "0")) == pytest.approx(each["width_px"] * PIXEL_M * 1000.0 / 20.0, abs=0.01)
    assert image.get("href", "").startswith("data:image/jpeg;base64,")
    assert svg.get("width", "").endswith("mm")
    assert report.shares[-1] == 1.0
    assert sorted(report.shares) == report.shares


def test_a_killed_call_resumes_with_the_same_bytes(tmp_path: Path) -> None:
    area = PlanArea.seen_from_above([(np.array([[-5.0, -4.0], [5.0, -4.0], [5.0, -2.0], [-5.0, -2.0]]),)])
    for folder in (tmp_path / "whole", tmp_path / "killed"):
        folder.mkdir()
    report = Quiet()
    facts = make_facades(task(area=area), tmp_path / "whole", report)
    assert [each["name"] for each in facts] == ["south"]
    for name in ("south.tif", "south.json"):  # the rest was not there when it was killed
        shutil.copy(tmp_path / "whole" / name, tmp_path / "killed" / name)
    (tmp_path / "killed" / "south.json").unlink()
    make_facades(task(area=area), tmp_path / "killed", report)
    files = sorted(path.name for path in (tmp_path / "whole").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "killed").iterdir())
    assert len(files) == 6
    for name in files:
        assert (tmp_path / "whole" / name).read_bytes() == (tmp_path / "killed" / name).read_bytes()
    before = (tmp_path / "whole" / "south.png").stat().st_mtime_ns
    make_facades(task(area=area), tmp_path / "whole", report)
    assert (tmp_path / "whole" / "south.png").stat().st_mtime_ns == before


def test_a_line_without_a_wall_is_refused(tmp_path: Path) -> None:
    x1, y1, x2, y2 = stated_line()
    for line in ((x1, y1 + 50, x2, y2 + 50), (x2, y2, x1, y1), (x1, y1, x1, y1), (float("nan"), y1, x2, y2)):
        with pytest.raises(SplatpipeError, match="No wall seen by the photos"):
            make_facades(task(line), tmp_path, Quiet())


def test_without_walls_the_list_is_empty_with_a_note(tmp_path: Path) -> None:
    away = PlanArea.seen_from_above([(np.array([[50.0, 50.0], [60.0, 50.0], [60.0, 60.0]]),)])
    report = Quiet()
    assert make_facades(task(area=away), tmp_path, report) == []
    assert report.warnings == ["No walls were found."]
    assert json.loads((tmp_path / "facades.json").read_text())["facades"] == []


def test_openings_are_level_rectangles_and_projections_are_traced() -> None:
    plane = wall_plane(Wall("south", np.array([0.0, 0.0]), np.array([8.0, 0.0]), 0.0, 4.0), 0.02)
    depth = np.random.default_rng(3).normal(0.0, 0.008, (200, 400)).astype(np.float32)
    depth[50:120, 60:110] = -0.16  # a window: 1.2 to 2.2 m, 1.6 to 3 m high
    depth[80, 60:110] = -0.02  # its bar
    depth[60:64, 300:304] = -0.3  # noise
    depth[40:60, 200:300] = 0.4  # a canopy
    depth[:, 380:] = np.nan  # hidden
    depth[0:30, 340:380] = -0.4  # a roof behind, at the edge of what is known
    depth[0:30, 330:340] = np.nan
    depth[30:34, 330:380] = np.nan
    (window,) = recesses(depth, plane)
    assert np.abs(window - [[1.2, 1.6], [2.2, 1.6], [2.2, 3.0], [1.2, 3.0]]).max() < 0.021
    (canopy,) = projections(depth, plane)
    assert np.abs(canopy.min(axis=0) - [4.0, 2.8]).max() < 0.03
    assert np.abs(canopy.max(axis=0) - [6.0, 3.2]).max() < 0.03
    whole = outlines(depth, plane)[0]
    assert np.abs(whole.max(axis=0) - [7.6, 4.0]).max() < 0.05
    assert np.abs(whole.min(axis=0)).max() < 0.05


def test_the_scene_meets_the_assumptions_of_these_tests() -> None:
    assert WALLS == (-4.0, 4.0, -3.0, 3.0)
    assert ROOF[2] == -3.5
