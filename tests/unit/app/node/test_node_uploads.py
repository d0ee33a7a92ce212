"""Uploads: names, files that become whole or nothing, and zips."""

import random
import stat
import struct
import tracemalloc
import zipfile
from contextlib import suppress
from pathlib import Path

import pytest

from splatpipe.pipeline.app.node.tasks import zip_upload
from splatpipe.pipeline.app.node.tasks.names import (
    BadNameError,
    control_file,
    kind_of,
    plain_name,
)
from splatpipe.pipeline.app.node.tasks.uploads import ClosedUploadError, NameTakenError, UploadFolder
from splatpipe.pipeline.app.node.tasks.zip_upload import BadZipError, unpack


def _put(folder: UploadFolder, name: str, content: bytes) -> None:
    part = folder.begin(name)
    part.write(content)
    part.finish()


@pytest.fixture
def folder(tmp_path: Path) -> UploadFolder:
    (tmp_path / "upload").mkdir()
    return UploadFolder(tmp_path / "upload")


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        ("DJI 0001 (2).JPG", "DJI 0001 (2).JPG"),
        ("Straße+Übersicht&1.jpg", "Straße+Übersicht&1.jpg"),
        ("DCIM/100/a.jpg", "a.jpg"),
        ("C:\\photos\\a.jpg", "a.jpg"),
        ("../../etc/passwd", "passwd"),
    ],
)
def test_names_are_kept_without_their_folders(given: str, kept: str) -> None:
    assert plain_name(given) == kept


@pytest.mark.parametrize("given", ["", ".", "..", "a/", ".hidden.jpg", "a\nb.jpg", "a\0.jpg", "\ud800.jpg", "ä" * 121])
def test_names_that_cannot_be_kept_are_refused(given: str) -> None:
    with pytest.raises(BadNameError):
        plain_name(given)


def test_any_other_text_file_is_a_list_of_control_points() -> None:
    assert control_file(["a.jpg", "geo.txt", "points 2026.txt"]) == "points 2026.txt"
    assert control_file(["points.txt", "gcp_list.txt"]) is None
    assert control_file(["lens.txt", "image_groups.txt"]) is None
    assert [kind_of(name) for name in ("a.TIF", "b.mp4", "geo.txt", "seed.zip", "align.las")] == [
        "photo",
        "film",
        "survey",
        "other",
        "other",
    ]


def test_a_file_has_its_name_only_once_it_is_whole(folder: UploadFolder) -> None:
    part = folder.begin("a.jpg")
    part.write(b"half")
    assert folder.names() == []
    part.discard()
    assert list(folder.path.iterdir()) == []


def test_the_same_bytes_again_are_a_success_and_others_are_refused(folder: UploadFolder) -> None:
    _put(folder, "a.jpg", b"one")
    _put(folder, "a.jpg", b"one")
    with pytest.raises(NameTakenError):
        _put(folder, "a.jpg", b"two")
    assert (folder.path / "a.jpg").read_bytes() == b"one"
    assert folder.names() == ["a.jpg"]


def test_a_later_process_knows_whole_files_and_removes_parts(folder: UploadFolder) -> None:
    _put(folder, "a.jpg", b"one")
    cut = folder.begin("b.jpg")
    cut.write(b"half")
    (folder.path / "c.jpg").write_bytes(b"renamed, and its digest was not noted")
    later = UploadFolder(folder.path)
    assert later.names() == ["a.jpg", "c.jpg"]
    assert later.digests()["a.jpg"] == folder.digests()["a.jpg"]
    assert later.digests()["c.jpg"].size == 37
    cut.discard()


def test_a_torn_line_of_the_journal_costs_only_a_second_look(folder: UploadFolder) -> None:
    _put(folder, "a.jpg", b"one")
    journal = folder.path / ".digests"
    journal.write_bytes(journal.read_bytes()[:-20])
    assert UploadFolder(folder.path).digests() == folder.digests()


def test_a_closed_upload_takes_only_what_it_has(folder: UploadFolder) -> None:
    _put(folder, "a.jpg", b"one")
    folder.close()
    _put(folder, "a.jpg", b"one")
    with pytest.raises(ClosedUploadError):
        _put(folder, "b.jpg", b"two")
    assert folder.names() == ["a.jpg"]


def _zip(path: Path, *entries: tuple[str | zipfile.ZipInfo, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in entries:
            archive.writestr(name, content)
    return path


def _unpack(path: Path, folder: UploadFolder, limit: int = 10**9) -> list[str]:
    return unpack(path, folder, lambda _name: limit, lambda _size: None)


def test_a_zip_is_unpacked_without_its_folders(tmp_path: Path, folder: UploadFolder) -> None:
    path = _zip(
        tmp_path / "a.zip",
        ("photos/a.jpg", b"one"),
        ("photos/gcp_list.txt", b"EPSG:4326"),
        ("__MACOSX/photos/._a.jpg", b"x"),
        ("notes.docx", b"x"),
    )
    assert _unpack(path, folder) == ["__MACOSX/photos/._a.jpg", "notes.docx"]
    assert folder.sizes() == {"a.jpg": 3, "gcp_list.txt": 9}


def _link() -> zipfile.ZipInfo:
    info = zipfile.ZipInfo("a.jpg")
    info.create_system, info.external_attr = 3, (stat.S_IFLNK | 0o777) << 16
    return info


def test_hostile_zips_are_refused_and_leave_nothing(
    tmp_path: Path, folder: UploadFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zip_upload, "RATIO_FROM_BYTES", 1000)
    monkeypatch.setattr(zip_upload, "MAX_FILES", 3)
    (tmp_path / "none.zip").write_bytes(b"PK\3\4 no zip")
    good = _zip(tmp_path / "good.zip", ("a.jpg", b"0123456789" * 50)).read_bytes()
    (tmp_path / "torn.zip").write_bytes(good[:-5])
    damaged = bytearray(good)
    damaged[40:44] = b"\xff\xff\xff\xff"
    (tmp_path / "damaged.zip").write_bytes(damaged)
    encrypted = bytearray(good)
    encrypted[good.rindex(b"PK\1\2") + 8] |= 1
    (tmp_path / "encrypted.zip").write_bytes(encrypted)
    _zip(tmp_path / "bomb.zip", ("a.jpg", bytes(10**6)))
    _zip(tmp_path / "link.zip", (_link(), b"/etc/passwd"))
    _zip(tmp_path / "many.zip", *((f"{number}.jpg", b"x") for number in range(4)))
    _zip(tmp_path / "other.zip", ("a.jpg", b"x"), method=zipfile.ZIP_LZMA)
    _zip(tmp_path / "bad_name.zip", ("a\n.jpg", b"x"))
    for path in sorted(tmp_path.glob("*.zip")):
        if path.name != "good.zip":
            with pytest.raises(BadZipError):
                _unpack(path, folder)
    with pytest.raises(BadZipError):
        _unpack(tmp_path / "good.zip", folder, limit=100)
    assert folder.names() == []


def test_a_zip_whose_entries_share_their_bytes_is_no_bomb(
    tmp_path: Path, folder: UploadFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As Fifield's (A better zip bomb, WOOT 2019): each entry alone is in proportion to what it has in the zip."""
    monkeypatch.setattr(zip_upload, "RATIO_FROM_BYTES", 1000)
    monkeypatch.setattr(zip_upload, "MAX_RATIO", 20)
    names = [f"{number:02d}.jpg" for number in range(60)]
    data = _zip(tmp_path / "one.zip", ("00.jpg", 10 * random.Random(51).randbytes(1500))).read_bytes()
    start = data.index(b"PK\1\2")
    entry, end = data[start : data.index(b"PK\5\6")], bytearray(data[data.index(b"PK\5\6") :])
    directory = entry * len(names)
    struct.pack_into("<HHL", end, 8, len(names), len(names), len(directory))
    path = tmp_path / "overlapping.zip"
    path.write_bytes(data[:start] + directory + end)
    with zipfile.ZipFile(path) as archive:
        assert len(archive.infolist()) == 60
    with pytest.raises(BadZipError, match="more than"):
        _unpack(path, folder)


def test_a_directory_that_would_fill_the_memory_is_not_read(tmp_path: Path, folder: UploadFolder) -> None:
    path = tmp_path / "large.zip"
    size = zip_upload.MAX_READ_BYTES + 1
    with path.open("wb") as file:
        file.truncate(size)  # a hole: it takes no disk
        file.seek(size)
        file.write(struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 1, 1, size, 0, 0))
    tracemalloc.start()
    try:
        with pytest.raises(BadZipError):
            _unpack(path, folder)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_torn_directory_is_refused_whatever_it_says(tmp_path: Path, folder: UploadFolder) -> None:
    good = _zip(tmp_path / "good.zip", ("a.jpg", b"x"), ("b.jpg", b"y")).read_bytes()
    chance, path = random.Random(51), tmp_path / "torn.zip"
    start = good.index(b"PK\1\2")
    for _ in range(400):
        torn = bytearray(good)
        for _ in range(3):
            torn[chance.randrange(start, len(torn))] = chance.randrange(256)
        path.write_bytes(torn)
        with suppress(BadZipError):
            _unpack(path, folder)
    assert set(folder.sizes().values()) <= {1}


def test_two_photos_of_one_name_in_a_zip_are_refused(tmp_path: Path, folder: UploadFolder) -> None:
    path = _zip(tmp_path / "a.zip", ("100/a.jpg", b"one"), ("101/a.jpg", b"two"))
    with pytest.raises(BadZipError, match="other content"):
        _unpack(path, folder)
