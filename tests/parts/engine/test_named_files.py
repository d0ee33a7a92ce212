"""Surveyors' files as external inputs: found with the photos or named; only stages that read them depend on them."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.digests import HashTable
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.events import EventReporter
from splatpipe.pipeline.engine.runs.line import Line
from splatpipe.pipeline.engine.runs.source import MAX_NAMED_BYTES, RunSource, open_source, with_absolute_files
from splatpipe.pipeline.engine.runs.store import Part
from splatpipe.stages.line import GEOREF, INGEST, LINE
from splatpipe.stages.options import LineConfig

PARTS = {"source.photos", "source.geo", "source.lens", "source.control", "source.scale_bars", "source.boundary"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    photos = tmp_path / "capture" / "photos"
    photos.mkdir(parents=True)
    (photos / "a.jpg").write_bytes(b"\xff\xd8\xff a photo")
    return photos


def opened(folder: Path, **options: dict[str, str]) -> RunSource:
    return open_source(folder, folder.parent.parent / "out", LINE, resolve(LineConfig, [options]))


def digests(source: RunSource, folder: Path) -> dict[str, str]:
    table = HashTable(folder.parent.parent / "table.json", remember=False)
    return source.digests(table, 1, EventReporter("source", lambda _: None))


def test_without_files_the_parts_exist_and_name_no_file(folder: Path) -> None:
    source = opened(folder)
    assert set(source.part_files) == PARTS
    assert not source.part_path("source.geo").is_file()
    assert not source.part_path("source.control").is_file()


@pytest.mark.parametrize("where", ["photos", "."])
@pytest.mark.parametrize("name", ["gcp_list.txt", "GCP_List.TXT", "control.csv"])
def test_control_is_found_by_its_name_with_the_photos_or_beside_them(folder: Path, where: str, name: str) -> None:
    path = folder.parent / where / name
    path.write_text("EPSG:32633\n")
    assert opened(folder).part_path("source.control").resolve() == path.resolve()


def test_the_photo_folder_takes_precedence_over_its_parent(folder: Path) -> None:
    for root in (folder, folder.parent):
        (root / "geo.txt").write_text(str(root))
    assert opened(folder).part_path("source.geo") == folder / "geo.txt"


def test_two_files_for_one_part_in_one_folder_are_refused(folder: Path) -> None:
    for name in ("geo.txt", "positions.csv"):
        (folder / name).write_text(name)
    with pytest.raises(UsageError, match=r"both geo.txt and positions.csv") as caught:
        opened(folder)
    assert "ingest.positions=PATH" in caught.value.hint
    chosen = opened(folder, ingest={"positions": str(folder / "positions.csv")})
    assert chosen.part_path("source.geo") == folder / "positions.csv"


def test_none_ignores_the_file_that_is_there(folder: Path) -> None:
    (folder / "geo.txt").write_text("EPSG:4326\n")
    source = opened(folder, ingest={"positions": "none"})
    assert not source.part_path("source.geo").is_file()
    assert source.part_path("source.geo").read_text() == ""


def test_a_change_affects_only_its_own_part(folder: Path) -> None:
    control = folder / "gcp_list.txt"
    control.write_text("EPSG:32633\n")
    before = digests(opened(folder), folder)
    control.write_text("EPSG:32633\n1 2 3 4 5 a.jpg\n")
    after = digests(opened(folder), folder)
    assert {part for part in PARTS if before[part] != after[part]} == {"source.control"}
    control.unlink()
    gone = digests(opened(folder), folder)
    assert gone["source.photos"] == before["source.photos"]
    assert gone["source.control"] == gone["source.geo"]


def test_the_digest_is_of_the_content_wherever_it_lies(folder: Path, tmp_path: Path) -> None:
    (folder / "gcp_list.txt").write_text("EPSG:32633\n")
    (tmp_path / "other.txt").write_text("EPSG:32633\n")
    found = digests(opened(folder), folder)
    assert digests(opened(folder, georef={"control": str(tmp_path / "other.txt")}), folder) == found


def test_keys_hold_the_content_and_not_the_option(folder: Path, tmp_path: Path) -> None:
    (folder / "gcp_list.txt").write_text("EPSG:32633\n")
    (tmp_path / "same.txt").write_text("EPSG:32633\n")
    (tmp_path / "other.txt").write_text("EPSG:32632\n")
    keys = []
    for control in ("auto", str(tmp_path / "same.txt"), str(tmp_path / "other.txt")):
        source = opened(folder, georef={"control": control})
        config = resolve(LineConfig, [{"georef": {"control": control}}])
        parts = {part: Part(source.part_path(part), value) for part, value in digests(source, folder).items()}
        parts |= {part: Part(folder, "0") for part in GEOREF.reads if part not in parts}
        line = Line(LINE, config, parts, folder)
        keys.append([line.inputs_of(stage, parts).key for stage in (INGEST, GEOREF)])
    assert keys[0] == keys[1]
    assert keys[0][0] == keys[2][0]
    assert keys[0][1] != keys[2][1]


def test_a_relative_path_holds_wherever_the_run_is_looked_at(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "points.csv").write_text("name\n")
    monkeypatch.chdir(tmp_path)
    config = with_absolute_files(resolve(LineConfig, [{"georef": {"control": "points.csv"}}]), LINE)
    monkeypatch.chdir(folder)
    source = open_source(folder, tmp_path / "out", LINE, config)
    assert source.part_path("source.control") == tmp_path / "points.csv"


def make_large(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(MAX_NAMED_BYTES + 1)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (Path.exists, "does not exist"),
        (Path.mkdir, "is a folder"),
        (os.mkfifo, "not a regular file"),
        (make_large, "67 MB, too large"),
    ],
)
def test_an_unusable_named_file_is_reported(
    folder: Path, tmp_path: Path, make: Callable[[Path], object], message: str
) -> None:
    path = tmp_path / "points.csv"
    make(path)
    with pytest.raises(SplatpipeError, match=message) as caught:
        opened(folder, georef={"control": str(path)})
    assert "georef.control" in caught.value.message
    assert "points.csv" in caught.value.message
