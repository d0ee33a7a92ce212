"""splat_depths: a depth map for every photo, rendered from a flattened copy of the splat."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_maps import save_depth_maps
from splatpipe.pipeline.mvs.rendered_depths import rendered_depth_maps
from splatpipe.pipeline.photos.pixels.dataset import load_views
from splatpipe.pipeline.photos.pixels.images import reduced_camera
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import as_trained, render_depth, render_mean_depth
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.train.blocks.cells.site_plan import is_in_blocks
from splatpipe.pipeline.train.flattening import FLATTENED, TrainedParts, flatten
from splatpipe.pipeline.train.options import SplatDepthsConfig

RenderDepth = Callable[[Gaussians, Camera, RenderOptions], Float[np.ndarray, "h w"]]


def run(config: SplatDepthsConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `maps/`, in the model's frame and in the format of `depths`; empty if not requested.

    Resumes a killed run from a checkpoint of the flattened copy, the finished copy, or the depths rendered so far.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available.
        KeyboardInterrupt: on Ctrl-C or SIGTERM, after a checkpoint.
    """
    maps, rendered = out / "maps", out / "rendered"
    shutil.rmtree(maps, ignore_errors=True)
    if not config.enabled:
        report.progress(1, 1, "not requested", "steps")
        return save_depth_maps(maps, [])
    gaussians, render = _model(inputs, out, report)
    options, _ = as_trained(inputs["train.rendering"], gaussians)
    placed = gaussians.to(choose_device(inputs.machine.device).tensors)
    size, dataset = inputs.settings["depths.max_megapixels"], inputs["undistort.dataset"]
    cameras = [reduced_camera(view.camera, size) for view in load_views(dataset)]
    rendered.mkdir(exist_ok=True)
    with same_bits(inputs.machine.threads):

        def depth_of(camera: Camera) -> Float[np.ndarray, "h w"]:
            return render(placed, camera, options)

        found = rendered_depth_maps(depth_of, dataset, cameras, rendered, inputs.machine.threads, report)
        summary = save_depth_maps(maps, found)
    shutil.rmtree(rendered)
    (out / FLATTENED).unlink(missing_ok=True)
    return {"gaussians": len(gaussians), **summary}


def _model(inputs: Inputs, out: Path, report: Reporter) -> tuple[Gaussians, RenderDepth]:
    """Return the Gaussians that depths are rendered from, and the function that renders them.

    This is the flattened copy, whose mean depths are better than its medians, or the splat itself if it was trained in
    blocks.
    """
    if is_in_blocks(inputs["blocks.plan"]):
        report.note(
            "trained in blocks, which cannot be flattened together: depths are rendered from the splat as it is"
        )
        return read_splat(inputs["clean.model"]), render_depth
    trained = TrainedParts(
        inputs["clean.model"],
        inputs["train.rendering"],
        inputs["train.sky"],
        inputs["train.exposures"],
        inputs["undistort.dataset"],
        inputs["split.views"],
    )
    return flatten(trained, inputs.machine, out, report), render_mean_depth
