"""evaluate: the held-out photos, rendered and measured (what is, is kept as 8-bit PNG), what floats, what is where."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.json_file import write_json
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.plan_area import read_model_area
from splatpipe.pipeline.photos.dataset import load_split, load_views
from splatpipe.pipeline.photos.images import reduced_camera, reduced_view
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.floaters import measure_floaters
from splatpipe.pipeline.render.options import EvaluateConfig
from splatpipe.pipeline.render.rendering import as_trained, placed, render_depth, render_pixels
from splatpipe.pipeline.render.splat_accuracy import measure_accuracy
from splatpipe.pipeline.render.view_measures import evaluate_view, flat_stems, mean_measures, shows_inside
from splatpipe.pipeline.splat.panorama import read_panorama
from splatpipe.pipeline.splat.ply import read_splat


def run(_config: EvaluateConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `metrics.json` and `views/`: photo, render, error and mask of every held-out view.

    With a boundary, figures are those of what lies inside: pixels by the model's own depth, points by their place.
    The pictures stay in the stored grid, not turned by EXIF's orientation: every figure comes out of them again.
    """
    views = load_views(inputs["undistort.dataset"])
    held_out = load_split(inputs["split.views"]).held_out
    chosen = [view for view in views if view.camera.name in set(held_out)]
    gaussians = read_splat(inputs["train.model"])
    options, megapixels = as_trained(inputs["train.rendering"], gaussians)
    device = choose_device(inputs.machine.device)
    gaussians, sky = placed((gaussians, read_panorama(inputs["train.sky"])), device)
    area = read_model_area(inputs.parts.get("georef.boundary"))
    folder = out / "views"
    folder.mkdir(parents=True, exist_ok=True)
    if not chosen:
        report.warning(
            "No photo was held out, so no likeness is measured; floaters are looked for in training photos.",
            hint="Set split.every or split.views to hold some out.",
        )
    stems = flat_stems([view.camera.name for view in chosen])
    per_view = []
    for done, (view, stem) in enumerate(zip(chosen, stems, strict=True), start=1):
        reduced = reduced_view(view, megapixels)
        inside = None
        with same_bits(inputs.machine.threads):
            render = render_pixels((gaussians, sky), reduced[0], options)
            if area is not None:
                inside = shows_inside(area, reduced[0], render_depth(gaussians, reduced[0], options))
        per_view.append(evaluate_view(reduced, render, folder / stem, inside))
        report.progress(done, len(chosen), "measuring held-out photos", "photos")
    means = mean_measures(per_view)
    cameras = [reduced_camera(view.camera, megapixels) for view in views]
    with same_bits(inputs.machine.threads):
        floaters = measure_floaters(gaussians, cameras, set(held_out), inputs["undistort.dataset"], options, area)
        accuracy = measure_accuracy(inputs.parts, cameras, held_out, partial(render_depth, gaussians, options=options))
    result: dict[str, Any] = {"test_views": len(per_view), "mean": means, "floaters": floaters, "accuracy": accuracy}
    if area is not None:
        result["whole"] = mean_measures([view["whole"] for view in per_view])
    result["per_view"] = per_view
    write_json(out / "metrics.json", result)
    summary: dict[str, Any] = {"test_views": len(per_view)}
    summary |= {name: means[name] for name in ("psnr", "psnr_cc", "ssim")}
    if area is not None:
        summary["whole_psnr"] = result["whole"]["psnr"]
    return summary | {"veil": floaters["veil"]["mean"], "device": device.name}
