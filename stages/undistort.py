"""undistort: resample the photos to pinhole cameras at training resolution, with the matching sparse model."""

from __future__ import annotations

from pathlib import Path

import cv2

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Inputs, Reporter, Summary
from splatpipe.pipeline.photos.colmap.colmap_reconstruction import read_reconstruction
from splatpipe.pipeline.photos.files.photo_list import load_photo_list
from splatpipe.pipeline.photos.options import UndistortConfig
from splatpipe.pipeline.photos.pixels.dataset import MODEL
from splatpipe.pipeline.photos.pixels.resampling import Places
from splatpipe.pipeline.photos.pixels.undistortion import (
    RegisteredPhoto,
    pinhole_model,
    plan_views,
    with_places,
    write_view,
)
from splatpipe.pipeline.sfm.model.sparse_model import write_model


def run(config: UndistortConfig, inputs: Inputs, out: Path, report: Reporter) -> Summary:
    """Write ``dataset/images``, ``masks`` and ``sky_masks`` if there are any, and ``sparse/0`` with PINHOLE cameras.

    Photos keep their names. No EXIF is written: an orientation tag would make other trainers rotate the images.

    Raises:
        SplatpipeError: if the model cannot be read, or its photos are missing.
    """
    model = read_reconstruction(inputs["georef.model"])
    photos = load_photo_list(inputs["ingest.photos"]).photos
    placed = plan_views(model, photos, config.max_megapixels, report)
    dataset = out / "dataset"

    def work(item: tuple[RegisteredPhoto, Places | None]) -> None:
        write_view(*item, inputs, dataset)

    threads_before = cv2.getNumThreads()
    cv2.setNumThreads(1)  # parallelism is over photos
    try:
        for done, _ in enumerate(ordered_map(work, with_places(placed), inputs.machine.threads), start=1):
            report.progress(done, len(placed), "undistorting", "photos")
    finally:
        cv2.setNumThreads(threads_before)
    result = pinhole_model(model, placed)
    write_model(result, dataset / MODEL)
    sizes = sorted({(view.target.width, view.target.height) for view in placed})
    return {
        "photos": len(placed),
        "sizes": [f"{width}x{height}" for width, height in sizes],
        "megapixels": round(sum(view.target.width * view.target.height for view in placed) / 1e6, 3),
        "points3d": result.num_points3D(),
        "masks": sum(view.photo.mask is not None for view in placed),
    }
