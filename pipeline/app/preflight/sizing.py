"""Estimates a capture's size from the headers of a few photos, for forecasts before anything is done."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from splatpipe.pipeline.engine.runs.source import RunSource
from splatpipe.pipeline.photos.files.companions import find_companions
from splatpipe.pipeline.photos.files.names import is_photo
from splatpipe.stages.forecast.needs import has_control
from splatpipe.stages.forecast.training import USUAL_SHAPE, CaptureSize

SAMPLED = 9  # photos whose size is read; within a capture most are alike


def size_of(source: RunSource) -> CaptureSize:
    """The size of a user's folder of photos."""
    named = {name: path for name, path in source.part_files["source.photos"].items() if is_photo(path)}
    companions = find_companions(name for name in named)
    paths = [path for name, path in named.items() if name not in companions]
    found = capture_size(paths, has_file=source.named.get("source.geo") is not None)
    return replace(found, control=has_control(source))


def capture_size(paths: Sequence[Path], *, has_file: bool) -> CaptureSize:
    """The capture size for the forecast, from the headers of a few photos.

    Args:
        paths: Paths of all photos.
        has_file: Whether there is a positions file.
    """
    from PIL import Image

    from splatpipe.pipeline.photos.metadata.exif import read_exif

    sizes, placed = [], 0
    step = max(1, len(paths) // SAMPLED)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about unusual tags; the run reports problems with photos
        for path in sorted(paths)[::step][:SAMPLED]:
            try:
                with Image.open(path) as picture:
                    sizes.append(picture.size)
                    placed += read_exif(picture).gps is not None
            except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
                continue
    megapixels = median(width * height for width, height in sizes) / 1e6 if sizes else 0.0
    shapes = [min(size) / max(size) for size in sizes]
    positions = has_file or 2 * placed > len(sizes)
    return CaptureSize(len(paths), megapixels, positions, median(shapes) if shapes else USUAL_SHAPE)
