"""Point clouds: LAZ by the specification, read back by laspy, with PROJ's coordinates."""

import struct
from collections.abc import Iterator
from dataclasses import replace
from datetime import date
from pathlib import Path

import laspy
import numpy as np
import pyproj
import pytest
from hills import IDENTITY, box, hill_grid, placed

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.surface.rasters.grid import make_grid
from splatpipe.pipeline.surface.shapes.point_cloud import CloudChunk, CloudFrame, write_cloud
from splatpipe.pipeline.survey.crs.frames import Frame, Origin

HALF_STEP_M = 0.0005 + 2e-4  # half a step of a millimetre, and the grid's transformation to the CRS
NORMAL_DEG = 0.5  # rounding of a normal to three signed bytes


def some_points(count: int, seed: int = 0) -> CloudChunk:
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return CloudChunk(
        rng.uniform([-20.0, -15.0, -10.0], [20.0, 15.0, 30.0], (count, 3)),
        rng.integers(0, 256, (count, 3), np.uint8),
        normals.astype(np.float32),
        rng.integers(0, 20, count, np.uint8),
    )


def test_points_are_read_back_where_proj_has_them(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    grid = hill_grid()
    chunks = [some_points(700, 1), some_points(0), some_points(300, 2)]
    assert write_cloud(path, iter(chunks), CloudFrame.of_grid(grid), date(2024, 5, 17)) == 1000
    cloud = laspy.read(path)
    positions = np.concatenate([chunk.positions for chunk in chunks])
    assert np.abs(cloud.xyz - grid.crs.crs_from_local(positions)).max() < HALF_STEP_M
    colours = np.concatenate([chunk.colours for chunk in chunks])
    np.testing.assert_array_equal(np.stack([cloud.red, cloud.green, cloud.blue], axis=1), colours.astype(int) * 257)
    confidence = np.concatenate([chunk.confidence for chunk in chunks])
    np.testing.assert_array_equal(np.asarray(cloud["Confidence"]), confidence)
    header = cloud.header
    assert str(header.version) == "1.4" and header.point_format.id == 7 and header.are_points_compressed
    assert (header.scales == 0.001).all() and (header.offsets == np.round(header.offsets)).all()
    assert header.creation_date == date(2024, 5, 17)
    assert (header.mins <= cloud.xyz.min(axis=0)).all() and (header.maxs >= cloud.xyz.max(axis=0)).all()
    assert (np.asarray(cloud.return_number) == 1).all() and list(tmp_path.iterdir()) == [path]


def test_classes_are_those_of_las_and_none_is_class_0(tmp_path: Path) -> None:
    classes = np.arange(600, dtype=np.uint8) % 19
    chunks = [replace(some_points(600, 1), classes=classes), some_points(50, 2)]
    write_cloud(tmp_path / "cloud.laz", chunks, CloudFrame.of_grid(hill_grid()))
    read = np.asarray(laspy.read(tmp_path / "cloud.laz").classification)
    assert (read[:600] == classes).all() and (read[600:] == 0).all()


def test_normals_turn_with_the_grid(tmp_path: Path) -> None:
    grid = make_grid(placed("EPSG:25832", "ellipsoidal", Origin(52.2, 11.9, 110.0)), box(20.0, 15.0), 0.1)
    chunk = some_points(500)
    write_cloud(tmp_path / "cloud.laz", [chunk], CloudFrame.of_grid(grid))
    cloud = laspy.read(tmp_path / "cloud.laz")
    read = np.stack([np.asarray(cloud[f"Normal{axis}"]) for axis in "XYZ"], axis=1)
    ahead = grid.crs.crs_from_local(chunk.positions + chunk.normals) - grid.crs.crs_from_local(chunk.positions)
    cosine = (read * ahead).sum(axis=1) / np.linalg.norm(read, axis=1) / np.linalg.norm(ahead, axis=1)
    assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).max() < NORMAL_DEG
    unturned = (read * chunk.normals).sum(axis=1) / np.linalg.norm(read, axis=1)
    assert np.degrees(np.arccos(np.minimum(unturned, 1.0))).max() > 2.0  # the convergence there: it was turned


@pytest.mark.parametrize(
    "frame, codes, about",
    [
        (placed(), ["25832", "7837"], "EPSG:7837 (DHHN2016 height), metre"),
        (placed("EPSG:25832", "ellipsoidal"), ["25832"], "above the WGS 84 ellipsoid, metre"),
        (placed("", "unknown"), ["32632"], "datum unknown, metre"),
        (Frame("arbitrary", IDENTITY, metres=True), [None], "above the local zero, metre"),
    ],
)
def test_crs_is_wkt_that_proj_reads(tmp_path: Path, frame: Frame, codes: list[str | None], about: str) -> None:
    path = tmp_path / "cloud.laz"
    write_cloud(path, [some_points(10)], CloudFrame.of_grid(make_grid(frame, box(20.0, 15.0), 0.1)))
    with laspy.open(path) as file:
        header = file.header
    assert header.global_encoding.wkt
    texts = {vlr.record_id: vlr for vlr in header.vlrs if vlr.user_id in ("LASF_Projection", "LASF_Spec")}
    crs = pyproj.CRS.from_wkt(texts[2112].string)
    assert texts[2112].string.startswith(("COMPD_CS", "PROJCS", "LOCAL_CS"))  # WKT of 2001, which LAS requires
    parts = crs.sub_crs_list if crs.is_compound else [crs]
    assert [(part.to_authority() or (None, None))[1] for part in parts] == codes
    assert texts[3].record_data == f"Heights: {about}".encode() + b"\0"


def test_cloud_without_points_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "cloud.laz"
    assert write_cloud(path, [], CloudFrame.of_grid(hill_grid())) == 0
    cloud = laspy.read(path)
    assert len(cloud.points) == 0 and (cloud.header.mins == 0.0).all()


def test_same_points_give_the_same_bytes_however_they_come(tmp_path: Path) -> None:
    whole = some_points(1000)

    def split() -> Iterator[CloudChunk]:
        for rows in (slice(0, 1), slice(1, 640), slice(640, None)):
            yield CloudChunk(whole.positions[rows], whole.colours[rows], whole.normals[rows], whole.confidence[rows])

    write_cloud(tmp_path / "one.laz", [whole], CloudFrame.of_grid(hill_grid()))
    write_cloud(tmp_path / "two.laz", split(), CloudFrame.of_grid(hill_grid()))
    content = (tmp_path / "one.laz").read_bytes()
    assert content == (tmp_path / "two.laz").read_bytes()
    day, year = struct.unpack("<HH", content[90:94])
    assert (day, year) == (1, 2000)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e10])
def test_nan_point_is_refused_and_the_old_file_is_kept(tmp_path: Path, bad: float) -> None:
    path = tmp_path / "cloud.laz"
    path.write_text("old")
    chunk = some_points(5)
    chunk.positions[3, 1] = bad
    with pytest.raises(SplatpipeError, match="not finite"), np.errstate(invalid="ignore"):
        write_cloud(path, [chunk], CloudFrame.of_grid(hill_grid()))
    assert path.read_text() == "old" and list(tmp_path.iterdir()) == [path]
