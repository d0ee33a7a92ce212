"""flythrough: a film along a smooth path through the real cameras, rendered as in training."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.film.camera_path import cameras_along
from splatpipe.pipeline.film.filming import FilmFile, open_scene, write_film
from splatpipe.pipeline.film.options import FlythroughConfig
from splatpipe.pipeline.film.photo_route import photo_film
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import render_pixels
from splatpipe.pipeline.train.options import FILM_FROM_BUDGET_S


def run(config: FlythroughConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `film/flythrough.webm`; nothing if none is requested or no path can be made through the photos."""
    folder = out / "film"
    folder.mkdir()
    if config.seconds == 0.0:
        return {"frames": 0}
    if 0.0 < inputs.settings["train.time_budget_s"] < FILM_FROM_BUDGET_S:
        report.note(
            f"A time budget below {FILM_FROM_BUDGET_S / 60:.0f} minutes leaves out the film; make one with "
            "splatpipe render."
        )
        return {"frames": 0}
    frames = max(1, round(config.seconds * config.fps))
    with same_bits(inputs.machine.threads):
        scene = open_scene(inputs.parts, inputs.machine.threads, choose_device(inputs.machine.device))
        try:
            route = photo_film(scene.capture, frames, config.seconds)
        except UsageError as error:
            report.warning(f"No film was made: {error.message}", hint="Try: splatpipe render OUT --path orbit")
            return {"frames": 0}
        cameras = cameras_along(route, scene.lens(config.film_size), scene.capture.up)
        file = FilmFile(folder / "flythrough.webm", config.fps)
        write_film(file, cameras, lambda camera: render_pixels(scene.model, camera, scene.options), report)
    return {"frames": frames, "seconds": frames / config.fps, "width": cameras[0].width, "height": cameras[0].height}
