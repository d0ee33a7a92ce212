"""Input of camera estimation, and its result so far."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import UInt8

from splatpipe.pipeline.engine.stage import JSON
from splatpipe.pipeline.photos.files.photo_list import PhotoList
from splatpipe.pipeline.sfm.model.view_graph import ViewGraph


@dataclass(frozen=True)
class MappingInput:
    """The photos of a run and everything known about them before mapping.

    Attributes:
        database: Cameras with their priors, images 1, 2, … in name order, keypoints, verified two-view geometries.
        features: The same images and keypoints, with descriptors.
        colours: (n, 3) RGB of all keypoints of ``features``, image after image.
        photos: The checked list.
        photos_part: The folder of the artifact ``ingest.photos``.
        photos_dir: The user's folder.
        positions: The entries of ``positions.json``.
        cameras: The camera groups of ``ingest.cameras``; the camera of group 0 has COLMAP's id 1.
        scratch: An existing folder for temporary files.
        threads: Number of worker threads; the result does not depend on it.
        tried: Pairs of photos that were matched, (i, j), i < j, COLMAP's numbers, whether or not they were verified.
    """

    database: Path
    features: Path
    colours: UInt8[np.ndarray, "_ 3"]
    photos: PhotoList
    photos_part: Path
    photos_dir: Path
    positions: Sequence[JSON]
    cameras: Sequence[JSON]
    scratch: Path
    threads: int = 1
    tried: frozenset[tuple[int, int]] = frozenset()


@dataclass(frozen=True)
class MappingResult:
    """Cameras and points so far.

    Attributes:
        model: The model passed on to later steps.
        others: Sub-models that could not be joined to it, the largest first.
        database: The one that the keypoint indices of ``model`` refer to.
        verified: Its view graph.
        colours: (n, 3) RGB of all its keypoints, image after image.
        tried: A row for each mapping attempt, for ``models.json``.
        rungs: A row for each rung of the ladder that was run, for ``models.json``.
    """

    model: pycolmap.Reconstruction
    others: tuple[pycolmap.Reconstruction, ...]
    database: Path
    verified: ViewGraph
    colours: UInt8[np.ndarray, "_ 3"]
    tried: tuple[JSON, ...] = ()
    rungs: tuple[JSON, ...] = ()
