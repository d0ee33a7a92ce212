"""Surface products as files, of a scene with known heights and colours, in a local metric frame."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
import pytest
import rasterio
from house_photos import run_surface
from house_site import cameras, depths_of, edge_distance, photo_of, true_height, true_orthophoto

from splatpipe.pipeline.engine.errors import SplatpipeError, StageError
from splatpipe.pipeline.engine.stage import Inputs, Machine
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.depths import site_extent as site_survey
from splatpipe.pipeline.surface.depths.photo_samples import PhotoSource
from splatpipe.pipeline.surface.depths.site_extent import SiteExtent, load_site, measure_extent, save_site
from splatpipe.pipeline.surface.depths.sources import DepthSource, LruCache, MetricMap
from splatpipe.pipeline.surface.heights.dsm import DsmTask, make_dsm
from splatpipe.pipeline.surface.heights.heights import HeightInput, tile_heights
from splatpipe.pipeline.surface.options import DsmConfig, DtmConfig
from splatpipe.pipeline.surface.ortho import ortho as ortho_file
from splatpipe.pipeline.surface.ortho.ortho import OrthoTask, known_cells, make_ortho
from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.sheets.raster_plane import divide_into_sheets
from splatpipe.pipeline.survey.crs.frames import Frame, Origin, save_frame
from splatpipe.stages import dsm as dsm_stage
from splatpipe.stages import dtm as dtm_stage

FRAME = Frame("arbitrary", Similarity.identity(), metres=True)
IN_UTM = Frame("enu", Similarity.identity(), Origin(50.1, 14.2, 300.0), "ellipsoidal", crs="EPSG:32633")
CELL_M = 0.2
HOUSE = PlanArea.seen_from_above([(np.array([[-5.45, -4.45], [5.45, -4.45], [5.45, 4.45], [-5.45, 4.45]]),)])


@dataclass
class InterruptingReporter:
    """A reporter that may interrupt.

    Attributes:
        stop_after: Calls of ``progress`` after which it does.
    """

    stop_after: int = 1 << 30
    calls: int = 0

    def progress(self, *_arguments: object) -> None:
        self.calls += 1
        if self.calls > self.stop_after:
            raise KeyboardInterrupt

    def metric(self, *_arguments: object) -> None: ...
    def note(self, *_arguments: object) -> None: ...
    def warning(self, *_arguments: object) -> None: ...


@cache
def sources() -> tuple[DepthSource, ...]:
    found = [depths_of(camera) for camera in cameras()]
    return tuple(DepthSource(each.camera, lambda each=each: each) for each in found)


def photos() -> list[PhotoSource]:
    return [PhotoSource(source.camera, lambda source=source: photo_of(source.camera), source) for source in sources()]


@cache
def site() -> SiteExtent:
    found = measure_extent(sources(), 1.0, None, 1)
    assert found is not None
    return found


def dsm(folder: Path, area: PlanArea | None = HOUSE, report: Any = None) -> dict[str, Any]:
    task = DsmTask(run_surface(FRAME, photos(), area), site(), CELL_M, 1)
    return make_dsm(task, folder / "work", folder, report or InterruptingReporter())


def ortho(folder: Path, report: Any = None) -> dict[str, Any]:
    task = OrthoTask(run_surface(FRAME, photos(), HOUSE), site(), folder / "dsm.tif", CELL_M, CELL_M / 2, 1)
    return make_ortho(task, folder / "ortho_work", folder, report or InterruptingReporter())


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("products")
    dsm(folder)
    ortho(folder)
    dtm(folder / "ground", folder / "dsm.tif", DtmConfig())
    return folder


def dtm(folder: Path, surface: Path, config: DtmConfig) -> dict[str, Any]:
    """Run the stage `dtm` on a surface model."""
    (folder / "dsm").mkdir(parents=True)
    for name in ("dsm.tif", "dsm_confidence.tif"):
        (folder / "dsm" / name).write_bytes(surface.with_name(name).read_bytes())
    save_site(folder / "site.json", site(), CELL_M)
    save_frame(FRAME, folder / "frame.json")
    parts = {"dsm.files": "dsm", "dsm.site": "site.json", "georef.frame": "frame.json"}
    inputs = Inputs({part: folder / name for part, name in parts.items()}, folder, {}, Machine("cpu", 1))
    return dict(dtm_stage.run(config, inputs, folder, InterruptingReporter()))


def centres(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Bands, and east and north of their cells."""
    with rasterio.open(path) as raster:
        columns, rows = np.meshgrid(np.arange(raster.width) + 0.5, np.arange(raster.height) + 0.5)
        t = raster.transform
        return raster.read(), t.c + t.a * columns, t.f + t.e * rows


def places(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    return np.stack([east.ravel(), north.ravel(), 0 * east.ravel()], axis=1)


def test_a_site_has_the_extent_and_resolution_of_its_photos() -> None:
    found = site()
    assert 0.09 < found.gsd_m < 0.13  # 20 m away, 200 pixels of focal length; those around are nearer to the house
    assert found.low_m < -2.0
    assert 5.0 < found.high_m < 10.0
    west, south, east, north = found.reach
    assert west < -11.0 < 11.0 < east
    assert south < -9.0 < 9.0 < north
    assert found.sees(np.array([[0.0, 0.0], [1.0, 1.0]]))
    assert not found.sees(np.array([[500.0, 0.0], [501.0, 1.0]]))


def test_a_site_ends_at_its_boundary() -> None:
    found = measure_extent(sources(), 1.0, HOUSE, 1)
    assert found is not None
    assert np.abs(found.reach).max() <= 5.5


def test_level_photos_show_a_facade_up_to_its_eaves_and_nothing_far_behind_it() -> None:
    """Five photos from eye height, 12 m before a wall of 20 by 10 m; what is beside it lies 60 m behind."""
    east, up = np.meshgrid((np.arange(100) + 0.5 - 50.0) / 50.0, (50.0 - np.arange(100) - 0.5) / 50.0)

    def facing_north(x: float) -> DepthSource:
        pose = np.array([[1.0, 0.0, 0.0, -x], [0.0, 0.0, -1.0, 1.7], [0.0, 1.0, 0.0, 12.0], [0.0, 0.0, 0.0, 1.0]])
        camera = Camera(f"{x}", 100, 100, 50.0, 50.0, 50.0, 50.0, pose)
        depth = np.where((np.abs(x + 12.0 * east) < 10.0) & (1.7 + 12.0 * up < 10.0), 12.0, 72.0).astype(np.float32)
        return DepthSource(camera, lambda: MetricMap(camera, depth, np.full(depth.shape, 5, np.uint8)))

    found = measure_extent([facing_north(x) for x in (-6.0, -3.0, 0.0, 3.0, 6.0)], 1.0, None, 1)
    assert found is not None
    assert found.sees(np.array([[-9.5, -0.1], [-8.5, 0.1]]))
    assert found.reach[3] < 1.0
    assert 9.0 < found.high_m < 14.0


def test_depths_too_far_apart_for_a_site_are_refused() -> None:
    found = sources()[0].load()
    pose = found.camera.cam_from_world.copy()
    pose[:3, 3] -= pose[:3, :3] @ [100_000.0, 100_000.0, 0.0]
    away = MetricMap(replace(found.camera, cam_from_world=pose), found.depth, found.confidence)
    with pytest.raises(SplatpipeError, match="too far"):
        measure_extent([sources()[0], DepthSource(away.camera, lambda: away)], 1.0, None, 1)


def test_of_a_site_in_many_small_parts_the_largest_is_kept() -> None:
    cells = np.array([[3 * (number % 20), 3 * (number // 20)] for number in range(100)] + [[1, 0]], np.int64)
    seen = np.repeat(cells, 3, axis=0)
    covered = site_survey._covered(seen, np.tile(np.arange(3), len(cells)))
    assert np.argwhere(covered).tolist() == [[0, 0], [0, 1]]


def test_a_stage_without_a_site_says_so_and_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dsm_stage, "open_run_surface", lambda *_: run_surface(FRAME, photos(), HOUSE))
    monkeypatch.setattr(dsm_stage, "measure_extent", lambda *_: None)
    reporter = InterruptingReporter()
    assert dsm_stage.run(DsmConfig(), Inputs({}, tmp_path, {}, Machine("cpu", 1)), tmp_path, reporter) == {"cells": 0}
    assert reporter.calls == 1
    assert load_site(tmp_path / "site.json") is None


def test_existing_parts_are_reported_as_done(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made / "work", tmp_path / "work")
    reporter = InterruptingReporter()
    dsm(tmp_path, report=reporter)
    assert reporter.calls == 1


def test_a_site_is_read_as_it_was_written(tmp_path: Path) -> None:
    save_site(tmp_path / "site.json", site(), 0.25)
    loaded = load_site(tmp_path / "site.json")
    assert loaded is not None
    assert loaded[1] == 0.25
    assert np.array_equal(loaded[0].covered, site().covered)
    for field in ("gsd_m", "low_m", "high_m", "reach", "corner", "cell_m"):
        assert getattr(loaded[0], field) == getattr(site(), field)
    save_site(tmp_path / "none.json", None)
    assert load_site(tmp_path / "none.json") is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"rows": 9e9}', '"site"', "\x00"])
def test_a_broken_site_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "site.json").write_text(text)
    with pytest.raises(StageError, match=r"site\.json"):
        load_site(tmp_path / "site.json")


def test_heights_are_in_place_and_end_at_the_boundary(made: Path) -> None:
    (height,), east, north = centres(made / "dsm.tif")
    known = height != -9999.0
    inside = HOUSE.contains(places(east, north)).reshape(east.shape)
    assert known[inside].mean() > 0.99
    assert not known[~inside].any()
    clear = known & (edge_distance(east, north) > 2 * CELL_M)
    assert np.abs(height - true_height(east, north))[clear].max() < 0.02


def test_confidence_has_photos_and_millimetres(made: Path) -> None:
    (height,), _, _ = centres(made / "dsm.tif")
    (photos, sigma), _, _ = centres(made / "dsm_confidence.tif")
    known = height != -9999.0
    assert (photos[known] >= 1).all()
    assert np.median(photos[known]) >= 3
    assert (photos[~known] == 0).all()
    assert 5 < np.median(sigma[known]) < 100


def test_without_georeference_there_are_cad_contours_and_no_geojson(made: Path) -> None:
    assert (made / "ground/files/contours.dxf").stat().st_size > 1000
    assert not (made / "ground/files/contours.geojson").exists()


def test_the_terrain_lies_under_the_house(made: Path) -> None:
    (height,), east, north = centres(made / "ground/files/dtm.tif")
    known = height != -9999.0
    assert known[HOUSE.contains(places(east, north)).reshape(east.shape)].all()
    assert np.abs(height[known]).max() < 0.1
    (cover,), _, _ = centres(made / "ground/cover/cover.tif")
    roof = (np.abs(east) < 4.2) & (np.abs(north) < 3.2)
    assert (cover[roof] == 6).mean() > 0.9


def test_contours_are_of_the_ground_unless_the_surface_is_asked_for(made: Path, tmp_path: Path) -> None:
    facts = dtm(tmp_path / "surface", made / "dsm.tif", DtmConfig(contours="dsm"))
    counts = [
        len(ezdxf.readfile(folder / "files/contours.dxf").modelspace())
        for folder in (made / "ground", tmp_path / "surface")
    ]
    assert facts["contours"] == "surface" and counts[0] < counts[1]  # the roof has some
    facts = dtm(tmp_path / "none", made / "dsm.tif", DtmConfig(enabled=False))
    assert facts == {"cells": 0} and not list((tmp_path / "none/files").iterdir())


def test_the_orthophoto_is_aligned_with_the_surface_model(made: Path) -> None:
    bands, east, north = centres(made / "ortho.tif")
    assert (bands[3] > 0).sum() * (CELL_M / 2) ** 2 == pytest.approx(95.04, rel=0.01)
    off = ((np.arange(4) + 0.5) / 4 - 0.5) * CELL_M / 2
    true = np.mean([true_orthophoto(east + e, north + n) for e in off for n in off], axis=0)
    counts = (bands[3] > 0) & (edge_distance(east, north) > CELL_M / 2)  # the eaves halve cells of the surface model
    wrong = np.square(np.moveaxis(bands[:3], 0, -1) - true)[counts]
    assert 10 * np.log10(255**2 / wrong.mean()) > 28.0


def test_the_orthophoto_covers_all_that_the_surface_model_does(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ortho_file, "TILE", 32)
    covered = np.zeros_like(site().covered)
    covered[len(covered) // 2, 0] = True  # by samples, enough photos see only a corner
    (tmp_path / "dsm.tif").write_bytes((made / "dsm.tif").read_bytes())
    surface = run_surface(FRAME, photos(), HOUSE)
    make_ortho(
        OrthoTask(surface, replace(site(), covered=covered), tmp_path / "dsm.tif", CELL_M, CELL_M / 2, 1),
        tmp_path / "work",
        tmp_path,
        InterruptingReporter(),
    )
    whole, part = (centres(folder / "ortho.tif")[0][3] > 0 for folder in (made, tmp_path))
    assert np.array_equal(whole, part)


def test_known_cells_are_counted_by_blocks_up_to_the_rasters_edge(made: Path) -> None:
    (height,), _, _ = centres(made / "dsm.tif")
    known, (rows, columns) = known_cells(made / "dsm.tif"), np.nonzero(height != -9999.0)
    assert known.any_in(Tile(int(rows[0]), int(columns[0]), 1, 1))
    assert known.any_in(Tile(-1000, -1000, 3000, 3000))
    assert not known.any_in(Tile(-10, 0, 10, 10))
    assert not known.any_in(Tile(height.shape[0] + 64, 0, 10, 10))


@pytest.mark.parametrize("product", [dsm, ortho])
def test_an_interrupted_product_resumes_with_the_same_bytes(made: Path, tmp_path: Path, product: Callable) -> None:
    for name in ("dsm.tif",) if product is ortho else ():
        (tmp_path / name).write_bytes((made / name).read_bytes())
    with pytest.raises(KeyboardInterrupt):
        product(tmp_path, report=InterruptingReporter(stop_after=0))
    assert not (tmp_path / ("dsm.tif" if product is dsm else "ortho.tif")).exists()
    product(tmp_path)
    again = InterruptingReporter()
    product(tmp_path, report=again)
    assert again.calls == 1  # all sheets were there
    for path in tmp_path.glob("*.tif"):
        assert path.read_bytes() == (made / path.name).read_bytes()


def test_sheets_of_a_grid_agree_where_they_meet() -> None:
    grid = make_grid(IN_UTM, np.array([[-6.0, -4.0, -1.0], [6.0, 4.0, 8.0]]), CELL_M)
    low, high = 299.0, 308.0
    whole = np.full((grid.height, grid.width), np.nan)
    for grid_sheet in divide_into_sheets(grid, low, high, side=25):
        plane, part = grid_sheet.plane, grid_sheet.part
        moved = HeightInput(
            [plane.transform_depths(source) for source in sources()], plane.lattice, plane.relief, LruCache(1 << 30)
        )
        found = tile_heights(moved, Tile(0, 0, part.height, part.width))
        heights = grid_sheet.heights(found.tile, found.height)
        whole[part.row : part.row + part.height, part.column : part.column + part.width] = heights
        back = grid_sheet.heights_over(grid, part, heights)
        assert np.allclose(back, found.height, atol=1e-4, equal_nan=True)
        lattice = grid_sheet.lattice_of(grid, part)
        assert (lattice.width, lattice.height) == (plane.lattice.width, plane.lattice.height)
        assert np.allclose([lattice.east_m, lattice.north_m], [plane.lattice.east_m, plane.lattice.north_m], atol=1e-6)
    local = grid.centres_in_local(Tile(0, 0, grid.height, grid.width), np.where(np.isnan(whole), low, whole))
    east, north, up = np.moveaxis(local, -1, 0)
    clear = np.isfinite(whole) & (edge_distance(east, north) > 2 * CELL_M)
    assert clear.mean() > 0.7
    assert np.abs(up - true_height(east, north))[clear].max() < 0.02
