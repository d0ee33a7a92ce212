"""Measure how much of the photos' texture a splat of the demo has: ``texture_contrast OUT [OUT …] --megapixels 4``.

On the house's bricks, tiles and slates, located by the true surface in the held-out views, bands of the luminance
(between Gaussian blurs of the photo's pixels) are compared in render and photo: the ratio of their standard deviations,
which is the perceived contrast, and the part of the photo's texture that the render reproduces in place (the slope of
render on photo), which noise and invented texture do not raise. Edges of a surface are excluded.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float32
from opened_run import OpenedRun, open_run, write_png
from tables import Row, print_table

from splatpipe.demo.site.house import BRICK, SLATE, TILES
from splatpipe.demo.site.scene import building_corners
from splatpipe.demo.truth.truth import depth_map, true_surface, truth_from_model
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Pixels, reduced_view
from splatpipe.pipeline.raster.threads import same_bits

TEXTURES = {"bricks": BRICK, "tiles": TILES, "slates": SLATE}
BANDS = {"1-2 px": (0.5, 1.0), "2-4 px": (1.0, 2.0), "4-8 px": (2.0, 4.0), "all": (0.0, 4.0)}
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
EDGE_PX = 6  # from the border of a surface: blurs reach across it
MIN_PIXELS = 500  # fewest pixels of a texture in a view that is judged
SAME_DEPTH = 1e-4  # relative: a few millimetres, less than targets stand out from walls
COLUMNS = {"run": "run:", "texture": "texture:", "pixels": "pixels:,"} | {
    f"{band} {what}": f"{band} {what}:.2f" for band in BANDS for what in ("contrast", "slope")
}


def band(picture: Pixels, low: float, high: float) -> Float32[np.ndarray, "h w"]:
    """Return the luminance between two blurs, in 8-bit steps.

    Args:
        picture: Image, RGB.
        low: Sigma of the blur that is kept, pixels; 0 for none.
        high: Sigma of the blur that is subtracted.
    """
    light = picture.astype(np.float32) @ LUMA
    fine = cv2.GaussianBlur(light, (0, 0), low) if low else light
    return np.asarray(fine - cv2.GaussianBlur(light, (0, 0), high), np.float32)


def textured(camera: Camera) -> dict[str, Bool[np.ndarray, "h w"]]:
    """Return where a camera in the true frame sees each texture, borders excluded."""
    first = depth_map(camera, true_surface())
    found = {}
    for name, paint in TEXTURES.items():
        own = depth_map(camera, building_corners(paint))
        with np.errstate(invalid="ignore"):
            seen = np.isfinite(own) & (own <= first * (1.0 + SAME_DEPTH))
        kernel = np.ones((2 * EDGE_PX + 1, 2 * EDGE_PX + 1), np.uint8)
        found[name] = cv2.erode(seen.astype(np.uint8), kernel).astype(bool)
    return found


def measure(run: OpenedRun, megapixels: float, save: Path | None) -> list[Row]:
    """Return a row per texture, over all held-out views."""
    truth = truth_from_model({view.camera.name: view.camera.cam_from_world for view in run.views})
    samples: dict[str, list[tuple[Pixels, Pixels, Bool[np.ndarray, "h w"]]]] = {name: [] for name in TEXTURES}
    for view in run.views:
        if view.camera.name not in run.held_out:
            continue
        camera, photo, _mask = reduced_view(view, megapixels)
        render = run.picture(camera)
        true = replace(camera, cam_from_world=truth.camera_pose(camera.cam_from_world))
        for name, mask in textured(true).items():
            samples[name].append((photo, render, mask))
        if save:
            write_png(save / f"{run.out.name}.{Path(camera.name).stem}.png", np.hstack([photo, render]))
    return [{"run": run.out.name, "texture": name} | figures(found) for name, found in samples.items()]


def figures(samples: list[tuple[Pixels, Pixels, Bool[np.ndarray, "h w"]]]) -> Row:
    """Return contrast and slope of each band, over the pixels of all views with enough of the texture."""
    samples = [sample for sample in samples if sample[2].sum() >= MIN_PIXELS]
    row: Row = {"pixels": int(sum(mask.sum() for _, _, mask in samples))}
    for name, (low, high) in BANDS.items() if samples else ():
        x, y = (np.concatenate([_centred(band(s[k], low, high)[s[2]]) for s in samples]) for k in (0, 1))
        row[f"{name} contrast"] = float(y.std() / x.std())
        row[f"{name} slope"] = float((x * y).mean() / (x * x).mean())
    return row


def _centred(values: Float32[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    return np.asarray(values - values.mean(), np.float32)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, nargs="+", help="OUT of a run on the demo capture")
    options.add_argument("--megapixels", type=float, default=4.0, help="size of the pictures that are compared")
    options.add_argument("--save", type=Path, help="folder for pictures: photo beside render")
    options.add_argument("--json", type=Path)
    options.add_argument("--threads", type=int, default=1)
    arguments = options.parse_args()
    if arguments.save:
        arguments.save.mkdir(parents=True, exist_ok=True)
    with same_bits(arguments.threads):
        rows = [row for out in arguments.out for row in measure(open_run(out), arguments.megapixels, arguments.save)]
    print_table(f"texture at {arguments.megapixels:g} MP", rows, COLUMNS)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
