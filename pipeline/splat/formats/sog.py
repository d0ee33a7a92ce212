"""SOG, PlayCanvas' compressed splat: a ZIP of meta.json and lossless WebP images, or the same as a folder.

Specification: "The SOG Format" (developer.playcanvas.com), version 2. Where it differs from PlayCanvas' own programs,
we follow the programs: the frame is the PLY's (viewers take −y as up), and the index of a quaternion's omitted
component counts w, x, y, z.

To embed SOGs in other files, without writing one::

    encode_sog(gaussians: Gaussians, antialias=False, record="", in_order=False) -> SogImages
    SogImages.meta: dict, .images: dict[str, bytes], .files() -> dict[str, bytes]  # with meta.json
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values, open_file
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.formats.sog_decoder import SogDecoder
from splatpipe.pipeline.splat.formats.sog_images import META, RECORD, SogImages, encode_sog, position_cost
from splatpipe.pipeline.splat.model.position_cost import PositionCost
from splatpipe.pipeline.splat.model.scene import Axes, Scene, SceneFacts, facts_of_record, turn_of

__all__ = ["AXES", "SogImages", "encode_sog", "read", "write"]

AXES: Axes = "y down"
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)  # earliest date a ZIP can state, in every file: the same bytes on any day
_MAX_META_BYTES = 1 << 20  # three codebooks and a record are 80 kB
_MAX_DIRECTORY_BYTES = 1 << 16  # largest ZIP directory read: a SOG has 9 files
_END, _END_OF_LARGE = b"PK\5\6", b"PK\6\7"  # begin a ZIP's last record, and the one before it in a ZIP of ≥ 4 GB
_END_BYTES, _MAX_COMMENT_BYTES = 22, 65_535  # sizes of a ZIP's last record and of the comment after it
_HINT = "Give a .sog file, or the meta.json beside its pictures."
_AGAIN = "Copy or export it again."


def write(path: Path, scene: Scene) -> PositionCost:
    """Write a scene as a bundle, turned to y down.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    facts = scene.facts.turned(AXES)
    turn = None if scene.facts.axes == AXES else turn_of(AXES, scene.facts.axes)
    files = encode_sog(scene.gaussians, facts.antialias, facts.record(), turn=turn).files()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _FIRST_DAY), data)
    return position_cost(scene.gaussians)


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a file; without a record of ours it is assumed to be y down, as in viewers, and not georeferenced.

    Args:
        path: A `.sog`, a `meta.json` beside its images, or their folder.

    Raises:
        SplatpipeError: if it is missing, damaged, of another version, or a decompression bomb.
    """
    source = path / META if path.is_dir() else path
    with open_file(source) as file:
        bundled = file.read(2) == b"PK"
    scene = _read_bundle(source) if bundled else _read_folder(source)
    check(source, scene.gaussians)
    return scene_near_origin(source, scene.gaussians, scene.facts)


def _read_bundle(path: Path) -> Scene:
    _check_directory(path)
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()

            def load(name: str, most_bytes: int) -> bytes:
                if names.count(name) != 1:
                    raise SplatpipeError(f"{path}: it does not contain exactly one {name[:60]}.", hint=_HINT)
                info = archive.getinfo(name)
                if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                    raise SplatpipeError(f"{path}: {name[:60]} is compressed in an unsupported way.", hint=_AGAIN)
                with archive.open(info) as file:
                    return _at_most(path, name, file.read(most_bytes + 1), most_bytes)

            meta = _meta(path, load(META, _MAX_META_BYTES))
            return _scene(SogDecoder(path, meta, load, path.stat().st_size))
    except SplatpipeError:
        raise
    except Exception as error:  # zipfile raises almost anything on broken archives
        reason = " ".join(str(error).split())[:120]
        raise SplatpipeError(f"{path} is damaged or not a ZIP: {reason}.", hint=_AGAIN) from error


def _check_directory(path: Path) -> None:
    """Refuse a ZIP whose directory alone would take seconds and much memory."""
    with open_file(path) as file:
        size = file.seek(0, 2)
        file.seek(max(0, size - _END_BYTES - _MAX_COMMENT_BYTES))
        end = file.read()
    at = end.rfind(_END)
    if at < 0 or at + _END_BYTES > len(end):
        raise SplatpipeError(f"{path} is cut off: its ZIP directory is missing.", hint=_AGAIN)
    listed = int.from_bytes(end[at + 12 : at + 16], "little")
    if listed > _MAX_DIRECTORY_BYTES or _END_OF_LARGE in end[max(0, at - 20) : at]:
        raise SplatpipeError(f"{path} is a ZIP with a far larger directory than a SOG's.", hint=_HINT)


def _read_folder(path: Path) -> Scene:
    def load(name: str, most_bytes: int) -> bytes:
        if not _is_plain(name):
            raise SplatpipeError(f"{path}: {name[:60]!r} is not the name of an image beside it.", hint=_AGAIN)
        beside = path.with_name(name)
        if not beside.is_file():
            raise SplatpipeError(f"{path}: there is no {name[:60]} beside it.", hint=_HINT)
        with open_file(beside) as file:
            return _at_most(path, name, file.read(most_bytes + 1), most_bytes)

    meta = _meta(path, load(path.name, _MAX_META_BYTES))
    pictures = {name for part in meta.values() if isinstance(part, dict) for name in _files(part) if _is_plain(name)}
    there = (path.with_name(name) for name in pictures)
    stored = sum(picture.stat().st_size for picture in there if picture.is_file())
    return _scene(SogDecoder(path, meta, load, stored))


def _is_plain(name: str) -> bool:
    """Whether a name is a file in the same folder, on any system."""
    return name.isprintable() and name not in ("", ".", "..") and not set(name) & set("/\\:") and len(name) < 256


def _files(part: dict[str, Any]) -> list[str]:
    files = part.get("files")
    return [name for name in files if isinstance(name, str)] if isinstance(files, list) else []


def _scene(decoder: SogDecoder) -> Scene:
    """The scene as stored, with our record, which may be an object or a string."""
    found = decoder.meta.get(RECORD)
    record = found if isinstance(found, str | None) else json.dumps(found)
    otherwise = SceneFacts(AXES, antialias=decoder.meta.get("antialias") is True)
    return Scene(decoder.gaussians(), facts_of_record(record, otherwise))


def _meta(path: Path, data: bytes) -> dict[str, Any]:
    try:
        meta = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise SplatpipeError(f"{path}: its {META} is not JSON.", hint=_HINT) from error
    if not isinstance(meta, dict):
        raise SplatpipeError(f"{path}: its {META} does not describe a SOG.", hint=_HINT)
    return meta


def _at_most(path: Path, name: str, data: bytes, most_bytes: int) -> bytes:
    if len(data) > most_bytes:
        raise SplatpipeError(f"{path}: {name[:60]} is too large.", hint=_AGAIN)
    return data
