"""clean: remove floaters, haze and Gaussians that no photo shows; the result is evaluated and delivered."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from torch import Tensor

from splatpipe.pipeline.edit.floaters.cleaning import CleaningResult, clean_scene, removals_in_words
from splatpipe.pipeline.edit.floaters.visibility import TrainingPhotos
from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS, CleanConfig
from splatpipe.pipeline.engine.files.json_file import write_json
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.pixels.covering import covering_photos
from splatpipe.pipeline.photos.pixels.dataset import load_points_and_tracks, load_split, load_views
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels, reduced_camera, reduced_view
from splatpipe.pipeline.raster.device import choose_device
from splatpipe.pipeline.raster.threads import same_bits
from splatpipe.pipeline.render.rendering import as_trained
from splatpipe.pipeline.splat.containers.archives import open_archive
from splatpipe.pipeline.splat.containers.ply import read_splat, read_splat_header, write_splat_parts
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.sky.panorama import read_panorama

FEW_PHOTOS = 12  # up to this many, floaters are compared with all, of more, with some: most photos show a floater


def run(config: CleanConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write `model.ply` (a copy of the trained model if cleaning is switched off) and `cleaned.json`.

    Raises:
        SplatpipeError: if a file is missing or broken.
        MachineError: if the requested device is not available.
    """
    trained, model = inputs["train.model"], out / "model.ply"
    if not config.enabled:
        report.progress(1, 1, "cleaning is switched off", "steps")
        shutil.copyfile(trained, model)
        write_json(out / "cleaned.json", {"removed": {}})
        return {"removed": 0}
    gaussians = read_splat(trained)
    device = choose_device(inputs.machine.device)
    with same_bits(inputs.machine.threads), tempfile.TemporaryDirectory(prefix="photos-", dir=out) as folder:
        cleaned = _clean(config, gaussians.to(device.tensors), inputs, Path(folder), report)
    removed = sum(cleaned.removed.values())
    if removed:
        kept = (piece.select(keep) for piece, keep in _pieces(gaussians, cleaned.keep))
        count, comments = len(gaussians) - removed, read_splat_header(trained).comments
        write_splat_parts(model, kept, count, gaussians.sh_degree, comments)
        report.note(removals_in_words(cleaned))
    else:
        shutil.copyfile(trained, model)
    write_json(out / "cleaned.json", {"gaussians": len(gaussians), "removed": cleaned.removed})
    return {
        "gaussians": len(gaussians) - removed,
        "removed": removed,
        "reasons": cleaned.removed,
        "device": device.name,
    }


def _clean(config: CleanConfig, gaussians: Gaussians, inputs: Inputs, folder: Path, report: Reporter) -> CleaningResult:
    """Clean by the training photos only: the held-out ones must stay independent for evaluation.

    Every photo is looked at several times; it is decoded once, and reduced it is kept in the folder.
    """
    held_out = set(load_split(inputs["split.views"]).held_out)
    views = [view for view in load_views(inputs["undistort.dataset"]) if view.camera.name not in held_out]
    options, _ = as_trained(inputs["train.rendering"], gaussians)
    sky = read_panorama(inputs["train.sky"])

    def picture(index: int) -> tuple[Pixels, Mask | None]:
        path = folder / f"{index}.npz"
        if not path.exists():
            _, photo, mask = reduced_view(views[index], SEEN_MEGAPIXELS)
            np.savez(path, photo=photo, masks=np.zeros((0, *photo.shape[:2]), np.bool_) if mask is None else mask[None])
            return photo, mask
        with open_archive(path) as arrays:
            masks = arrays["masks"]
            return arrays["photo"], masks[0] if len(masks) else None

    compared = None
    if config.photos == "covering":
        points, seen = load_points_and_tracks(inputs["undistort.dataset"])
        compared = covering_photos([seen[view.camera.name] for view in views], len(points.xyz), FEW_PHOTOS)
    photos = TrainingPhotos(
        [reduced_camera(view.camera, SEEN_MEGAPIXELS) for view in views],
        options,
        picture,
        None if sky is None else sky.to(gaussians.means.device),
        compared,
    )

    def progress(done: int, total: int) -> None:
        report.progress(done, total, "looking for floaters", "photos")

    return clean_scene(gaussians, photos, progress)


def _pieces(gaussians: Gaussians, keep: Bool[Tensor, " n"]) -> Iterator[tuple[Gaussians, Bool[Tensor, " m"]]]:
    start = 0
    for piece in gaussians.pieces():
        yield piece, keep[start : start + len(piece)]
        start += len(piece)
