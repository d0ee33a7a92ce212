"""A depth map for every photo, with how many others confirm each pixel: the input of all surfaces.

Plain walls and lawns have depths as well: confirmed by two other photos, such a pixel is right as often as a textured
one, and without them a third of a garden is missing. Depth edges are moved to where the photo has them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float32, UInt8

from splatpipe.pipeline.engine.errors import StageError
from splatpipe.pipeline.engine.files.json_file import read_json, write_json
from splatpipe.pipeline.engine.files.output_file import new_file
from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.mvs.depth_search import MIN_AGREEING, ConfirmedDepths, DepthSearch, SearchPlan
from splatpipe.pipeline.mvs.edges import pixels_behind
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.splat.containers.archives import open_archive

LIST = "maps.json"
MAX_MATCHED = 16  # neighbours that a photo is matched with: few photos, and not the nearest, see behind hedges
MAX_CONFIRMING = 24  # neighbours that may confirm a depth: 20 confirm 96 % of points that three photos see, 8 only 39 %
NEAR_MARGIN = 2.0  # factor by which the search starts nearer than the sparse points: a close treetop has none


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of a photo's pixels.

    Attributes:
        depth: Depth along the camera's z at the pixel's centre, world units; 0 where none is confirmed.
        confidence: How many other photos confirm it; 0 where there is no depth.
    """

    depth: Float32[np.ndarray, "h w"]
    confidence: UInt8[np.ndarray, "h w"]


@dataclass(frozen=True, eq=False)
class DepthMapFile:
    """A depth map stored in a file.

    Attributes:
        camera: The photo's camera at the map's resolution, in the model's frame.
        path: Path of the file.
    """

    camera: Camera
    path: Path

    def load(self) -> DepthMap:
        """Read the depth map.

        Raises:
            StageError: if the file is not a depth map of the camera's size.
        """
        try:
            with open_archive(self.path) as kept:
                found = DepthMap(np.asarray(kept["depth"], np.float32), np.asarray(kept["confidence"], np.uint8))
        except (OSError, EOFError, ValueError, TypeError, KeyError, BadZipFile) as error:
            raise _unreadable(self.path.name) from error
        if not found.depth.shape == found.confidence.shape == (self.camera.height, self.camera.width):
            raise _unreadable(self.path.name)
        return found


def save_depth_maps(folder: Path, maps: Iterable[tuple[Camera, DepthMap]]) -> dict[str, int | float]:
    """Write depth maps as they arrive: `00000.npz` and so on, and `maps.json`, which lists their photos.

    Args:
        folder: Folder to create.
        maps: Depth maps with their cameras.

    Returns:
        The number of ``maps``, their ``megapixels``, and the share of pixels with a depth as ``found``.
    """
    folder.mkdir()
    listed: list[dict[str, str | int]] = []
    pixels = found = 0
    for number, (camera, each) in enumerate(maps):
        name = f"{number:05d}.npz"
        with new_file(folder / name) as file:
            np.savez(file, depth=each.depth, confidence=each.confidence)
        listed.append({"photo": camera.name, "file": name, "width": camera.width, "height": camera.height})
        pixels += each.depth.size
        found += int(np.count_nonzero(each.confidence))
    write_json(folder / LIST, {"maps": listed})
    return {"maps": len(listed), "megapixels": pixels / 1e6, "found": found / max(pixels, 1)}


def list_depth_maps(folder: Path, views: Sequence[View]) -> list[DepthMapFile]:
    """List the depth maps that ``save_depth_maps`` wrote, to be loaded one by one.

    Args:
        folder: The folder of the maps.
        views: Views of the dataset, which include the maps' photos.

    Raises:
        StageError: if the maps are missing.
    """
    cameras = {view.camera.name: view.camera for view in views}
    try:
        listed = read_json(folder / LIST)["maps"]
        return [
            DepthMapFile(cameras[each["photo"]].scaled(int(each["width"]), int(each["height"])), folder / each["file"])
            for each in listed
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _unreadable(LIST) from error


def _unreadable(name: str) -> StageError:
    return StageError(f"{name} is not one of this dataset's depth maps.", hint="Run again with --rerun-from depths.")


def find_depth_maps(
    dataset: Path, views: Sequence[View], megapixels: float, folder: Path, threads: int, report: Reporter
) -> Iterator[tuple[Camera, DepthMap]]:
    """Estimate the depth maps of photos by PatchMatch; identical for any number of threads.

    Args:
        dataset: The folder that `undistort` wrote.
        views: Photos to use, in name order.
        megapixels: Maximum size of a map.
        folder: Folder for temporary files, with room for 9 bytes per pixel of all maps; a killed run resumes from it.
        threads: Photos in parallel, and threads of the kernel.
        report: Receives progress.

    Yields:
        Camera and depth map of each view, in order, in the model's frame.

    Raises:
        StageError: if the model or a photo cannot be read.
    """
    plan = SearchPlan(megapixels, NEAR_MARGIN, True, MAX_MATCHED, MAX_CONFIRMING)
    search = DepthSearch.begin(dataset, views, folder, plan)
    search.run(threads, report)
    maps = confirmed_maps(search.cameras, search.agreement, threads, report)
    yield from ordered_map(partial(_with_edges, search), enumerate(maps), threads)


def _with_edges(search: DepthSearch, numbered: tuple[int, tuple[Camera, DepthMap]]) -> tuple[Camera, DepthMap]:
    """Move a map's depth edges to where its photo has them."""
    number, (camera, found) = numbered
    rows, columns, depth = pixels_behind(found.depth, search.colours(number))
    found.depth[rows, columns] = depth
    found.confidence[rows, columns] = MIN_AGREEING
    return camera, found


def confirmed_maps(
    cameras: Sequence[Camera], agreement: Callable[[int], ConfirmedDepths | None], threads: int, report: Reporter
) -> Iterator[tuple[Camera, DepthMap]]:
    """Keep the depths of photos that enough other photos confirm, in the order of the cameras.

    Args:
        cameras: Cameras at the maps' resolution.
        agreement: Returns how other photos confirm a photo's depths, given its index; None for a photo without depths.
        threads: Photos in parallel.
        report: Receives progress.

    Yields:
        Each camera and its depth map.
    """
    maps = ordered_map(lambda number: _confirmed_map(cameras[number], agreement(number)), range(len(cameras)), threads)
    for done, (camera, found) in enumerate(zip(cameras, maps, strict=True), start=1):
        yield camera, found
        report.progress(done, len(cameras), "comparing depths", "photos")


def _confirmed_map(camera: Camera, agreement: ConfirmedDepths | None) -> DepthMap:
    depth = np.zeros((camera.height, camera.width), np.float32)
    confidence = np.zeros(depth.shape, np.uint8)
    if agreement is not None:
        sure = agreement.votes >= MIN_AGREEING
        rows, columns = agreement.rows[sure], agreement.columns[sure]
        depth[rows, columns] = 1.0 / agreement.inverse[sure]
        confidence[rows, columns] = agreement.votes[sure]
    return DepthMap(depth, confidence)
