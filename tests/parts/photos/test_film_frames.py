"""A film instead of a photo folder: its frames are ingest's artifact, and everything behind sees photos."""

import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes import videos

from splatpipe.pipeline.app.preflight.intake import read_capture
from splatpipe.pipeline.app.preflight.start import require_readable
from splatpipe.pipeline.engine.config import resolve
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.events import Event, EventReporter
from splatpipe.pipeline.engine.runs.session import Request, open_session, status_of
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.engine.stage import Machine
from splatpipe.pipeline.film.video import VideoWriter
from splatpipe.pipeline.photos.files.photo_list import decode, load_photo_list
from splatpipe.pipeline.photos.metadata.exif import read_exif
from splatpipe.pipeline.photos.options import IngestConfig
from splatpipe.pipeline.photos.video import frames, measuring
from splatpipe.pipeline.photos.video.film_times import load_film_times
from splatpipe.pipeline.photos.video.frames import extract_frames
from splatpipe.pipeline.photos.video.motion import FilmMeter
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

FPS, COUNT, STEP = 30, 90, 8  # pixels a frame
WIDTH, HEIGHT = 480, 272


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight of three seconds over a texture, to the right, with DJI's subtitles ten times a second."""
    folder = tmp_path_factory.mktemp("film")
    noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH + STEP * COUNT, 3), dtype=np.uint8)
    ground = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 2.0), None, 0, 255, cv2.NORM_MINMAX)
    with VideoWriter(folder / "flight.mp4", (WIDTH, HEIGHT), FPS) as film:
        for k in range(COUNT):
            film.write(np.ascontiguousarray(ground[:, STEP * k : STEP * k + WIDTH]))
    (folder / "flight.SRT").write_text("\n".join(map(cue, range(10 * COUNT // FPS))))
    return folder


def cue(k: int) -> str:
    begin, end = (f"{at // 10:02d},{100 * (at % 10):03d}" for at in (k, k + 1))
    return (
        f"{k + 1}\n00:00:{begin} --> 00:00:{end}\n2026-06-18 13:00:{begin}\n[focal_len: 24.00] [latitude: 47.841190] "
        f"[longitude: {13.5 + 1e-5 * k:.7f}] [rel_alt: 30.000 abs_alt: {545.0 + k:.3f}] </font>\n"
    )


def ingested(film: Path, out: Path, events: list[Event], *sets: str) -> Path:
    tables = [{"ingest": {name: int(value)}} for name, value in (each.split("=") for each in sets)]
    request = Request(LINE, resolve(LineConfig, tables), film, out, Machine(threads=2))
    with open_session(request, events.append) as runner:
        return runner.walk(until="ingest").artifacts["ingest"].folder


def test_frames_are_photos_with_positions_and_times(flown: Path, tmp_path: Path) -> None:
    events: list[Event] = []
    folder = ingested(flown / "flight.mp4", tmp_path / "out", events)
    photos = load_photo_list(folder / "photos").photos
    assert 5 <= len(photos) <= 9 and all(photo.name.startswith("flight_0000") for photo in photos)
    assert photos[0].time is not None and photos[0].time.startswith("2026-06-18T13:00:00")
    positions = json.loads((folder / "positions.json").read_text())["positions"]
    for photo, position in zip(photos, positions, strict=True):
        time_s = int(photo.name[-10:-4]) / FPS
        assert position["longitude"] == pytest.approx(13.5 + 1e-4 * time_s, abs=2e-7)
        assert position["altitude_m"] == pytest.approx(545.0 + 10.0 * time_s, abs=0.02)
        assert position["relative_altitude_m"] == 30.0
        assert decode(photo, folder / "photos", flown / "flight.mp4").shape == (HEIGHT, WIDTH, 3)
    film = load_film_times(folder / "photos")
    assert film is not None and film.frame_s == pytest.approx(1.0 / FPS) and film.cuts_s == ()
    assert film.times_s == {photo.name: pytest.approx(int(photo.name[-10:-4]) / FPS, abs=1e-3) for photo in photos}
    messages = " ".join(event.data.get("message", "") for event in events)
    assert "frames in 3.0 s are used" in messages and "are from flight.SRT" in messages
    camera = json.loads((folder / "cameras.json").read_text())
    assert "35mm-equivalent" in json.dumps(camera)


def test_a_second_run_does_nothing_and_a_changed_film_or_subtitle_runs_again(flown: Path, tmp_path: Path) -> None:
    film = Path(shutil.copytree(flown, tmp_path / "film")) / "flight.mp4"
    events: list[Event] = []
    folder = ingested(film, tmp_path / "out", events)
    assert ingested(film, tmp_path / "out", events) == folder
    assert sum(event.kind == "stage_finished" for event in events) == 1
    assert ingested(film, tmp_path / "out", events, "max_frames=4") != folder
    subtitles = film.with_suffix(".SRT")
    subtitles.write_text(subtitles.read_text().replace("47.841190", "47.841191"))
    assert ingested(film, tmp_path / "out", events) != folder
    request = Request(LINE, LineConfig(), film, tmp_path / "out", Machine())
    line, _ = status_of(request)
    assert line.photos_dir == film


def test_a_killed_ingest_of_a_film_goes_on(flown: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = ingested(flown / "flight.mp4", tmp_path / "whole", [])
    monkeypatch.setattr(measuring, "KEEP_S", -1.0)
    measured: list[int] = []
    saved: list[str] = []
    add, save = FilmMeter.add, frames._save

    def add_or_die(meter: FilmMeter, number: int, time_s: float, pixels: np.ndarray) -> None:
        measured.append(number)
        if len(measured) == 20:
            raise KeyboardInterrupt
        add(meter, number, time_s, pixels)

    def save_or_die(pixels: np.ndarray, frame: frames._Frame, folder: Path) -> None:
        saved.append(frame.name)
        if len(saved) == 3:
            raise KeyboardInterrupt
        save(pixels, frame, folder)

    monkeypatch.setattr(FilmMeter, "add", add_or_die)
    monkeypatch.setattr(frames, "_save", save_or_die)
    film, kept, config = flown / "flight.mp4", tmp_path / "kept", IngestConfig()
    quiet = EventReporter("x", lambda _event: None)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            extract_frames(film, tmp_path / "frames", config, 1, quiet, kept)
    left = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "frames").iterdir()}
    assert len(left) == 2
    (tmp_path / "frames" / "stray.jpg").touch()
    extract_frames(film, tmp_path / "frames", config, 1, quiet, kept)
    assert sorted(set(measured)) == list(range(0, COUNT, 2)) and len(measured) == COUNT // 2 + 1
    again = {path.name: path for path in (tmp_path / "frames").iterdir()}
    assert all(again[name].stat().st_mtime_ns == time for name, time in left.items())
    expected = {path.name: path.read_bytes() for path in (whole / "photos" / "frames").iterdir()}
    assert {name: path.read_bytes() for name, path in again.items()} == expected


def test_what_a_killed_ingest_left_is_no_part_of_the_artifact(flown: Path, tmp_path: Path) -> None:
    request = Request(LINE, LineConfig(), flown / "flight.mp4", tmp_path / "out", Machine(threads=2))
    with open_session(request, lambda _event: None) as runner:
        whole = runner.walk(until="ingest").artifacts["ingest"].folder
    files = {path.relative_to(whole): path.read_bytes() for path in whole.rglob("*.jp*g")}
    partial = tmp_path / "out" / "stages" / ".partial" / whole.name
    shutil.move(whole, partial)
    (partial / "manifest.json").unlink()
    (partial / "film.measures").write_bytes(b"broken")
    (partial / "photos" / "masks").mkdir()
    for stray in ("photos/masks/x.png", "photos/stray", "photos/frames/flight_999999.jpg"):
        (partial / stray).touch()
    with open_session(request, lambda _event: None) as runner:
        again = runner.walk(until="ingest").artifacts["ingest"].folder
    assert {path.relative_to(again): path.read_bytes() for path in again.rglob("*.jp*g")} == files
    assert not (again / "photos" / "masks").exists() and not (again / "photos" / "stray").exists()
    assert not (again / "film.measures").exists()


def test_check_reads_a_film_and_tells_of_it(flown: Path, tmp_path: Path) -> None:
    film, config = flown / "flight.mp4", LineConfig()
    quiet = EventReporter("check", lambda _event: None)
    source = open_source(film, tmp_path / "out", LINE, config)
    intake, findings = read_capture(source, config, 2, quiet, tmp_path / "frames")
    assert len(intake.photos) >= 5 and len(intake.positions.positions) == len(intake.photos)
    assert {"film", "film-positions", "film-shutter"} <= {finding.code for finding in findings}


def test_masks_and_survey_files_lie_beside_a_film(flown: Path, tmp_path: Path) -> None:
    film = Path(shutil.copytree(flown, tmp_path / "film")) / "flight.mp4"
    first = load_photo_list(ingested(film, tmp_path / "out", []) / "photos").photos[0]
    (film.parent / "masks").mkdir()
    Image.new("L", (WIDTH, HEIGHT), 0).save(film.parent / "masks" / f"{first.name}.png")
    (film.parent / "gcp_list.txt").write_text("EPSG:32633\n")
    photos = load_photo_list(ingested(film, tmp_path / "out", []) / "photos").photos
    assert photos[0].mask is not None and photos[1].mask is None
    assert open_source(film, tmp_path / "out", LINE, LineConfig()).part_path("source.control").name == "gcp_list.txt"


def test_at_most_so_many_frames(flown: Path, tmp_path: Path) -> None:
    quiet = EventReporter("x", lambda _event: None)
    issues, _ = extract_frames(flown / "flight.mp4", tmp_path / "few", IngestConfig(max_frames=4), 1, quiet)
    assert len(list((tmp_path / "few").iterdir())) == 4
    assert any(issue.code == "film-frames" and "ingest.max_frames=4" in issue.message for issue in issues)


def test_frames_are_turned_by_exif_alone_and_a_film_without_positions_says_so(flown: Path, tmp_path: Path) -> None:
    data = (flown / "flight.mp4").read_bytes()
    upright = b"".join(value.to_bytes(4, "big") for value in (1 << 16, 0, 0, 0, 1 << 16))
    turned = b"".join(value.to_bytes(4, "big", signed=True) for value in (0, 1 << 16, 0, -(1 << 16), 0))
    at = data.index(upright, data.index(b"tkhd"))
    (tmp_path / "turned.mov").write_bytes(data[:at] + turned + data[at + len(upright) :])
    quiet = EventReporter("x", lambda _event: None)
    issues, _ = extract_frames(tmp_path / "turned.mov", tmp_path / "frames", IngestConfig(), 1, quiet)
    with Image.open(next((tmp_path / "frames").iterdir())) as picture:
        assert picture.size == (WIDTH, HEIGHT) and read_exif(picture).orientation == 6
        assert read_exif(picture).gps is None
    messages = " ".join(issue.message for issue in issues)
    assert "turned by 90°" in messages and "No positions come with turned.mov" in messages


def test_what_is_no_film_of_a_flight_is_refused_in_a_sentence(flown: Path, tmp_path: Path) -> None:
    quiet = EventReporter("x", lambda _event: None)
    still = tmp_path / "still.mp4"
    with VideoWriter(still, (WIDTH, HEIGHT), FPS) as film:
        for _ in range(20):
            film.write(next(videos.frames(1, WIDTH, HEIGHT)))
    with pytest.raises(SplatpipeError, match="only 1 of its 20 frames differ"):
        extract_frames(still, tmp_path / "a", IngestConfig(), 1, quiet)
    data = bytearray((flown / "flight.mp4").read_bytes())
    at = data.index(b"mdat") + 4
    data[at : at + 200_000] = bytes(200_000)
    (tmp_path / "noisy.mp4").write_bytes(bytes(data))
    with pytest.raises(SplatpipeError, match=r"can be decoded|is damaged"):
        extract_frames(tmp_path / "noisy.mp4", tmp_path / "b", IngestConfig(), 1, quiet)
    with pytest.raises(SplatpipeError, match=r"more than ingest\.max_megapixels"):
        extract_frames(flown / "flight.mp4", tmp_path / "c", IngestConfig(max_megapixels=0.1), 1, quiet)


def test_what_is_no_film_is_refused_before_its_gigabytes_are_hashed(tmp_path: Path) -> None:
    path = tmp_path / "zeros.mp4"
    path.touch()
    os.truncate(path, 4 << 30)
    request = Request(LINE, LineConfig(), path, tmp_path / "out", Machine())
    with pytest.raises(SplatpipeError, match=r"zeros\.mp4 is no MP4 or MOV film"):
        require_readable(request)


def test_a_folder_of_films_names_the_command(flown: Path, tmp_path: Path) -> None:
    with pytest.raises(SplatpipeError) as caught:
        ingested(flown, tmp_path / "out", [])
    assert "a film: flight.mp4" in caught.value.message and "splatpipe run" in caught.value.hint
    with pytest.raises((SplatpipeError, UsageError)):
        open_source(flown / "flight.SRT", tmp_path / "out")
