"""COPC: the same points as the cloud, by place and by level, read back by laspy."""

from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from hills import hill, hill_grid

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.levels import point_octree
from splatpipe.pipeline.surface.levels.copc import CopcSummary, write_copc
from splatpipe.pipeline.surface.levels.point_octree import CELLS
from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud

COUNT = 30_000
LEAF = 1500


def write_source(path: Path, count: int = COUNT, spread: float = 15.0) -> Path:
    """Write a cloud of a hill in parts from west to east, with classes as the ground's filter sets them."""
    random = np.random.default_rng(3)
    chunks = []
    for west in (-1.0, 0.0):
        plan = spread * random.uniform([west, -1.0], [west + 1.0, 1.0], (count // 2, 2))
        positions = np.column_stack([plan, hill(*plan.T) - 100.0 + random.normal(0.0, 0.02, len(plan))])
        normals = np.tile(np.array([[0.0, 0.6, 0.8]], np.float32), (len(plan), 1))
        colours = random.integers(0, 256, (len(plan), 3), np.uint8)
        chunks.append(CloudChunk(positions, colours, normals, random.integers(0, 9, len(plan), np.uint8)))
    write_cloud(path, chunks, CloudFrame.of_grid(hill_grid()))
    cloud = laspy.read(path)
    cloud.classification = random.choice([1, 2, 5, 6, 7, 18], len(cloud.points)).astype(np.uint8)
    cloud.write(str(path))
    return path


def write(source: Path, name: str = "cloud.copc.laz") -> CopcSummary:
    return write_copc(source, source.parent / name, source.parent / "work", lambda done, total: None)


@pytest.fixture(autouse=True)
def small_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(point_octree, "MAX_LEAF_POINTS", LEAF)


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return write_source(tmp_path / "cloud.laz")


def in_order(records: np.ndarray) -> np.ndarray:
    return np.sort(records, order=records.dtype.names)


def test_all_fields_of_all_points_are_carried_over(source: Path) -> None:
    summary = write(source)
    before, after = laspy.read(source), laspy.read(source.with_name("cloud.copc.laz"))
    np.testing.assert_array_equal(in_order(before.points.array), in_order(after.points.array))
    assert summary.points == COUNT and summary.levels >= 3
    assert np.unique(after.classification).tolist() == [1, 2, 5, 6, 7, 18]
    assert sorted(path.name for path in source.parent.iterdir()) == ["cloud.copc.laz", "cloud.laz"]


def test_crs_with_its_heights_and_extra_bytes_are_carried_over(source: Path) -> None:
    write(source)
    with laspy.open(source) as before, laspy.open(source.with_name("cloud.copc.laz")) as after:
        kept = [vlr for vlr in after.header.vlrs if vlr.user_id.startswith("LASF")]
        given = [vlr for vlr in before.header.vlrs if vlr.user_id.startswith("LASF")]
        assert [(vlr.record_id, vlr.record_data_bytes()) for vlr in kept] == [
            (vlr.record_id, vlr.record_data_bytes()) for vlr in given
        ]
        crs = pyproj.CRS.from_wkt(next(vlr.string for vlr in kept if vlr.record_id == 2112))
        assert [part.to_authority()[1] for part in crs.sub_crs_list] == ["25832", "7837"]
        for name in ("mins", "maxs", "scales", "offsets", "number_of_points_by_return"):
            np.testing.assert_array_equal(getattr(before.header, name), getattr(after.header, name))


def test_a_window_has_exactly_the_points_in_it(source: Path) -> None:
    write(source)
    every = laspy.read(source)
    with laspy.CopcReader.open(source.with_name("cloud.copc.laz")) as reader:
        middle = np.round((every.header.mins + every.header.maxs) / 2.0, 2) + 0.0005  # between steps
        low, high = middle - np.array([4.0, 3.0, 50.0]), middle + np.array([2.0, 5.0, 50.0])
        found = reader.query(bounds=laspy.copc.Bounds(mins=low, maxs=high))
        inside = ((every.xyz >= low) & (every.xyz <= high)).all(axis=1)
        np.testing.assert_array_equal(in_order(found.array), in_order(every.points.array[inside]))


def test_a_level_shows_one_point_in_each_cell_that_has_any(source: Path) -> None:
    write(source)
    every = laspy.read(source)
    with laspy.CopcReader.open(source.with_name("cloud.copc.laz")) as reader:
        info = reader.copc_info
        corner = info.center - info.halfsize
        assert info.spacing == pytest.approx(2.0 * info.halfsize / CELLS)
        for level in (0, 1):
            shown = reader.query(level=range(level + 1))
            side = info.spacing / 2**level
            places = np.stack([shown.x, shown.y, shown.z], axis=1)
            cells, counts = np.unique(np.floor((places - corner) / side + 1e-6), axis=0, return_counts=True)
            wanted = np.unique(np.floor((every.xyz - corner) / side + 1e-6), axis=0)
            assert (counts == 1).all() and np.array_equal(cells, wanted)
            off = np.abs((places - corner) / side - np.floor((places - corner) / side + 1e-6) - 0.5)
            assert off[:, :2].mean() < 0.25  # it is one near the cell's middle, if there is any


def test_the_bytes_do_not_depend_on_what_fits_into_memory(source: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(source)
    monkeypatch.setattr(point_octree, "MAX_PILE_POINTS", 2000)
    write(source, "other.copc.laz")
    assert source.with_name("cloud.copc.laz").read_bytes() == source.with_name("other.copc.laz").read_bytes()


@pytest.mark.parametrize("count, spread", [(0, 1.0), (2, 1.0), (20_000, 0.0), (20_000, 1e-3)])
def test_odd_clouds_are_written(tmp_path: Path, count: int, spread: float) -> None:
    source = write_source(tmp_path / "cloud.laz", count, spread)
    write(source)
    before, after = laspy.read(source), laspy.read(tmp_path / "cloud.copc.laz")
    np.testing.assert_array_equal(in_order(before.points.array), in_order(after.points.array))


def test_other_files_are_refused_and_the_old_file_is_kept(source: Path) -> None:
    target = source.with_name("cloud.copc.laz")
    target.write_text("old")
    cut = source.read_bytes()
    for broken in (b"no cloud", cut[: len(cut) // 2]):
        source.write_bytes(broken)
        with pytest.raises(SplatpipeError, match="cannot be read"):
            write(source)
    laspy.LasData(laspy.LasHeader(version="1.2", point_format=3)).write(str(source))
    with pytest.raises(SplatpipeError, match="format 3"):
        write(source)
    assert target.read_text() == "old" and len(list(source.parent.iterdir())) == 2
