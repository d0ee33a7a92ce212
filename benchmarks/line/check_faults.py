"""Inject faults into the demo's photos, and count how many `splatpipe check` finds.

The author of this script neither wrote `check` nor had read it.

    python benchmarks check_faults [--trials 16]

A trial is a copy of the demo capture with five faults on different photos. Even trials have a defocused photo, an
underexposed one, two with swapped GPS positions, a truncated file and a strip of three missing photos; odd trials have
a motion-blurred photo, an overexposed one, a duplicate, one from a second camera and one of half the size.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from splatpipe.demo import CAPTURE

EXIF, GPS = 0x8769, 0x8825
MODEL, FOCAL_MM, FOCAL_35 = 0x0110, 0x920A, 0xA405
QUALITY = 95


@dataclass(frozen=True)
class CaptureFault:
    """One fault: what it is, the photos concerned, and the codes of findings that report it."""

    kind: str
    photos: tuple[str, ...]
    codes: str  # a pattern


def rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Replace a photo's pixels and keep its metadata."""
    with Image.open(path) as photo:
        pixels, info = np.asarray(photo.convert("RGB")), dict(photo.info)
    Image.fromarray(change(pixels)).save(path, "JPEG", quality=QUALITY, exif=info["exif"], xmp=info["xmp"])


def defocus(path: Path, generator: np.random.Generator) -> str:
    radius = float(generator.uniform(3.0, 6.0))
    side = 2 * int(np.ceil(radius)) + 1
    away = np.hypot(*np.meshgrid(*[np.arange(side) - side // 2] * 2))
    disc = np.clip(radius + 0.5 - away, 0.0, 1.0)
    rewrite(path, lambda pixels: cv2.filter2D(pixels, -1, disc / disc.sum()))
    return f"defocus {radius:.1f} px"


def shake(path: Path, generator: np.random.Generator) -> str:
    length, angle = float(generator.uniform(3.0, 9.0)), float(generator.uniform(0.0, np.pi))
    side, fine = 13, 8  # the line is drawn at high resolution and averaged down
    drawn = np.zeros((side * fine, side * fine), np.float32)
    middle, half = side * fine / 2, length * fine / 2
    ends = [(round(middle + s * half * np.cos(angle)), round(middle + s * half * np.sin(angle))) for s in (-1, 1)]
    cv2.line(drawn, ends[0], ends[1], 1.0, fine)
    line = drawn.reshape(side, fine, side, fine).mean(axis=(1, 3))
    rewrite(path, lambda pixels: cv2.filter2D(pixels, -1, line / line.sum()))
    return f"motion {length:.1f} px"


def expose(path: Path, stops: float) -> str:
    def change(pixels: np.ndarray) -> np.ndarray:
        light = np.power(pixels / 255.0, 2.2) * 2.0**stops
        return np.asarray(np.round(255.0 * np.clip(light, 0.0, 1.0) ** (1 / 2.2)), np.uint8)

    rewrite(path, change)
    return f"{stops:+.1f} EV"


def swap_positions(one: Path, two: Path) -> str:
    """Swap the positions of two photos in EXIF and XMP; everything else stays."""
    place = re.compile(rb'drone-dji:(GpsLatitude|GpsLongitude|AbsoluteAltitude)="[^"]*"')
    photos = [Image.open(path) for path in (one, two)]
    exifs, xmps = [photo.getexif() for photo in photos], [photo.info["xmp"] for photo in photos]
    there = [dict(exif.get_ifd(GPS)) for exif in exifs]
    stated = [[match.group(0) for match in place.finditer(xmp)] for xmp in xmps]
    for path, photo, exif, xmp, gps, fields in zip(
        (one, two), photos, exifs, xmps, reversed(there), reversed(stated), strict=True
    ):
        exif.get_ifd(GPS).update(gps)
        fresh = iter(fields)
        photo.load()
        photo.save(path, "JPEG", quality=QUALITY, exif=exif, xmp=place.sub(lambda _, fresh=fresh: next(fresh), xmp))
    return "GPS swapped"


def second_camera(path: Path, generator: np.random.Generator) -> str:
    """Replace a photo by its upscaled centre, as a longer lens on another camera body would see it."""
    zoom = float(generator.uniform(1.3, 1.8))
    with Image.open(path) as photo:
        exif, xmp, size = photo.getexif(), photo.info["xmp"], photo.size
        inset = [side * (1 - 1 / zoom) / 2 for side in size]
        inner = photo.convert("RGB").resize(
            size, Image.Resampling.LANCZOS, (inset[0], inset[1], size[0] - inset[0], size[1] - inset[1])
        )
    lens = exif.get_ifd(EXIF)
    exif[MODEL] = "M3T"
    lens[FOCAL_MM], lens[FOCAL_35] = float(lens[FOCAL_MM]) * zoom, round(int(lens[FOCAL_35]) * zoom)
    xmp = re.sub(rb'drone-dji:CalibratedFocalLength="[^"]*"', b"", xmp)
    inner.save(path, "JPEG", quality=QUALITY, exif=exif, xmp=xmp.replace(b'"M3E"', b'"M3T"'))
    return f"second camera, {zoom:.2f} times as long"


def halve(path: Path) -> str:
    with Image.open(path) as photo:
        small = photo.convert("RGB").resize((photo.width // 2, photo.height // 2), Image.Resampling.LANCZOS)
        small.save(path, "JPEG", quality=QUALITY, exif=photo.info["exif"], xmp=photo.info["xmp"])
    return "half the size"


def put_faults(photos: Path, trial: int) -> list[CaptureFault]:
    """Inject the faults of one trial into a copy of the demo's photos."""
    generator = np.random.default_rng(trial)
    names = sorted(path.name for path in photos.iterdir())
    faults: list[CaptureFault] = []
    if trial % 2 == 0:
        start = int(generator.integers(2, len(names) - 5))
        strip = names[start : start + 3]
        for name in strip:
            (photos / name).unlink()
        faults.append(CaptureFault("strip missing", (names[start - 1], names[start + 3]), "gap|orphan|overlap"))
        left = [name for name in names if name not in names[start - 2 : start + 5]]
        blurred, dark, one, two, cut = (str(name) for name in generator.choice(left, 5, replace=False))
        faults.append(CaptureFault(defocus(photos / blurred, generator), (blurred,), "blur"))
        faults.append(CaptureFault(expose(photos / dark, -1.5), (dark,), "expos|dark"))
        faults.append(CaptureFault(swap_positions(photos / one, photos / two), (one, two), "position"))
        whole = (photos / cut).read_bytes()
        (photos / cut).write_bytes(whole[: int(len(whole) * generator.uniform(0.3, 0.9))])
        faults.append(CaptureFault("truncated", (cut,), "unreadable|truncated|broken"))
    else:
        blurred, light, twin, other, small = (str(name) for name in generator.choice(names, 5, replace=False))
        faults.append(CaptureFault(shake(photos / blurred, generator), (blurred,), "blur"))
        faults.append(CaptureFault(expose(photos / light, 1.5), (light,), "expos|bright"))
        again = f"copy of {twin}"
        shutil.copy(photos / twin, photos / again)
        if trial % 4 == 1:
            rewrite(photos / again, lambda pixels: pixels)
        faults.append(
            CaptureFault("duplicate" + (", saved again" if trial % 4 == 1 else ""), (twin, again), "duplicate")
        )
        faults.append(CaptureFault(second_camera(photos / other, generator), (other,), "camera|focal"))
        faults.append(CaptureFault(halve(photos / small), (small,), "resized|size|camera"))
    return faults


def is_reported(fault: CaptureFault, findings: list[dict[str, object]]) -> bool:
    """Whether a finding of the right kind names one of the fault's photos."""
    for finding in findings:
        if re.search(fault.codes, str(finding["code"])):
            text = json.dumps([finding["photos"], finding["message"]])
            if any(name in text for name in fault.photos):
                return True
    return False


def check(capture: Path) -> dict[str, list[dict[str, object]]]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "check", str(capture), "--json"]
    done = subprocess.run(
        [*command, "-o", str(capture / "check.html")], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=False
    )
    findings: dict[str, list[dict[str, object]]] = json.loads(done.stdout)
    return findings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=16)
    trials = parser.parse_args().trials
    put, found, extra = Counter[str](), Counter[str](), 0
    for trial in range(trials):
        with tempfile.TemporaryDirectory() as folder:
            capture = Path(folder) / "capture"
            shutil.copytree(CAPTURE, capture)
            faults = put_faults(capture / "photos", trial)
            findings = check(capture)["findings"]
        for fault in faults:
            kind = re.sub(r"[ ,]*[-+0-9.]+.*| px", "", fault.kind) or fault.kind
            is_found = is_reported(fault, findings)
            put[kind] += 1
            found[kind] += is_found
            if not is_found:
                print(f"trial {trial}: not found: {fault.kind} ({', '.join(fault.photos)})", flush=True)
        faulty = {name for fault in faults for name in fault.photos}
        for finding in findings:
            others = [name for name in finding["photos"] if Path(str(name)).name not in faulty]  # type: ignore[attr-defined]
            extra += len(others)
            if others:
                print(f"trial {trial}: {finding['code']} of photos without a fault: {', '.join(others)}", flush=True)
        print(f"trial {trial}: {sum(found.values())} of {sum(put.values())} so far", flush=True)
    for kind, count in put.items():
        print(f"{kind:40s} {found[kind]:3d} of {count}")
    print(f"found {sum(found.values())} of {sum(put.values())}; photos named without a fault of theirs: {extra}")


if __name__ == "__main__":
    main()
