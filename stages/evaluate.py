"""evaluate: render and measure the held-out views (stored as 8-bit PNG), floaters and the splat's accuracy."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.plan_area import read_model_area
from splatpipe.pipeline.photos.pixels.dataset import load_split, load_views
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels, reduced_camera, reduced_view
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.floater_metric import measure_floaters
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS, EvaluateConfig
from splatpipe.pipeline.render.rendering import as_trained, placed, render_depth, render_pixels
from splatpipe.pipeline.render.splat_accuracy import measure_accuracy
from splatpipe.pipeline.render.view_measures import (
    evaluate_view,
    flat_stems,
    judged_views,
    mean_measures,
    mean_megapixels,
    shows_inside,
)
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.sky.panorama import read_panorama

Pictures = tuple[tuple[Camera, Pixels, Mask | None], Pixels, Path, Mask | None]  # view, render, stem, inside mask

PARALLEL_VIEWS = 4  # views, each with 0.3 GB of images in double precision


def run(config: EvaluateConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `metrics.json` and `views/`: photo, render, error image and mask of every judged held-out view.

    All are at `JUDGED_MEGAPIXELS`, or at the dataset's size if that is smaller, whatever the training size. With a
    boundary, figures cover only the inside: pixels by the model's own depth, points by their position. Images keep the
    stored pixel grid, not rotated by the EXIF orientation, so that all figures can be recomputed from them.
    """
    views = load_views(inputs["undistort.dataset"])
    held_out = load_split(inputs["split.views"]).held_out
    judged = set(judged_views(held_out, config.most_views))
    chosen = [view for view in views if view.camera.name in judged]
    gaussians = read_splat(inputs["clean.model"])
    options, _ = as_trained(inputs["train.rendering"], gaussians)
    device = choose_device(inputs.machine.device)
    gaussians, sky = placed((gaussians, read_panorama(inputs["train.sky"])), device)
    area = read_model_area(inputs.parts.get("georef.boundary"))
    folder = out / "views"
    folder.mkdir(parents=True, exist_ok=True)
    if not chosen:
        report.warning(
            "No photo was held out, so image quality is not measured; floaters are measured in training photos.",
            hint="Set split.every or split.views to hold some out.",
        )

    def pictures() -> Iterator[Pictures]:
        stems = flat_stems([view.camera.name for view in chosen])
        for view, stem in zip(chosen, stems, strict=True):
            reduced = reduced_view(view, JUDGED_MEGAPIXELS)
            render, inside = render_pixels((gaussians, sky), reduced[0], options), None
            if area is not None:
                inside = shows_inside(area, reduced[0], render_depth(gaussians, reduced[0], options))
            yield reduced, render, folder / stem, inside

    per_view: list[dict[str, Any]] = []
    cameras = [reduced_camera(view.camera, JUDGED_MEGAPIXELS) for view in views]
    with same_bits(inputs.machine.threads):
        for found in ordered_map(_measure, pictures(), min(inputs.machine.threads, PARALLEL_VIEWS)):
            per_view.append(found)
            report.progress(len(per_view), len(chosen), "measuring held-out photos", "photos")
        floaters = measure_floaters(gaussians, cameras, judged, inputs["undistort.dataset"], options, area)
        accuracy = measure_accuracy(inputs.parts, cameras, held_out, partial(render_depth, gaussians, options=options))
    means = mean_measures(per_view)
    counts: dict[str, Any] = {"test_views": len(per_view), "held_out_views": len(held_out)}
    size = {"judged_megapixels": mean_megapixels(per_view)}
    result: dict[str, Any] = {**counts, **size, "mean": means, "floaters": floaters, "accuracy": accuracy}
    if area is not None:
        result["whole"] = mean_measures([view["whole"] for view in per_view])
    result["per_view"] = per_view
    write_json(out / "metrics.json", result)
    summary = counts | {name: means[name] for name in ("psnr", "psnr_cc", "ssim")} | size
    if area is not None:
        summary["whole_psnr"] = result["whole"]["psnr"]
    return summary | {"veil": floaters["veil"]["mean"], "device": device.name}


def _measure(pictures: Pictures) -> dict[str, Any]:
    return evaluate_view(*pictures)
