"""Videos: decoded by a browser, complete or absent, the same bytes each time."""

import hashlib
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from repository import SCENES, environment
from videos import HEIGHT, WIDTH, frames, write

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.film.video import VideoWriter


@pytest.mark.parametrize("suffix", [".webm", ".mp4"])
def test_the_same_frames_give_the_same_bytes(suffix: str, tmp_path: Path) -> None:
    one, other = (write(tmp_path / f"{name}{suffix}", 12) for name in ("one", "other"))
    assert hashlib.sha256(one.read_bytes()).digest() == hashlib.sha256(other.read_bytes()).digest()
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([one.name, other.name])


@pytest.mark.parametrize(("fps", "count"), [(1, 1), (7, 15), (24, 49), (30, 31), (120, 121)])
def test_films_of_any_frame_rate_and_length_are_complete(fps: int, count: int, tmp_path: Path) -> None:
    film = write(tmp_path / "film.webm", count, fps, (64, 48))
    reader = cv2.VideoCapture(str(film), cv2.CAP_FFMPEG)
    read = 0
    while reader.read()[0]:
        read += 1
    assert read == count


def test_an_interrupted_film_leaves_nothing_and_keeps_the_earlier_one(tmp_path: Path) -> None:
    path = tmp_path / "film.webm"
    path.write_bytes(b"earlier")

    def break_off() -> None:
        with VideoWriter(path, (WIDTH, HEIGHT), 25) as film:
            film.write(next(frames(1)))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        break_off()
    assert [found.name for found in tmp_path.iterdir()] == ["film.webm"] and path.read_bytes() == b"earlier"


def test_an_unwritable_path_is_reported(tmp_path: Path) -> None:
    with pytest.raises(MachineError, match="Cannot write"):
        VideoWriter(tmp_path / "none" / "film.webm", (WIDTH, HEIGHT), 25)


def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path: Path) -> None:
    """A file size limit stands in for a full disk: OpenCV reports neither."""
    code = f"""
import resource, signal, sys
from pathlib import Path
import videos
from splatpipe.pipeline.engine.errors import MachineError
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
try:
    videos.write(Path({str(tmp_path)!r}) / "film.webm", 40)
except MachineError as error:
    print(error.message, error.hint)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment(SCENES)
    )
    assert "could not be written completely" in done.stdout and "disk" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_sides_are_even_and_suffixes_known(tmp_path: Path) -> None:
    for name, size in (("film.webm", (321, 182)), ("film.webm", (322, 181)), ("film.avi", (322, 182))):
        with pytest.raises(ValueError):
            VideoWriter(tmp_path / name, size, 25)
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_printed_on_stderr(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; import videos\n"
        f"videos.write(Path({str(tmp_path)!r}) / 'film.webm', 3); print('still heard', file=sys.stderr)"
    )
    env = environment(SCENES, PYTHONWARNINGS="ignore")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env)
    assert done.stderr.split() == ["still", "heard"]
