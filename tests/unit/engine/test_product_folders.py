"""Products of other programs among the photos are no part of the input."""

from pathlib import Path

import pytest

from splatpipe.pipeline.engine.digests import walk_files
from splatpipe.pipeline.engine.runs.source import open_source


def put(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"\xff\xd8\xff a picture")


@pytest.mark.parametrize(
    ("product", "mark"),
    [
        ("odm_orthophoto/odm_orthophoto.tif", ""),
        ("opensfm/undistorted/images/a.jpg.tif", ""),
        ("orthophoto_tiles/17/70000/40000.png", ""),
        ("first run/stages/undistort-1/dataset/images/a.jpg", "first run/stages/format.json"),
    ],
)
@pytest.mark.parametrize("where", [".", "flight 1"])
def test_products_are_not_read_with_the_photos(tmp_path: Path, product: str, mark: str, where: str) -> None:
    project = tmp_path / "project"
    put(project / where / "images/a.jpg")
    put(project / where / product)
    if mark:
        (project / where / mark).write_text("{}")
    files = open_source(project, tmp_path / "out").part_files["source.photos"]
    assert set(files) == {(Path(where) / "images/a.jpg").as_posix()}


def test_a_folder_of_products_that_is_named_is_read(tmp_path: Path) -> None:
    put(tmp_path / "opensfm/a.jpg")
    put(tmp_path / "stages_of_a_rocket/format.json/b.jpg")
    assert [path.name for path in walk_files(tmp_path / "opensfm")] == ["a.jpg"]
    assert [path.name for path in walk_files(tmp_path)] == ["b.jpg"]
