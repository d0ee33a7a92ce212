"""all.zip: the same bytes for the same contents, safe paths, and downloads of single files as ranges of it."""

import io
import os
import zipfile
from pathlib import Path

import pytest

from splatpipe.pipeline.app.node.assets import archive, single
from splatpipe.pipeline.app.node.assets.archive import Entry, write_archive
from splatpipe.pipeline.app.node.assets.layout import FOLDERS, PLACES, SINGLE, is_safe
from splatpipe.pipeline.app.node.assets.outputs import chosen, parse_outputs, unmatched
from splatpipe.pipeline.app.node.assets.single import list_assets, media_type, open_asset
from splatpipe.pipeline.app.serving.files import FileNotServedError, OpenFile
from splatpipe.pipeline.engine.errors import UsageError

TEXT = b"v 1 2 3\n" * 1000
RASTER = bytes(range(256)) * 40


def entries(folder: Path) -> list[Entry]:
    (folder / "dsm.tif").write_bytes(RASTER)
    return [
        Entry("odm_texturing/odm_textured_model_geo.obj", TEXT),
        Entry("odm_texturing/größe.jpg", RASTER[:100]),
        Entry("odm_dem/dsm.tif", folder / "dsm.tif"),
        Entry("odm_report/stats.json", b"{}\n"),
        Entry("contours/contours.geojson", TEXT),
    ]


def sent(file: OpenFile, start: int = 0, stop: int | None = None) -> bytes:
    """Read a range as an answer does, in steps."""
    stop, data = file.size if stop is None else min(stop, file.size), b""
    while start + len(data) < stop:
        chunk = file.read(min(1000, stop - start - len(data)), start + len(data))
        assert chunk, "it ends too early"
        data += chunk
    return data


def all_of(folder: Path, name: str) -> bytes:
    """Read a whole download, and close it."""
    file = open_asset(folder, name)
    try:
        return sent(file)
    finally:
        os.close(file.descriptor)


def test_the_same_contents_give_the_same_bytes(tmp_path: Path) -> None:
    write_archive(tmp_path / "one.zip", entries(tmp_path))
    os.utime(tmp_path / "dsm.tif", (1e9, 1e9))
    write_archive(tmp_path / "two.zip", entries(tmp_path)[::-1])
    assert (tmp_path / "one.zip").read_bytes() == (tmp_path / "two.zip").read_bytes()


def test_what_is_compressed_or_asked_for_alone_is_stored(tmp_path: Path) -> None:
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    with zipfile.ZipFile(tmp_path / "all.zip") as made:
        assert made.testzip() is None
        stored = {info.filename for info in made.infolist() if info.compress_type == zipfile.ZIP_STORED}
    assert stored == {"odm_texturing/größe.jpg", "odm_dem/dsm.tif", "odm_report/stats.json"}


def test_large_entries_have_fields_of_64_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive, "ZIP64_BYTES", 1000)
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    with zipfile.ZipFile(tmp_path / "all.zip") as made:
        assert made.testzip() is None and made.read("odm_dem/dsm.tif") == RASTER
    assert all_of(tmp_path, "dsm.tif") == RASTER


@pytest.mark.parametrize(
    "name", ["../x", "/x", "a/../b", "a//b", "a\\b", "C:/x", "a/.", "", "x\n", "a/" * 40 + "a", "a" * 2000]
)
def test_paths_that_lead_out_are_refused(tmp_path: Path, name: str) -> None:
    assert not is_safe(name)
    with pytest.raises(ValueError, match="no path"):
        write_archive(tmp_path / "all.zip", [Entry(name, b"")])


def test_two_entries_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="two entries"):
        write_archive(tmp_path / "all.zip", [Entry("a", b""), Entry("a", b"x")])


def test_all_our_own_paths_are_safe() -> None:
    paths = [*SINGLE.values(), *(each.rstrip("/") for each in (*FOLDERS.values(), *(place.entry for place in PLACES)))]
    assert all(map(is_safe, paths)) and all("/" not in name for name in (*SINGLE, *FOLDERS))


def test_a_single_file_is_a_range(tmp_path: Path) -> None:
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    file = open_asset(tmp_path, "dsm.tif")
    assert file.size == len(RASTER) and media_type("dsm.tif") == "image/tiff"
    for start, stop in ((0, 1), (5, 5), (100, 9000), (len(RASTER) - 1, None), (0, 1 << 40)):
        assert sent(file, start, stop) == RASTER[start:stop]
    assert file.read(10, len(RASTER)) == b""
    os.close(file.descriptor)
    assert all_of(tmp_path, "all.zip") == (tmp_path / "all.zip").read_bytes()


@pytest.mark.parametrize("limit", [None, 5000, 0])
def test_a_folder_is_an_archive_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: int | None) -> None:
    """With a low limit, fields are of 64 bits, as beyond 4 GiB."""
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    if limit is not None:
        monkeypatch.setattr(single, "LONG_FROM", limit)
    file = open_asset(tmp_path, "textured_model.zip")
    data = sent(file)
    assert sent(file, 40, 400) == data[40:400] and len(data) == file.size
    os.close(file.descriptor)
    with zipfile.ZipFile(io.BytesIO(data)) as made:
        assert made.testzip() is None
        assert {name: made.read(name) for name in made.namelist()} == {
            "größe.jpg": RASTER[:100],
            "odm_textured_model_geo.obj": TEXT,
        }


def test_only_known_names_are_downloads(tmp_path: Path) -> None:
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    for name in ("dtm.tif", "../all.zip", "odm_dem/dsm.tif", "", "contours.geojson", "3d_tiles_model.zip"):
        with pytest.raises(FileNotServedError):
            open_asset(tmp_path, name)
    assert list(list_assets(tmp_path)) == ["all.zip", "dsm.tif", "stats.json", "textured_model.zip"]


def test_a_broken_archive_has_no_downloads(tmp_path: Path) -> None:
    write_archive(tmp_path / "all.zip", entries(tmp_path))
    file = open_asset(tmp_path, "dsm.tif")
    os.truncate(tmp_path / "all.zip", 2000)
    with pytest.raises(AssertionError, match="too early"):
        sent(file)
    os.close(file.descriptor)
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(5):
        with pytest.raises(FileNotServedError):
            open_asset(tmp_path, "dsm.tif")
    (tmp_path / "all.zip").unlink()
    (tmp_path / "all.zip").symlink_to("/etc/passwd")
    with pytest.raises(FileNotServedError):
        open_asset(tmp_path, "all.zip")
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_outputs_choose_files_and_folders() -> None:
    paths = parse_outputs('["odm_dem/", "report.html", "odm_dem", "nothing"]')
    assert paths == ("odm_dem", "report.html", "nothing")
    names = ["odm_dem/dsm.tif", "odm_demo/x", "report.html", "report.html.gz"]
    assert chosen(names, paths) == ["odm_dem/dsm.tif", "report.html"]
    assert unmatched(names, paths) == ["nothing"]
    assert chosen(names, parse_outputs(" ")) == names


BAD_OUTPUTS = (
    *('["../x"]', '["/etc"]', '["a\\\\b"]', '[""]', "[1]", "{}", '"a"', "[", '["a", null]', '["\\u0000"]', '["a/./b"]'),
    *("[" * 100_000, '["' + "a" * 300_000 + '"]', "[" + ",".join(['"a"'] * 1001) + "]", '["\udcff"]'),
)


@pytest.mark.parametrize("text", BAD_OUTPUTS)
def test_outputs_that_lead_out_or_are_no_paths_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match="outputs"):
        parse_outputs(text)
