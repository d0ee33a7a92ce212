"""Compare the demo's splat with the demo's truth.

    demo_truth OUT --half OUT_HALF --double OUT_DOUBLE --save FOLDER

Depth: the splat's median depth at every pixel that truly shows the house, in the held-out views at training size,
against the true mesh along the same ray. The model's frame is aligned to the true one by the least-squares similarity
of the camera centres. Errors are along the viewing axis, in ground sampling distances: GSD = true depth / focal length
in pixels. A pixel without a median depth counts as wrong. Error images are written to the folder.

Scales: the held-out views at half and double the training size, each against the original photo resampled once to that
size, beside a model trained for it: the same command with a quarter and four times `undistort.max_megapixels`, and the
same seed. Photos too small for double are used at full size.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from jaxtyping import Bool, Float64
from measure import SilentReporter
from opened_run import OpenedRun, open_run, write_png
from tables import Row, print_table

from splatpipe.demo.site.scene import building_corners
from splatpipe.demo.truth.truth import centre, depth_map, true_poses, true_surface, truth_from_model
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.photo_list import decode, load_photo_list
from splatpipe.pipeline.photos.pixels.images import Pixels
from splatpipe.pipeline.photos.pixels.resampling import resample
from splatpipe.pipeline.photos.pixels.undistortion import plan_views
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.view_measures import flat_stems, mean_measures, measure

WITHIN_GSD = 2.0
ATTACHED_M = 0.05  # in front of the house: the survey targets on its walls, including oblique views of them
FULL_SCALE_GSD = 4.0  # error with the brightest colour, the same in every image
NOT_THE_HOUSE = 0.35  # how much brightness the rest of the image keeps
MAX_MEGAPIXELS = 1e6  # no limit
SIZES = {"half": 0.5, "training": 1.0, "double": 2.0}

DEPTH_COLUMNS = {
    "view": "view:",
    "pixels": "pixels:,",
    "within 2 GSD": "within:.3f",
    "without depth": "without:.3f",
    "p50 GSD": "p50:.2f",
    "p80": "p80:.2f",
    "p95": "p95:.2f",
    "signed p50": "signed:.2f",
    "GSD cm": "gsd_cm:.1f",
}
SCALE_COLUMNS = {
    "size": "size:",
    "factor": "factor:.2f",
    "pixels": "pixels:",
    "PSNR": "psnr:.2f",
    "psnr_cc": "psnr_cc:.2f",
    "SSIM": "ssim:.3f",
    "trained for it: pixels": "other_pixels:",
    "its PSNR": "other_psnr:.2f",
    "its psnr_cc": "other_psnr_cc:.2f",
    "its SSIM": "other_ssim:.3f",
    "below it dB": "below:.2f",
}


def depth_errors(
    run: OpenedRun, camera: Camera, truth: Similarity, surfaces: tuple[np.ndarray, np.ndarray]
) -> tuple[Float64[np.ndarray, "h w"], Bool[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Return the splat's depth errors against the truth.

    Args:
        run: The demo's run.
        camera: Camera in the model's frame, at the size to measure at.
        truth: Similarity from the model's frame to the true one.
        surfaces: Triangles of the whole scene, and of the house.

    Returns:
        Errors in GSD, positive where the splat is farther, infinite where it has no depth; a mask of the pixels that
        truly show the house, the only ones that count; the GSD in metres.
    """
    there = replace(camera, cam_from_world=truth.camera_pose(camera.cam_from_world))
    true, house = (depth_map(there, triangles) for triangles in surfaces)
    seen = np.isfinite(house) & (house <= np.where(np.isfinite(true), true, 0.0) + ATTACHED_M)
    true = np.where(seen, true, 1.0)
    found = run.median_depth(camera).astype(np.float64) * truth.scale
    gsd = true / math.sqrt(camera.fx * camera.fy)
    return np.where(found > 0.0, (found - true) / gsd, np.inf), seen, gsd


def depth_row(name: str, errors: Float64[np.ndarray, " n"], gsd: Float64[np.ndarray, " n"]) -> Row:
    """Return the figures over the pixels that count; a pixel without a depth is an infinite error."""
    row: Row = {"view": name, "pixels": int(errors.size)}
    if errors.size == 0:
        return row
    size = np.abs(errors)
    finite = np.isfinite(errors)
    row |= {"within": float((size <= WITHIN_GSD).mean()), "without": float((~finite).mean())}
    for share in (50, 80, 95):
        value = float(np.quantile(size, share / 100.0, method="higher"))
        row[f"p{share}"] = value if math.isfinite(value) else None
    row["signed"] = float(np.median(errors[finite])) if finite.any() else None
    return row | {"gsd_cm": 100.0 * float(np.median(gsd))}


def measure_depth(run: OpenedRun, names: Sequence[str], folder: Path) -> list[Row]:
    """Return a row per view, and one over all pixels; write an error image of each view."""
    poses = {view.camera.name: view.camera.cam_from_world for view in run.views}
    truth = truth_from_model(poses)
    true = true_poses()
    apart = [truth.apply(centre(pose)[None])[0] - centre(true[name]) for name, pose in poses.items()]
    rms = float(np.sqrt(np.square(apart).sum(axis=1).mean()))
    print(f"{len(poses)} cameras, {100.0 * rms:.2f} cm from their true places (RMS)")
    surfaces = true_surface(), building_corners()
    rows, all_errors, all_gsd = [], [], []
    for view, stem in zip(run.views, flat_stems(list(poses)), strict=True):
        if view.camera.name not in names:
            continue
        camera = run.camera(view)
        errors, seen, gsd = depth_errors(run, camera, truth, surfaces)
        rows.append(depth_row(view.camera.name, errors[seen], gsd[seen]))
        all_errors.append(errors[seen])
        all_gsd.append(gsd[seen])
        write_png(folder / f"{stem}.depth.png", error_picture(run.picture(camera), errors, seen))
    return [*rows, depth_row("all", np.concatenate(all_errors), np.concatenate(all_gsd))]


def error_picture(render: Pixels, errors: Float64[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]) -> Pixels:
    """Return the render beside the error magnitudes on the house; (h, 2 w, 3) RGB."""
    scaled = np.clip(np.abs(errors) / FULL_SCALE_GSD, 0.0, 1.0) * 255.0
    heat = cv2.applyColorMap(scaled.astype(np.uint8), cv2.COLORMAP_INFERNO)[:, :, ::-1]
    dim = (NOT_THE_HOUSE * render).astype(np.uint8)
    return np.hstack([render, np.where(seen[:, :, None], heat, dim)])


def photos_at(run: OpenedRun, names: Sequence[str], factor: float) -> dict[str, tuple[Camera, Pixels]]:
    """Return original photos undistorted to pinhole cameras, as `undistort` does it, and these cameras.

    Args:
        run: Run with the photos.
        names: Names of the photos.
        factor: Times the training size; less if the photos are too small.
    """
    part = run.parts["ingest.photos"].path
    model, photos = pycolmap.Reconstruction(run.parts["georef.model"].path), load_photo_list(part).photos
    cameras = {view.camera.name: run.camera(view) for view in run.views}
    full = plan_views(model, photos, MAX_MEGAPIXELS, SilentReporter())[0]
    trained, whole = cameras[full.photo.name], full.target
    scale = factor * max(trained.width / whole.width, trained.height / whole.height) + 1e-9  # sizes are rounded down
    placed = plan_views(model, photos, scale**2 * 1e-6 * whole.width * whole.height, SilentReporter())
    return {
        view.photo.name: (
            cameras[view.photo.name].scaled(view.target.width, view.target.height),
            resample(decode(view.photo, part, run.photos_dir), view.source, view.target),
        )
        for view in placed
        if view.photo.name in names
    }


def measure_scales(run: OpenedRun, others: dict[str, OpenedRun], names: Sequence[str], folder: Path) -> list[Row]:
    """Return a row per size: the model's figures, and those of the one trained for that size, on the same images."""
    trained = run.camera(next(view for view in run.views if view.camera.name in names))
    rows = []
    for size, factor in SIZES.items():
        views = photos_at(run, names, factor)
        camera = views[trained.name][0]
        row: Row = {"size": size, "factor": math.sqrt(camera.width * camera.height / (trained.width * trained.height))}
        row |= {"pixels": f"{camera.width}x{camera.height}"} | mean_measures(
            [_measured(run, *v) for v in views.values()]
        )
        pictures = [views[trained.name][1], run.picture(camera)]
        if size in others:
            other = others[size]
            figures = mean_measures([_measured(other, *view) for view in views.values()])
            row |= {f"other_{key}": value for key, value in figures.items()}
            own = other.camera(next(view for view in other.views if view.camera.name == trained.name))
            row |= {"other_pixels": f"{own.width}x{own.height}", "below": row["other_psnr"] - row["psnr"]}
            pictures.append(other.picture(camera))
        write_png(folder / f"{Path(trained.name).stem}.{size}.png", np.hstack(pictures))
        rows.append(row)
    return rows


def _measured(run: OpenedRun, camera: Camera, photo: Pixels) -> dict[str, float | None]:
    return measure(run.picture(camera), photo, None)


def same_frame(run: OpenedRun, other: OpenedRun) -> OpenedRun:
    """Return the other run, if its cameras are those of the first.

    Raises:
        UsageError: if they are not.
    """
    if other.parts["georef.model"].digest != run.parts["georef.model"].digest:
        raise UsageError(
            f"The cameras of {other.out} are not those of {run.out}.",
            hint="Run it on the same photos with the same seed and the same options of all stages before undistort.",
        )
    return other


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("out", type=Path, help="OUT of a run on the demo capture")
    options.add_argument("--half", type=Path, help="OUT of the run that was trained at half the size")
    options.add_argument("--double", type=Path, help="OUT of the run that was trained at double the size")
    options.add_argument("--all", action="store_true", help="also views that were trained on")
    options.add_argument("--save", type=Path, default=Path("out/demo_truth"), help="folder for pictures and figures")
    options.add_argument("--threads", type=int, default=1)
    arguments = options.parse_args()
    try:
        run = open_run(arguments.out)
        paths = {size: path for size in ("half", "double") if (path := getattr(arguments, size)) is not None}
        others = {size: same_frame(run, open_run(path)) for size, path in paths.items()}
        every = [view.camera.name for view in run.views]
        names = every if arguments.all else run.held_out
        if not names or not set(every) <= true_poses().keys():
            raise UsageError(f"{arguments.out} is no run of the demo capture with photos held out.")
        arguments.save.mkdir(parents=True, exist_ok=True)
        with same_bits(arguments.threads):
            depth = measure_depth(run, names, arguments.save)
            scales = measure_scales(run, others, names, arguments.save)
    except SplatpipeError as error:
        options.exit(error.exit_code, f"{error.message} {error.hint}\n")
    print_table("median depth on the house", depth, DEPTH_COLUMNS)
    print_table("scales", scales, SCALE_COLUMNS)
    text = json.dumps({"depth": depth, "scales": scales}, indent=1)
    (arguments.save / "demo_truth.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
