"""Estimates a capture's size from the headers of a few photos, for forecasts before anything is done."""

from __future__ import annotations

import warnings
from statistics import median

from splatpipe.pipeline.engine.runs.source import RunSource
from splatpipe.pipeline.photos.files.companions import find_companions
from splatpipe.pipeline.photos.files.names import is_photo
from splatpipe.stages.forecast.needs import has_control
from splatpipe.stages.forecast.training import USUAL_SHAPE, CaptureSize

SAMPLED = 9  # photos whose size is read; within a capture most are alike


def size_of(source: RunSource) -> CaptureSize:
    """The size of a user's folder of photos, from the headers of a few of them; 0 photos or megapixels if unknown."""
    from PIL import Image

    from splatpipe.pipeline.photos.metadata.exif import read_exif

    named = {name: path for name, path in source.part_files["source.photos"].items() if is_photo(path)}
    companions = find_companions(name for name in named)
    paths = sorted(path for name, path in named.items() if name not in companions)
    sizes, placed = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about unusual tags; the run reports problems with photos
        for path in paths[:: max(1, len(paths) // SAMPLED)][:SAMPLED]:
            try:
                with Image.open(path) as picture:
                    sizes.append(picture.size)
                    placed += read_exif(picture).gps is not None
            except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
                continue
    megapixels = median(width * height for width, height in sizes) / 1e6 if sizes else 0.0
    shape = median(min(size) / max(size) for size in sizes) if sizes else USUAL_SHAPE
    positions = source.named.get("source.geo") is not None or 2 * placed > len(sizes)
    return CaptureSize(len(paths), megapixels, positions, shape, has_control(source))
