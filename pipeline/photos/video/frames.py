"""A film's frames as photos: JPEGs with EXIF and XMP in a folder, which everything behind reads as a photo folder."""

from __future__ import annotations

import datetime
import shutil
from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8
from PIL import ExifTags, Image
from PIL.TiffImagePlugin import IFDRational

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.runs.source import subtitles_beside
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.photos.files.names import is_plain, printable
from splatpipe.pipeline.photos.intake.capture_issues import CaptureIssue
from splatpipe.pipeline.photos.options import IngestConfig
from splatpipe.pipeline.photos.video.boxes import Container, read_container
from splatpipe.pipeline.photos.video.choice import Choice, choose
from splatpipe.pipeline.photos.video.film_times import FilmTimes
from splatpipe.pipeline.photos.video.measuring import measure_film, open_film
from splatpipe.pipeline.photos.video.motion import Measures
from splatpipe.pipeline.photos.video.telemetry import FlightPath, Place, read_fixes, read_subtitles

FRAMES_DIR = "frames"  # in the part `photos`
MIN_FRAMES = 3  # a reconstruction needs as many
JPEG_QUALITY = 97  # JPEG quality of extracted frames, without subsampled colours: the film's own losses are larger
MAX_STEM_BYTES = 200  # longest film name used for frames, which a number, masks and conversions make longer
ORIENTATIONS = {0: 1, 90: 6, 180: 3, 270: 8}  # EXIF's, by a player's turn, degrees clockwise
# median motion between frames over the frame's size, above which a rolling shutter may shear them
MAX_MOTION_SHARE = 0.005
TAG, GPS = ExifTags.Base, ExifTags.GPS
XMP = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" drone-dji:RelativeAltitude="{:+.3f}"/>'
    "</rdf:RDF></x:xmpmeta>"
)


@dataclass(frozen=True, eq=False)
class Flight:
    """Where a film was taken.

    Attributes:
        path: Positions along it.
        source: Where they are from, in words; empty without positions.
    """

    path: FlightPath
    source: str


def extract_frames(
    film: Path, folder: Path, config: IngestConfig, threads: int, report: Reporter, kept: Path | None = None
) -> tuple[list[CaptureIssue], FilmTimes]:
    """Choose a film's frames and write them into a folder.

    Args:
        film: An MP4 or MOV.
        folder: Where the frames go; created. Those that a killed run wrote into it stay; other files are removed.
        config: `ingest`'s options.
        threads: For decoding.
        report: Receives the progress.
        kept: File of what was measured, from which a killed run goes on; None: nothing is kept.

    Returns:
        What is to be told of the film, and when the frames were taken.

    Raises:
        SplatpipeError: if it cannot be decoded, or has too few different frames.
    """
    name = printable(film.name)
    container = read_container(film)
    if container.width * container.height > config.max_megapixels * 1e6:
        raise SplatpipeError(
            f"{name} claims {container.width} × {container.height} pixels, more than "
            f"ingest.max_megapixels={config.max_megapixels:g} allows.",
            hint="Give a film of a camera.",
        )
    flight = _flight(film, container)
    measures = measure_film(film, container, threads, report, kept)
    choice = choose(measures, config.max_frames)
    if len(choice.chosen) < MIN_FRAMES:
        raise SplatpipeError(
            f"{name} shows too little: only {len(choice.chosen)} of its {container.frames:,} frames differ.",
            hint="A reconstruction needs a camera that moves past its subject.",
        )
    frames = _frames_of(film, container, measures, choice, flight)
    _write(film, folder, frames, threads, report)
    times = {
        frame.name: float(measures.times_s[index]) for frame, index in zip(frames, choice.chosen.tolist(), strict=True)
    }
    taken = FilmTimes(container.seconds / container.frames, times, choice.cuts_s)
    return _issues(film, container, measures, choice, flight), taken


@dataclass(frozen=True)
class _Frame:
    """A frame to write: its number in the film, its file name, and its metadata."""

    number: int
    name: str
    exif: Image.Exif
    xmp: bytes


def _flight(film: Path, container: Container) -> Flight:
    """The film's positions: of the subtitle file beside it, else of its subtitle track."""
    beside = subtitles_beside(film)
    if beside is not None:
        try:
            fixes = read_fixes(read_subtitles(beside), container.location)
        except OSError as error:
            raise SplatpipeError(
                f"{printable(beside.name)} cannot be read: {error.strerror or error}.", hint="Check the file."
            ) from error
        if fixes:
            return Flight(FlightPath(fixes), printable(beside.name))
    fixes = read_fixes(container.cues, container.location)
    return Flight(FlightPath(fixes), "its subtitle track" if fixes else "")


def _frames_of(film: Path, container: Container, measures: Measures, choice: Choice, flight: Flight) -> list[_Frame]:
    stem = film.stem if is_plain(film.stem) and len(film.stem.encode(errors="replace")) <= MAX_STEM_BYTES else "frame"
    began = _began(container, flight)
    focal = flight.path.fixes[0].focal_mm if flight.path.fixes else None
    frames = []
    for index in choice.chosen:
        number, time_s = int(measures.frames[index]), float(measures.times_s[index])
        place = flight.path.at(time_s)
        exif = _exif(ORIENTATIONS[container.turn_deg], place)
        detail: dict[int, Any] = {}
        if began is not None:
            taken = began + datetime.timedelta(seconds=round(time_s, 3))
            detail |= {TAG.DateTimeOriginal: taken.strftime("%Y:%m:%d %H:%M:%S")}
            detail |= {TAG.SubsecTimeOriginal: f"{taken.microsecond // 1000:03d}"}
        if focal is not None:
            detail[TAG.FocalLengthIn35mmFilm] = round(focal)
        exif.get_ifd(ExifTags.IFD.Exif).update(detail)
        height = None if place is None else place.height_m
        xmp = b"" if height is None else XMP.format(height).encode()
        frames.append(_Frame(number, f"{stem}_{number:06d}.jpg", exif, xmp))
    return frames


def _began(container: Container, flight: Flight) -> datetime.datetime | None:
    """When the film's first frame was taken, by its subtitles (local time), else by its container (UTC)."""
    for fix in flight.path.fixes[:1]:
        if fix.recorded is not None:
            return fix.recorded - datetime.timedelta(seconds=fix.time_s)
    return container.recorded


def _exif(orientation: int, place: Place | None) -> Image.Exif:
    exif = Image.Exif()
    exif[TAG.Orientation] = orientation
    if place is not None:
        tags: dict[int, Any] = {
            GPS.GPSLatitudeRef: "S" if place.latitude < 0.0 else "N",
            GPS.GPSLatitude: _sexagesimal(place.latitude),
            GPS.GPSLongitudeRef: "W" if place.longitude < 0.0 else "E",
            GPS.GPSLongitude: _sexagesimal(place.longitude),
        }
        if place.altitude_m is not None:
            tags[GPS.GPSAltitudeRef] = b"\1" if place.altitude_m < 0.0 else b"\0"
            tags[GPS.GPSAltitude] = IFDRational(round(1000.0 * abs(place.altitude_m)), 1000)
        if place.sigma_m is not None:
            tags[GPS.GPSHPositioningError] = IFDRational(round(1000.0 * place.sigma_m), 1000)
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(tags)
    return exif


def _sexagesimal(degrees: float) -> tuple[IFDRational, IFDRational, IFDRational]:
    """Degrees, minutes, and seconds to a millionth (30 micrometres)."""
    millionths = round(abs(degrees) * 3600e6)
    minutes, seconds = divmod(millionths, 60_000_000)
    return IFDRational(minutes // 60, 1), IFDRational(minutes % 60, 1), IFDRational(seconds, 1_000_000)


def _write(film: Path, folder: Path, frames: Sequence[_Frame], threads: int, report: Reporter) -> None:
    """Decode the film once more, as seeking lands on other frames, and write the chosen ones that are missing."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = _keep_only({frame.name for frame in frames}, folder)
    wanted: Mapping[int, _Frame] = {frame.number: frame for frame in frames if frame.name not in whole}
    written = len(whole)
    with open_film(film, threads) as capture:
        for number in range(max(wanted, default=-1) + 1):
            if not capture.grab():
                break
            if number not in wanted:
                continue
            read, pixels = capture.retrieve()
            if not read or pixels is None:
                break
            _save(np.asarray(pixels, np.uint8), wanted[number], folder)
            written += 1
            report.progress(written, len(frames), "writing the film's frames", "frames")
    if written < len(frames):
        raise SplatpipeError(f"{printable(film.name)} changed while it was read.", hint="Run again.")


def _keep_only(names: AbstractSet[str], folder: Path) -> set[str]:
    """Remove all but the files of these names, which were written whole; return the names of those that are there."""
    for path in folder.iterdir():
        if path.name in names and path.is_file() and not path.is_symlink():
            continue
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    return {path.name for path in folder.iterdir()}


def _save(pixels: UInt8[np.ndarray, "h w 3"], frame: _Frame, folder: Path) -> None:
    settings: dict[str, Any] = {"quality": JPEG_QUALITY, "subsampling": 0, "exif": frame.exif.tobytes()}
    if frame.xmp:
        settings["xmp"] = frame.xmp
    picture = Image.fromarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
    write_durably(folder / frame.name, lambda file: picture.save(file, "JPEG", **settings))


def _issues(film: Path, container: Container, measures: Measures, choice: Choice, flight: Flight) -> list[CaptureIssue]:
    """What is to be told of a film, in sentences."""
    name, count = printable(film.name), len(choice.chosen)
    overlap = float(np.nanmedian(choice.overlaps)) if np.isfinite(choice.overlaps).any() else float("nan")
    found = [
        CaptureIssue(
            "film",
            f"{name}: {count} of {container.frames:,} frames in {container.seconds:.1f} s are used, each overlapping "
            f"the one before by {100.0 * overlap:.0f} % (median).",
            severity="note",
        )
    ]
    if choice.found > count:
        found.append(
            CaptureIssue(
                "film-frames",
                f"{name} would give {choice.found:,} frames; ingest.max_frames={count} leaves an overlap of "
                f"{100.0 * overlap:.0f} %.",
                "Raise it, if you can wait longer, or cut the film.",
            )
        )
    if len(choice.blurred):
        times = ", ".join(f"{measures.times_s[at]:.1f}" for at in choice.blurred[:5])
        more = " and others" if len(choice.blurred) > 5 else ""
        found.append(
            CaptureIssue(
                "film-blurred",
                f"{len(choice.blurred)} frames of {name} are blurred, as all around them are (at {times} s{more}).",
                "Fly slower, or set a shorter exposure.",
            )
        )
    if choice.cuts_s:
        times = ", ".join(f"{time_s:.1f}" for time_s in choice.cuts_s[:5])
        found.append(
            CaptureIssue(
                "film-cuts",
                f"{name} goes on with another picture at {times} s.",
                "Use the film as the camera wrote it.",
            )
        )
    found += _shutter_issues(container, measures, name)
    return [*found, *_position_issues(measures, choice, flight, container, name)]


def _shutter_issues(container: Container, measures: Measures, name: str) -> list[CaptureIssue]:
    found = []
    if container.turn_deg:
        text = f"{name} is to be turned by {container.turn_deg}° for display; its frames are used as they were taken."
        found.append(CaptureIssue("film-turned", text, severity="note"))
    steps = measures.steps[~np.isnan(measures.steps[:, 0, 0])]
    centre = np.array([0.5, 0.5, 1.0])
    moved = np.abs(steps @ centre - centre)[:, :2]
    usual = float(np.median(moved.max(axis=1))) if len(moved) else 0.0
    if usual > MAX_MOTION_SHARE:
        pixels = usual * max(container.width, container.height)
        text = (
            f"The picture in {name} moves by {pixels:.0f} pixels a frame: a rolling shutter, as most films are taken "
        )
        text += "with, shears it by up to as much. A run corrects the cameras for that, but not the pictures."
        found.append(CaptureIssue("film-shutter", text, "Fly slower, or take photos."))
    return found


def _position_issues(
    measures: Measures, choice: Choice, flight: Flight, container: Container, name: str
) -> list[CaptureIssue]:
    if not flight.source:
        text = f"No positions come with {name}: neither a subtitle file (SRT) beside it nor a subtitle track states any"
        text += "."
        if container.location is not None:
            latitude, longitude = container.location
            text = text[:-1] + f", and its one location ({latitude:.5f}, {longitude:.5f}) places no frame."
        return [
            CaptureIssue(
                "film-positions", text, "Copy the SRT file beside the film, with the film's name.", severity="note"
            )
        ]
    placed = sum(flight.path.at(float(measures.times_s[at])) is not None for at in choice.chosen)
    text = f"Positions of {placed} of {len(choice.chosen)} frames of {name} are from {flight.source}, between "
    text += f"{len(flight.path.fixes):,} of the drone's receiver."
    return [CaptureIssue("film-positions", text, severity="note")]
