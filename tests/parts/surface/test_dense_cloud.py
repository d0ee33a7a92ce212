"""The dense cloud of a scene with known surfaces: no duplicates, no outliers, always the same bits."""

from functools import cache
from pathlib import Path

import laspy
import numpy as np
import pytest
from house_photos import GSD_M, Recorder, house_site, photos, run_surface, surface_distances

from splatpipe.pipeline.geometry.plan_area import PlanArea
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.surface.depths.photo_gains import PhotoGains
from splatpipe.pipeline.surface.depths.photo_set import PhotoSet, SurfacePieces
from splatpipe.pipeline.surface.depths.sources import DepthSource, HeightRange, LruCache
from splatpipe.pipeline.surface.rasters.lattice import Lattice
from splatpipe.pipeline.surface.rasters.tiles import Tile
from splatpipe.pipeline.surface.shapes import dense_cloud
from splatpipe.pipeline.surface.shapes.dense_cloud import CloudTask, make_cloud, tile_cloud
from splatpipe.pipeline.surface.shapes.fusion import FusedPoints
from splatpipe.pipeline.surface.shapes.point_colours import photo_set, point_colours
from splatpipe.pipeline.survey.crs.frames import Frame

FRAME = Frame("arbitrary", Similarity.identity(), metres=True)
LATTICE = Lattice(-5.0, 5.0, GSD_M, 100, 100)
RELIEF = HeightRange(-1.0, 7.0)
WHOLE = Tile(0, 0, 100, 100)


@cache
def noisy_photos() -> PhotoSet:
    return photo_set(photos(noise_px=0.1, wild=0.03), GSD_M, 1)


@cache
def noisy_cloud() -> FusedPoints:
    return tile_cloud(noisy_photos(), LATTICE, RELIEF, WHOLE)


def on_roof(points: FusedPoints) -> np.ndarray:
    east, north, up = points.pieces.xyz
    return (np.abs(east) < 3.8) & (np.abs(north) < 3.2) & (up > 3.1)


def test_points_lie_on_the_surfaces_despite_noisy_depths() -> None:
    off = surface_distances(noisy_cloud().pieces.xyz.T)
    assert np.quantile(off, 0.5) < 0.25 * GSD_M and np.quantile(off, 0.95) < GSD_M
    assert (off < 2.0 * GSD_M).mean() > 0.995


def test_every_place_is_covered_and_few_twice() -> None:
    east, north, _ = noisy_cloud().pieces.xyz[:, on_roof(noisy_cloud())]
    cells = np.unique(np.floor(np.stack([east, north]) / GSD_M), axis=1).shape[1]
    assert cells > 0.97 * 76 * 64
    assert len(east) < 1.5 * cells  # a slope of 30° passes from cube to cube within a cell
    _, _, up = noisy_cloud().pieces.xyz
    walls = (up > 0.3) & (up < 2.5)
    assert walls.sum() > 0.7 * 28.0 * 2.2 / GSD_M**2


def test_normals_point_out_of_the_surface() -> None:
    points = noisy_cloud()
    north, roof = points.pieces.xyz[1], on_roof(points)
    true = np.stack([np.zeros_like(north), np.sign(north) * 2.0 / 3.5, np.ones_like(north)])
    cosine = (points.pieces.normal * true).sum(axis=0) / np.hypot(1.0, 2.0 / 3.5)
    assert np.degrees(np.arccos(np.clip(cosine[roof & (np.abs(north) > 0.3)], -1.0, 1.0))).mean() < 4.0
    length = np.linalg.norm(points.pieces.normal, axis=0)
    assert np.abs(length - 1.0).max() < 1e-6


def test_confidence_counts_the_photos_that_see_a_place() -> None:
    assert noisy_cloud().confidence.min() >= 2
    assert 6 <= np.median(noisy_cloud().confidence[on_roof(noisy_cloud())]) <= len(noisy_photos().sources)


def test_walls_are_red_and_roofs_are_not() -> None:
    points = noisy_cloud()
    colours, known = point_colours(noisy_photos(), points.pieces, GSD_M, 1)
    _, _, up = points.pieces.xyz
    walls = (up > 0.3) & (up < 2.5) & (np.abs(points.pieces.normal[2]) < 0.3)
    assert known.mean() > 0.999
    assert (colours[walls, 0] > 150).mean() > 0.97 and (colours[walls, 1] < 90).mean() > 0.97
    assert (colours[on_roof(points), 0] < 150).mean() > 0.999


def test_tiles_and_threads_change_no_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    few = photos()[::3]
    monkeypatch.setattr(dense_cloud, "TILE", 64)
    monkeypatch.setattr(dense_cloud, "SIDE", 64)
    made = []
    for name, threads in (("one", 1), ("three", 3)):
        (tmp_path / name).mkdir()
        task = CloudTask(run_surface(FRAME, few), house_site(), GSD_M, threads)
        make_cloud(task, tmp_path / name / "work", tmp_path / name, Recorder())
        made.append((tmp_path / name / "cloud.laz").read_bytes())
    assert made[0] == made[1]
    left = sorted((tmp_path / "one/work").iterdir())
    assert len(left) == 4
    kept = left[1].stat().st_mtime_ns
    left[2].unlink()  # as after a kill
    (tmp_path / "one/cloud.laz").unlink()
    make_cloud(task, tmp_path / "one/work", tmp_path / "one", Recorder())
    assert (tmp_path / "one/cloud.laz").read_bytes() == made[0] and left[1].stat().st_mtime_ns == kept


def test_nothing_lies_outside_the_boundary(tmp_path: Path) -> None:
    ring = np.array([[-2.0, -2.0], [2.0, -2.0], [0.0, 2.0]])
    area = PlanArea.seen_from_above([(ring,)])
    task = CloudTask(run_surface(FRAME, photos()[::3], area), house_site(), 2.0 * GSD_M, 1)
    summary = make_cloud(task, tmp_path / "work", tmp_path, Recorder())
    cloud = laspy.read(tmp_path / "cloud.laz")
    assert summary["points"] == len(cloud.xyz) > 100
    assert area.contains(np.asarray(cloud.xyz)).mean() > 0.99  # millimetres of rounding


def test_photos_without_depths_and_places_without_photos_give_no_points() -> None:
    blind = [type(each)(each.camera, each.load, None) for each in photos()[:3]]
    assert len(tile_cloud(photo_set(blind, GSD_M, 1), LATTICE, RELIEF, WHOLE)) == 0
    assert len(tile_cloud(noisy_photos(), Lattice(500.0, 500.0, 0.1, 9, 9), RELIEF, Tile(0, 0, 9, 9))) == 0
    nowhere = SurfacePieces(np.full((3, 2), 500.0), np.ones((3, 2)))
    assert not point_colours(noisy_photos(), nowhere, GSD_M, 1)[1].any()


def test_depths_that_do_not_fit_their_camera_are_refused() -> None:
    source = photos()[0]
    assert source.depths is not None
    other = DepthSource(
        source.camera,
        lambda: type(source.depths.load())(source.camera, np.ones((3, 3), np.float32), np.ones((3, 3), np.uint8)),
    )
    broken = PhotoSet([type(source)(source.camera, source.load, other)], PhotoGains.plain(1), LruCache(1 << 20))
    with pytest.raises(ValueError, match="depths of"):
        broken.depth_map(0)
