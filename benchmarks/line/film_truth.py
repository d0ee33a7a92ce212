"""A film with known truth through the line: ``film_truth SPLAT WORK [--seconds 60] [--fps 30] [--rolling]``.

SPLAT is a finished splat in local metres, z up (the demo's ``splat.ply`` or ``clean``'s ``model.ply``). A flight around
it, at a height that changes by half, is drawn by splatpipe's rasterizer: each frame is the mean, in linear light, of
several moments of an exposure; with ``--rolling`` each band of rows has moments of its own. ffmpeg makes a film of a
drone's bit rate, and beside it lies an SRT, once a second. The line runs on the film, and on sharp stills of the same
moments with the same metadata. Centres are compared with the truth after the best similarity. Required: all placed,
errors at most twice those of the stills, psnr_cc of own held-out frames within 1 dB.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pycolmap
import torch
from commands import run_all, splatpipe
from jaxtyping import Float64
from PIL import Image
from tables import Row, print_table

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import fit_similarity
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.render.rendering import render_pixels
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians

LATITUDE, LONGITUDE, HEIGHT_M = 47.84119, 13.51269, 515.0  # the demo's origin
METRES_PER_DEGREE = 111_320.0
RADIUS_M, LOW_M, HIGH_M, TARGET_M = 24.0, 7.0, 14.0, (0.0, 0.0, 2.5)
RELATIVE_FOCAL = 0.72  # focal length over the image width
RECEIVER_M = 1.0  # standard deviation of the SRT's positions
GAMMA = 2.2
LINEAR = (np.arange(256, dtype=np.float32) / 255.0) ** GAMMA  # light of an 8-bit value
BANDS = 18  # bands of rows that are exposed at different moments under a rolling shutter
MAX_TIMES, MAX_LOSS_DB = 2.0, 1.0

COLUMNS = {
    "run": "run:",
    "frames": "frames:,",
    "placed": "placed:,",
    "rms mm": "rms_mm:.1f",
    "largest": "largest_mm:.1f",
    "psnr_cc dB": "psnr_cc:.2f",
    "CPU seconds": "seconds:.0f",
    "bars": "bars:",
}


@dataclass(frozen=True)
class Flight:
    """How the film is flown and taken."""

    seconds: float
    turns: float
    fps: int
    width: int
    height: int
    exposure_s: float
    readout_s: float
    moments: int

    @property
    def frames(self) -> int:
        return round(self.seconds * self.fps)

    def centre(self, time_s: float) -> Float64[np.ndarray, " 3"]:
        """East, north, up at a time."""
        share = time_s / self.seconds
        angle = 2.0 * math.pi * self.turns * share
        up = LOW_M + (HIGH_M - LOW_M) * 0.5 * (1.0 - math.cos(2.0 * math.pi * share))
        return np.array([RADIUS_M * math.sin(angle), RADIUS_M * math.cos(angle), up])

    def camera(self, time_s: float) -> Camera:
        """The camera at a time, which looks at the subject."""
        centre = self.centre(time_s)
        ahead = np.array(TARGET_M) - centre
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead])
        pose[:3, 3] = -pose[:3, :3] @ centre
        focal = RELATIVE_FOCAL * self.width
        return Camera("", self.width, self.height, focal, focal, self.width / 2.0, self.height / 2.0, pose)


def frame_of(flight: Flight, gaussians: Gaussians, options: RenderOptions, time_s: float) -> np.ndarray:
    """A frame, (h, w, 3) RGB: the mean of its moments, row by row later under a rolling shutter."""
    bands = BANDS if flight.readout_s else 1
    edges = np.linspace(0, flight.height, bands + 1).round().astype(int)
    rows = []
    for top, bottom in pairwise(edges):
        late_s = flight.readout_s * ((top + bottom) / 2.0 / flight.height - 0.5)
        linear = np.zeros((bottom - top, flight.width, 3), np.float32)
        for moment in range(flight.moments):
            at_s = time_s + late_s + flight.exposure_s * ((moment + 0.5) / flight.moments - 0.5)
            camera = flight.camera(at_s).crop(0, int(top), flight.width, int(bottom - top))
            linear += LINEAR[render_pixels((gaussians, None), camera, options)]
        rows.append(linear / flight.moments)
    return np.rint(255.0 * np.concatenate(rows) ** (1.0 / GAMMA)).astype(np.uint8)


def write_film(path: Path, flight: Flight, gaussians: Gaussians, options: RenderOptions, rate: str) -> float:
    """Draw and encode the film; return the CPU seconds a frame."""
    began_s = time.process_time()
    words = ["ffmpeg", "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24"]
    words += ["-s", f"{flight.width}x{flight.height}", "-r", str(flight.fps), "-i", "-", "-c:v", "libx264"]
    whole = path.with_name(f"partial-{path.name}")
    words += ["-b:v", rate, "-g", str(flight.fps), "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(whole)]
    with subprocess.Popen(words, stdin=subprocess.PIPE) as encoder:
        assert encoder.stdin is not None
        for frame in range(flight.frames):
            encoder.stdin.write(frame_of(flight, gaussians, options, frame / flight.fps).tobytes())
        encoder.stdin.close()
    if encoder.returncode:
        raise SystemExit(f"ffmpeg failed with {encoder.returncode}")
    whole.rename(path)
    return (time.process_time() - began_s) / flight.frames


def write_subtitles(path: Path, flight: Flight) -> None:
    """DJI's subtitles, once a second, with a receiver's errors."""
    generator = np.random.default_rng(0)
    cues = []
    for second in range(math.ceil(flight.seconds)):
        east, north, up = flight.centre(float(second)) + generator.normal(0.0, RECEIVER_M, 3)
        latitude = LATITUDE + north / METRES_PER_DEGREE
        longitude = LONGITUDE + east / (METRES_PER_DEGREE * math.cos(math.radians(LATITUDE)))
        times = [f"00:{at // 60:02d}:{at % 60:02d},000" for at in (second, second + 1)]
        cues.append(
            f"{second + 1}\n{times[0]} --> {times[1]}\n2026-06-18 13:{second // 60:02d}:{second % 60:02d}.000\n"
            f"[latitude: {latitude:.7f}] [longitude: {longitude:.7f}] "
            f"[rel_alt: {up:.3f} abs_alt: {HEIGHT_M + up:.3f}]\n"
        )
    path.write_text("\n".join(cues))


def write_stills(folder: Path, frames: Path, flight: Flight, gaussians: Gaussians, options: RenderOptions) -> None:
    """Sharp stills of the moments of the chosen frames, with these frames' metadata."""
    folder.mkdir(exist_ok=True)
    for path in sorted(frames.iterdir()):
        still = Image.fromarray(
            render_pixels((gaussians, None), flight.camera(_number(path.name) / flight.fps), options)
        )
        with Image.open(path) as frame:
            kept = {"exif": frame.info["exif"]} | ({"xmp": frame.info["xmp"]} if "xmp" in frame.info else {})
        still.save(folder / path.name, "JPEG", quality=97, subsampling=0, **kept)


def _number(name: str) -> int:
    return int(Path(name).stem.rpartition("_")[2])


def newest(out: Path, stage: str) -> Path:
    """The newest artifact of a stage."""
    return max(out.glob(f"stages/{stage}-*"), key=lambda folder: folder.stat().st_mtime)


def judged(name: str, out: Path, flight: Flight, seconds: float) -> Row:
    """Placed frames and the errors of their centres in a finished run."""
    model = pycolmap.Reconstruction(str(newest(out, "sparse") / "sparse" / "0"))
    placed = {image.name: image.projection_center() for image in model.images.values() if image.has_pose}
    names = sorted(placed)
    truth = np.stack([flight.centre(_number(each) / flight.fps) for each in names])
    found = np.stack([placed[each] for each in names])
    scale, rotation, shift = fit_similarity(found, truth, np.ones(len(names)))
    errors = np.linalg.norm(scale * found @ rotation.T + shift - truth, axis=1)
    listed = json.loads((newest(out, "ingest") / "photos" / "photos.json").read_text())["photos"]
    judged_views = sorted(out.glob("stages/evaluate-*/metrics.json"))
    return {
        "run": name,
        "frames": len(listed),
        "placed": len(names),
        "rms_mm": 1000.0 * float(np.sqrt((errors**2).mean())),
        "largest_mm": 1000.0 * float(errors.max()),
        "psnr_cc": json.loads(judged_views[-1].read_text())["mean"]["psnr_cc"] if judged_views else None,
        "seconds": seconds,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("splat", type=Path)
    parser.add_argument("work", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--turns", type=float, default=2.0)
    parser.add_argument("--size", default="1920x1080")
    parser.add_argument("--fps", type=int, default=30, help="fewer draw faster; the flight stays the same")
    parser.add_argument("--moments", type=int, default=4)
    parser.add_argument("--exposure", type=float, default=1.0 / 120.0, help="seconds")
    parser.add_argument("--rolling", action="store_true", help="a rolling shutter of 1/60 s")
    parser.add_argument("--rate", default="50M", help="of the film, bits per second")
    parser.add_argument("--until", default="evaluate")
    parser.add_argument("--preset", default="standard")
    options = parser.parse_args()
    width, height = map(int, options.size.split("x"))
    readout_s = 1.0 / 60.0 if options.rolling else 0.0
    flight = Flight(
        options.seconds, options.turns, options.fps, width, height, options.exposure, readout_s, options.moments
    )
    gaussians = read_splat(options.splat)
    rendering = RenderOptions(
        sh_degree=gaussians.sh_degree, background=(0.62, 0.72, 0.82), antialias=True, near=0.05, depth=False
    )
    options.work.mkdir(parents=True, exist_ok=True)
    film = options.work / ("rolling.mp4" if options.rolling else "flight.mp4")
    if not film.exists():
        with torch.no_grad():
            print(f"drawn in {write_film(film, flight, gaussians, rendering, options.rate):.2f} CPU seconds a frame")
    write_subtitles(film.with_suffix(".SRT"), flight)
    stills, outs = (
        options.work / f"{film.stem}-stills",
        [options.work / f"{film.stem}-{kind}" for kind in ("film", "still")],
    )
    rows = [_run("film", film, outs[0], flight, options)]
    frames = newest(outs[0], "ingest") / "photos" / "frames"
    write_stills(stills, frames, flight, gaussians, rendering)
    rows.append(_run("stills", stills, outs[1], flight, options))
    print_table(film.name, _with_bars(rows), COLUMNS)


def _run(name: str, photos: Path, out: Path, flight: Flight, options: argparse.Namespace) -> Row:
    words = ["run", str(photos), str(out), "--until", options.until, "--preset", options.preset]
    (end,) = run_all([splatpipe(name, words, out.with_suffix(".log"))], 1)
    if end.failure:
        raise SystemExit(f"{name}: {end.failure}")
    return judged(name, out, flight, end.cpu_s)


def _with_bars(rows: Sequence[Row]) -> list[Row]:
    film, still = rows
    met = film["placed"] == film["frames"] and film["rms_mm"] <= MAX_TIMES * still["rms_mm"]
    if film["psnr_cc"] is not None and still["psnr_cc"] is not None:
        met = met and film["psnr_cc"] >= still["psnr_cc"] - MAX_LOSS_DB
    return [{**film, "bars": "met" if met else "NOT MET"}, {**still, "bars": ""}]


if __name__ == "__main__":
    main()
