"""What a report's pictures are drawn from, as facts to compare: files, photos, our code and the libraries that draw."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
import stat
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.run_history import RunHistory
from splatpipe.pipeline.engine.files.small_file import read_small
from splatpipe.pipeline.engine.runs.colmap_folder import has_model
from splatpipe.pipeline.engine.runs.run_folder import Contents
from splatpipe.pipeline.engine.runs.store import Artifact

CODE = Path(__file__).resolve().parents[4]  # the folder of the package: some of every room draws
SMALL_BYTES = 1 << 18  # files up to this size are compared by content, larger ones by size and time
LIBRARIES = (
    "splatpipe",
    "matplotlib",
    "numpy",
    "opencv-contrib-python-headless",
    "pillow",
    "pycolmap",
    "pyproj",
    "rasterio",
    "scipy",
)
PHOTOS = "ingest.photos"


def limited(
    inputs: ReportInputs, parts: Sequence[str], summaries: Sequence[str] = (), *, photos: bool = False
) -> ReportInputs:
    """The inputs as if there were nothing else: what is drawn from them depends on nothing that its key does not cover.

    Args:
        inputs: The report's inputs.
        parts: The parts to be seen, by full name.
        summaries: Stages whose summaries are to be seen.
        photos: Whether the user's photos are to be seen.
    """
    artifacts = {}
    for name, artifact in inputs.artifacts.items():
        shown = {part: each for part, each in artifact.manifest["parts"].items() if f"{name}.{part}" in parts}
        if shown or name in summaries:
            summary = artifact.summary if name in summaries else {}
            artifacts[name] = Artifact(artifact.folder, {"stage": name, "key": "", "summary": summary, "parts": shown})
    photos_dir = inputs.photos_dir if photos else None
    return replace(
        inputs,
        history=RunHistory(),
        config=None,
        photos_dir=photos_dir,
        contents=Contents(artifacts),
        deliverables=(),
    )


def source_facts(inputs: ReportInputs) -> Any:
    """All that can be seen of limited inputs.

    Args:
        inputs: From ``limited``.

    Raises:
        OSError, ValueError, KeyError, TypeError: if a part is damaged.
    """
    parts = {name: [part.digest, path_facts(part.path)] for name, part in inputs.contents.parts.items()}
    summaries = {name: artifact.summary for name, artifact in inputs.artifacts.items()}
    return [parts, summaries, _photo_facts(inputs)]


def path_facts(path: Path) -> Any:
    """What identifies a file's content, or that of each file in a folder.

    Args:
        path: The file or folder; there may be nothing.
    """
    facts, waiting = {}, [path]
    while waiting:
        place = waiting.pop()
        name = place.relative_to(path).as_posix()
        try:
            if stat.S_ISDIR(place.lstat().st_mode):
                waiting += place.iterdir()
            else:
                facts[name] = _file_facts(place)
        except OSError as error:
            facts[name] = f"not readable: {error.errno}"
    return facts


def _file_facts(path: Path) -> Any:
    found = path.stat()
    if stat.S_ISDIR(found.st_mode):  # a link to one, which may be the whole disk: never the same again
        return os.urandom(16).hex()
    if not stat.S_ISREG(found.st_mode) or found.st_size > SMALL_BYTES:
        return [stat.S_IFMT(found.st_mode), found.st_size, found.st_mtime_ns]
    return hashlib.sha256(read_small(path, SMALL_BYTES)).hexdigest()


def code_digest() -> str:
    """Digest of our code and of the versions of the libraries that draw."""
    digest = hashlib.sha256(platform.python_version().encode())
    for folder in ("pipeline", "stages"):
        for path in sorted((CODE / folder).rglob("*.py")):
            digest.update(path.relative_to(CODE).as_posix().encode() + b"\0" + path.read_bytes())
    for name in LIBRARIES:
        digest.update(f"{name} {_version(name)}\n".encode())
    return digest.hexdigest()


def _photo_facts(inputs: ReportInputs) -> Any:
    """Size and time of each photo in the user's folder: a photo that is gone or was replaced is not shown."""
    if inputs.photos_dir is None:
        return None
    facts: list[Any] = [str(inputs.photos_dir), has_model(inputs.photos_dir)]
    root = inputs.photos_dir / "images" if facts[1] else inputs.photos_dir  # as photo_root, which would load Pillow
    for photo in inputs.read_in_part(PHOTOS, "photos.json").get("photos", []):
        try:
            found = (root / str(photo["name"])).stat()
            facts.append([photo["name"], found.st_size, found.st_mtime_ns, found.st_ctime_ns, found.st_mode])
        except OSError as error:
            facts.append([photo["name"], error.errno])
    return facts


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""
