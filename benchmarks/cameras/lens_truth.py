"""Compare the demo through a Brown lens like the DJI P1's with its truth: ``lens_truth FOLDER [--preset preview]``.

The demo's photos, taken through a simple lens, are resampled into the Brown lens: each pixel's ray is looked up in the
photo with a Lanczos filter, and the marks of control and check points are transformed likewise. The lens has the field
of view that the photos cover. For comparison they are also resampled into a simple lens of that field of view; both run
through the pipeline as far as ``georef``, with 12 of the 18 points as control.

Lenses are compared by where they project the rays of a grid over the image: as they are, and after the small rotation
of all rays that aligns them best, which the poses absorb (a wrong principal point turns every camera a little).
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image
from tables import Row, print_table

from splatpipe.demo import CAPTURE
from splatpipe.demo.photography.cameras import BrownLens, brown_lens
from splatpipe.pipeline.sfm.lenses.lens_model import apart_px, simplest

BORDER_PX = 8.0  # marks nearer to the edge are dropped
QUALITY = 95
FOCAL_TEXT = b'CalibratedFocalLength="853.000000"'
WIDENED = 1.002  # the manufacturer's calibration is off by as much as in the demo
COLUMNS = {
    "lens": "lens:",
    "photos": "photos:",
    "points": "points:,",
    "error px": "error:.3f",
    "model": "model:",
    "freed": "freed:",
    "focal": "focal:.1f",
    "true": "true_focal:.1f",
    "off px RMS": "plain:.3f",
    "turned": "turned:.3f",
    "worst": "worst:.2f",
    "best simple": "simple:.2f",
    "check GSD h": "horizontal:.3f",
    "up": "up:.3f",
}


def camera_of(lens: BrownLens) -> pycolmap.Camera:
    """COLMAP's camera."""
    return pycolmap.Camera(camera_id=1, **lens.colmap())


def covered(lens: BrownLens, source: BrownLens) -> BrownLens:
    """Return the lens with the shortest focal length whose image is fully covered by the source's."""
    x, y = np.meshgrid(np.linspace(0.0, lens.width, 61), np.linspace(0.0, lens.height, 46))
    for focal in np.arange(source.f, 1.5 * source.f, 1.0):
        tried = replace(lens, f=float(focal))
        rays = tried.undistort((x.ravel() - tried.cx) / tried.f, (y.ravel() - tried.cy) / tried.f)
        seen = source.project(np.stack([*rays, np.ones(x.size)], axis=1))
        if (seen >= 0.0).all() and (seen <= [source.width, source.height]).all():
            return tried
    raise ValueError("no focal length is covered")


def make_capture(folder: Path, lens: BrownLens, source: BrownLens) -> None:
    """Write the demo's photos and ``gcp_list.txt`` as seen through the lens."""
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    rays = lens.undistort((x.ravel() - lens.cx) / lens.f, (y.ravel() - lens.cy) / lens.f)
    seen = source.project(np.stack([*rays, np.ones(x.size)], axis=1)).reshape(lens.height, lens.width, 2) - 0.5
    maps = cv2.convertMaps(seen[..., 0].astype(np.float32), seen[..., 1].astype(np.float32), cv2.CV_32FC1)
    calibrated = f'CalibratedFocalLength="{lens.f * WIDENED:.6f}"'.encode()
    for path in sorted((CAPTURE / "photos").glob("*.JPG")):
        photo = np.asarray(Image.open(path))
        distorted = cv2.remap(photo, *maps, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101)
        buffer = io.BytesIO()
        Image.fromarray(distorted).save(buffer, "JPEG", quality=QUALITY, subsampling=0)
        whole = path.read_bytes()
        assert whole.count(FOCAL_TEXT) == 1 and len(calibrated) == len(FOCAL_TEXT)
        metadata = b"".join(_metadata(whole)).replace(FOCAL_TEXT, calibrated)
        (folder / "photos" / path.name).write_bytes(buffer.getvalue()[:2] + metadata + buffer.getvalue()[2:])
    lines = (CAPTURE / "gcp_list.txt").read_text(encoding="utf-8").splitlines()
    moved = [lines[0]]
    for line in lines[1:]:
        fields = line.split()
        at = (np.array([fields[3:5]], np.float64) - [source.cx, source.cy]) / source.f
        ray = source.undistort(at[:, 0], at[:, 1])
        pixel = lens.project(np.stack([*ray, np.ones(1)], axis=1))[0]
        if (pixel > BORDER_PX).all() and (pixel < [lens.width - BORDER_PX, lens.height - BORDER_PX]).all():
            moved.append(" ".join([*fields[:3], f"{pixel[0]:.2f}", f"{pixel[1]:.2f}", *fields[5:]]))
    (folder / "gcp_list.txt").write_text("\n".join(moved) + "\n", encoding="utf-8")


def _metadata(jpeg: bytes) -> list[bytes]:
    """Return the APP1 segments of a JPEG."""
    found, at = [], 2
    while jpeg[at] == 0xFF and jpeg[at + 1] != 0xDA:
        size = int.from_bytes(jpeg[at + 2 : at + 4], "big")
        if jpeg[at + 1] == 0xE1:
            found.append(jpeg[at : at + 2 + size])
        at += 2 + size
    return found


def measure(name: str, out: Path, lens: BrownLens) -> Row:
    """Compare the lens estimated by the pipeline with the true one."""
    parts = {stage: next((out / "stages").glob(f"{stage}-*")) for stage in ("sparse", "georef")}
    models = json.loads((parts["sparse"] / "models.json").read_text(encoding="utf-8"))
    accuracy = json.loads((parts["georef"] / "accuracy.json").read_text(encoding="utf-8"))
    found, true = pycolmap.Reconstruction(parts["georef"] / "sparse" / "0").cameras[1], camera_of(lens)
    model, params = simplest(true)
    near = pycolmap.Camera(camera_id=1, model=model, width=lens.width, height=lens.height, params=list(params))
    plain, turned = apart_px(found, true), apart_px(found, true, turn=True)
    check, gsd = accuracy["tables"]["check"], accuracy["gsd_m"]
    return {
        "lens": name,
        "photos": models["registered"],
        "points": models["points3d"],
        "error": models["mean_reprojection_error_px"],
        "model": found.model_name,
        "freed": ", ".join(models["lenses"][0]["freed"]) if models["lenses"] else "",
        "focal": found.mean_focal_length(),
        "true_focal": lens.f,
        "plain": float(np.sqrt(np.mean(plain**2))),
        "turned": float(np.sqrt(np.mean(turned**2))),
        "worst": float(turned.max()),
        "simple": float(np.sqrt(np.mean(apart_px(near, true, turn=True) ** 2))),
        "horizontal": check["rmse_horizontal_m"] / gsd,
        "up": check["rmse_up_m"] / gsd,
    }


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("folder", type=Path, help="for the captures and their runs")
    options.add_argument("--preset", default="preview")
    options.add_argument("--set", action="append", default=[], help="options of the runs")
    options.add_argument("--only", choices=["demo", "simple", "brown"], action="append")
    arguments = options.parse_args()
    source = BrownLens()
    brown = covered(brown_lens(), source)
    lenses = {"demo": source, "simple": replace(source, f=brown.f), "brown": brown}
    rows = []
    for name in arguments.only or list(lenses):
        capture, out = arguments.folder / name, arguments.folder / f"{name}-{arguments.preset}"
        if name == "demo":
            capture = CAPTURE
        elif not (capture / "gcp_list.txt").exists():
            make_capture(capture, lenses[name], source)
        command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", "run", str(capture / "photos"), str(out)]
        command += ["--preset", arguments.preset, "--until", "georef", "--threads", "1"]
        command += [word for each in arguments.set for word in ("--set", each)]
        subprocess.run(command, check=True, stdout=sys.stderr)
        rows.append(measure(name, out, lenses[name]))
    print_table("the demo through three lenses", rows, COLUMNS)


if __name__ == "__main__":
    main()
