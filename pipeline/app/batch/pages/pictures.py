"""Chooses a capture's image for its card: a render of a held-out view, or until there is one, a photo."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.report.facts.report_inputs import read_report_inputs
from splatpipe.pipeline.app.thumbnails import thumbnail
from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.photos.files.names import PHOTO_SUFFIXES
from splatpipe.pipeline.photos.files.photo_list import photo_root

SIDE = 480  # pixels, of a card on a good display
MIN_PSNR_DB = 12.0  # PSNR without exposure compensation: a worse render does not show which capture it is
CANDIDATES = 5  # photos, spread over the capture: some show little but sky, grass, or the ground before take-off


def capture_picture(out: Path, photos: Path, pictures: Path) -> Path | None:
    """Make a small image of a capture from what exists of it now.

    Args:
        out: Its results folder, which may not exist yet.
        photos: Its photo folder.
        pictures: The folder for the images of all captures; created if missing.

    Returns:
        The image in `pictures`, rewritten if a better one is available now. None if there is nothing to show.

    Raises:
        OSError: if it cannot be written.
    """
    source, orientation = _render(out) or (_photo(photos), 1)
    if source is None:
        return None
    capture = hashlib.sha256(bytes(out.absolute())).hexdigest()[:16]
    status = source.stat()
    stamp = hashlib.sha256(f"{bytes(source)!r} {status.st_mtime_ns} {status.st_size}".encode()).hexdigest()[:16]
    path = pictures / f"{capture}-{stamp}.jpg"
    if not path.is_file():
        small = thumbnail(source, SIDE, orientation)
        if small is None:
            return None
        pictures.mkdir(parents=True, exist_ok=True)
        write_durably(path, lambda file: file.write(base64.b64decode(str(small.picture).partition(",")[2])))
    for other in pictures.glob(f"{capture}-*.jpg"):
        if other != path:
            other.unlink(missing_ok=True)
    return path


def _render(out: Path) -> tuple[Path, int] | None:
    """Of the held-out views that match their photos, the render with the most detail, and its EXIF orientation."""
    try:
        inputs = read_report_inputs(out)
        folder = inputs.part("evaluate.views")
        views: Sequence[Mapping[str, Any]] = inputs.read("evaluate.metrics").get("per_view", [])
        if folder is None or not views:
            return None
        views = sorted(views, key=_view_psnr, reverse=True)
        renders = [(folder / f"{Path(str(view['file'])).name}.render.png", view) for view in views]
        better = renders[: (len(renders) + 1) // 2]
        good = [
            (path, view) for path, view in better if path.is_file() and float(view.get("psnr") or 0.0) >= MIN_PSNR_DB
        ]
        if not good:
            return None
        path, view = max(good, key=lambda render: render[0].stat().st_size)
        photos = inputs.read_in_part("ingest.photos", "photos.json").get("photos", [])
        turned = {photo["name"]: int(photo.get("orientation") or 1) for photo in photos}
        return path, turned.get(view["name"], 1)
    except (SplatpipeError, OSError, ValueError, KeyError, TypeError, AttributeError):  # the run is incomplete
        return None


def _view_psnr(view: Mapping[str, Any]) -> float:
    return float(view.get("psnr_cc") or view.get("psnr") or 0.0)


def _photo(photos: Path) -> Path | None:
    """Of photos spread over the capture, the one with the most detail."""
    try:
        root = photo_root(photos)
        every = sorted(path for path in root.rglob("*") if path.suffix.lower().lstrip(".") in PHOTO_SUFFIXES)
    except OSError:
        return None
    chosen = [every[len(every) * (2 * i + 1) // (2 * CANDIDATES)] for i in range(CANDIDATES)] if every else []
    seen = ((len(small.picture), path) for path in dict.fromkeys(chosen) if (small := thumbnail(path, SIDE)))
    return max(seen, default=(0, None))[1]
