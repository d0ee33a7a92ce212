"""A depth map for every photo, with how many others confirm each pixel: what surfaces are made from.

Plain walls and lawns have depths as well: where two other photos found the same, a pixel is right as often as one with
texture at hand, and without them a third of a garden is missing.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_search import AGREEING, DepthSearch
from splatpipe.pipeline.photos.dataset import View

WIDER = 2.0  # times nearer than sparse points: of a tree's crown before the camera there is none


@dataclass(frozen=True, eq=False)
class DepthMap:
    """How deep a photo's pixels lie.

    Attributes:
        depth: Along the camera's z at the pixel's centre, world units; 0 where none is confirmed.
        confidence: How many other photos confirm it; 0 where there is no depth.
    """

    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]

    def save(self, path: Path) -> None:
        """Write it; `load_depth_map` reads it."""
        np.savez(path, depth=self.depth, confidence=self.confidence)


def load_depth_map(path: Path, camera: Camera) -> DepthMap:
    """Read what ``DepthMap.save`` left.

    Args:
        path: The file.
        camera: In its grid.

    Raises:
        StageError: if it is not a map of that grid.
    """
    try:
        with np.load(path, allow_pickle=False) as kept:
            found = DepthMap(np.asarray(kept["depth"], np.float32), np.asarray(kept["confidence"], np.uint8))
    except (OSError, ValueError, KeyError) as error:
        raise _unreadable(path) from error
    if not found.depth.shape == found.confidence.shape == (camera.height, camera.width):
        raise _unreadable(path)
    return found


def _unreadable(path: Path) -> StageError:
    return StageError(f"{path.name} is no depth map of its photo.", hint="Run again with --rerun-from depths.")


def find_depth_maps(
    dataset: Path, views: Sequence[View], megapixels: float, folder: Path, threads: int, report: Reporter
) -> Iterator[tuple[Camera, DepthMap]]:
    """The depth maps of photos, in the model's frame, in the order of the views; the same for any number of threads.

    Args:
        dataset: The folder that `undistort` left.
        views: Photos to use, in name order.
        megapixels: Of a map at most.
        folder: Where there is room for 9 bytes a pixel of all maps meanwhile.
        threads: Photos at a time, and the kernel's.
        report: Told of progress.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="depths-", dir=folder) as kept:
        search = DepthSearch.begin(dataset, views, Path(kept), megapixels, WIDER, plain=True)
        search.run(threads, report)
        maps = ordered_map(partial(_confirmed_map, search), range(len(views)), threads)
        for done, (camera, found) in enumerate(zip(search.cameras, maps, strict=True), start=1):
            yield camera, found
            report.progress(done, len(views), "comparing depths", "photos")


def _confirmed_map(search: DepthSearch, number: int) -> DepthMap:
    camera = search.cameras[number]
    depth = np.zeros((camera.height, camera.width), np.float32)
    confidence = np.zeros(depth.shape, np.uint8)
    agreement = search.agreement(number)
    if agreement is not None:
        sure = agreement.votes >= AGREEING
        rows, columns = agreement.rows[sure], agreement.columns[sure]
        depth[rows, columns] = 1.0 / agreement.inverse[sure]
        confidence[rows, columns] = agreement.votes[sure]
    return DepthMap(depth, confidence)
