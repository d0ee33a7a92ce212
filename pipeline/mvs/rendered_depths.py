"""Depth maps rendered from a model at the photos' cameras, kept where other photos' maps confirm them.

A model has one surface, but a photo may see it through haze that was fitted to another photo, or see the far side of a
hole. As with depths estimated from photos, only depths that enough others confirm are kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_maps import MAX_CONFIRMING, DepthMap, confirmed_maps
from splatpipe.pipeline.mvs.depth_search import ConfirmedDepths, Inverse, agreement_of
from splatpipe.pipeline.mvs.neighbours import load_tracks, neighbours
from splatpipe.pipeline.mvs.patch_match import DepthEstimate


def rendered_depth_maps(
    depth_of: Callable[[Camera], Float[np.ndarray, "h w"]],
    dataset: Path,
    cameras: Sequence[Camera],
    folder: Path,
    threads: int,
    report: Reporter,
) -> Iterator[tuple[Camera, DepthMap]]:
    """Render the depth maps of photos from a model; identical for any number of threads.

    Args:
        depth_of: Renders a camera's depths along its z, world units; 0 where the model has none.
        dataset: The folder that `undistort` wrote; its sparse points define each photo's neighbours.
        cameras: Cameras at the maps' resolution.
        folder: Folder for temporary files, with room for 4 bytes per pixel of all maps; a killed run resumes from it.
        threads: Photos compared in parallel.
        report: Receives progress.

    Yields:
        Each camera and its depth map, in order.

    Raises:
        StageError: if the sparse model cannot be read.
    """
    for number, camera in enumerate(cameras):
        _render_to_file(folder / f"{number}.npy", partial(depth_of, camera))
        report.progress(number + 1, len(cameras), "rendering depths", "photos")
    tracks = load_tracks(dataset, [camera.name for camera in cameras])
    near = neighbours(tracks, cameras, MAX_CONFIRMING)

    def agreement(number: int) -> ConfirmedDepths | None:
        inverse = _load_inverse(folder, number)
        own = DepthEstimate(inverse, np.zeros_like(inverse))
        return agreement_of(number, cameras, near[number], (own, partial(_load_inverse, folder)))

    yield from confirmed_maps(cameras, agreement, threads, report)


def _render_to_file(path: Path, render: Callable[[], Float[np.ndarray, "h w"]]) -> None:
    """Render inverse depths into a file that is complete or absent; an existing file is left alone."""
    if path.is_file():
        return
    depth = render()
    there = np.isfinite(depth) & (depth > 0.0)
    inverse = np.where(there, 1.0 / np.where(there, depth, 1.0), 0.0).astype(np.float32)
    write_durably(path, partial(np.save, arr=inverse))


def _load_inverse(folder: Path, number: int) -> Inverse:
    return np.asarray(np.load(folder / f"{number}.npy", allow_pickle=False), np.float32)
