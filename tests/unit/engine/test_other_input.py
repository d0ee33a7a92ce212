"""Files given in place of photos that are not read: what they are, and what to do."""

import shlex
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.runs.source import open_source


def refusal(path: Path) -> SplatpipeError:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"something")
    with pytest.raises(SplatpipeError) as caught:
        open_source(path, path.parent / "out")
    return caught.value


@pytest.mark.parametrize("name", ["flight.mkv", "DJI 0001's.AVI", "00001.MTS", "-y.ts"])
def test_a_film_in_another_container_names_the_command_that_copies_its_pictures(tmp_path: Path, name: str) -> None:
    error = refusal(tmp_path / name)
    assert "is a film in a container that is not read" in error.message and "MP4 and MOV are read" in error.hint
    command = shlex.split(error.hint[error.hint.index("ffmpeg") :])
    path = tmp_path / name
    wanted = ["-i", str(path), "-map", "0:v:0", "-c:v", "copy", str(path.with_suffix(".mp4"))]
    assert command == ["ffmpeg", *wanted]


@pytest.mark.parametrize("name", ["flight.webm", "flight.wmv"])
def test_pictures_that_an_mp4_cannot_hold_are_encoded_anew(tmp_path: Path, name: str) -> None:
    assert "-c:v libx264" in refusal(tmp_path / name).hint


@pytest.mark.parametrize("name", ["photos.zip", "photos.7z", "photos.tar.gz", "PHOTOS.RAR"])
def test_an_archive_is_to_be_unpacked(tmp_path: Path, name: str) -> None:
    error = refusal(tmp_path / name)
    assert error.message.endswith("is an archive.") and "Unpack it" in error.hint


def test_a_single_picture_is_not_enough(tmp_path: Path) -> None:
    error = refusal(tmp_path / "one.JPG")
    assert error.message.endswith("is a single picture.") and "the folder that has all photos" in error.hint


@pytest.mark.parametrize("name", ["list.txt", "noname"])
def test_any_other_file_is_called_a_file(tmp_path: Path, name: str) -> None:
    error = refusal(tmp_path / name)
    assert error.message.endswith("is a file.") and "or a film (MP4, MOV)" in error.hint
