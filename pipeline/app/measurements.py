"""Stores measurements on a run's surface model for later commands: `stages/measured.json`.

`OUT/sections` and `OUT/volumes.json` are for people and their programs. This file has the same figures and their
geometry in the world frame, with the digests of the surface model and the frame for which they are valid.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from splatpipe.pipeline.app.page_file import printable
from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import read_json

MEASURED = Path("stages/measured.json")
SECTIONS = "sections"  # the folder in OUT
VOLUMES = "volumes.json"
FORMAT = 1
MAX_FILE_BYTES = 64 << 20  # bytes: ten times the largest file ever written
Kind = Literal["sections", "volumes"]
Items = list[dict[str, Any]]
FIGURES: Mapping[Kind, Sequence[str]] = {
    "sections": ("length_m", "share_with_height"),
    "volumes": (
        "polygon",
        *(f"{kind}_{figure}" for kind in ("cut", "fill", "net") for figure in ("m3", "sigma_m3")),
        *("area_m2", "share_without_height"),
    ),
}


def read_measurements(out: Path, kind: Kind, surface: str, frame: str = "") -> Items:
    """Read the sections or volumes of a surface model whose files have not been removed since.

    Args:
        out: OUT.
        kind: Sections or volumes.
        surface: Digest of the surface model.
        frame: Digest of the frame in which to show them; empty for any.

    Returns:
        The figures of each, with its ``trace``; empty if the file is missing, damaged, or of another model.
    """
    stored = _stored(out).get(kind)
    if not isinstance(stored, dict) or not surface or stored.get("surface") != surface:
        return []
    if frame and stored.get("frame") != frame:
        return []
    items = stored.get("items")
    if not isinstance(items, list) or not all(_is_whole(item, kind) for item in items):
        return []
    if kind == "volumes":
        return items if (out / VOLUMES).is_file() else []
    return [item for item in items if (out / SECTIONS / str(item.get("csv"))).is_file()]


def has_measurements(out: Path) -> bool:
    """Whether anything was measured, on whatever surface model."""
    return bool(_stored(out))


def outdated(out: Path, surface: str) -> bool:
    """Whether OUT still has measurements, but of another surface model."""
    stored = {kind: found for kind, found in _stored(out).items() if isinstance(found, dict)}
    there = [kind for kind, name in (("sections", SECTIONS), ("volumes", VOLUMES)) if (out / name).exists()]
    return any(stored[kind].get("items") and stored[kind].get("surface") != surface for kind in there if kind in stored)


def title_of(item: Mapping[str, Any]) -> str:
    """The title of a section or a volume in pages."""
    if "polygon" in item:
        return printable(item["name"]) or f"Volume {item['polygon']}"
    return printable(item["name"]).replace("-", " ").capitalize()


def write_measurements(out: Path, kind: Kind, digests: tuple[str, str], items: Sequence[Mapping[str, Any]]) -> None:
    """Replace the stored measurements of a kind. Only the holder of OUT's lock may call this.

    Args:
        out: OUT.
        kind: Sections or volumes.
        digests: Digests of the surface model and of the frame.
        items: As ``read_measurements`` returns them.

    Raises:
        OSError: if the disk is full or not writable.
    """
    value = {**_stored(out), "format": FORMAT, kind: {"surface": digests[0], "frame": digests[1], "items": list(items)}}
    text = json.dumps(value, ensure_ascii=False, allow_nan=False, separators=(",", ":"), sort_keys=True)
    write_durably(out / MEASURED, text)


def _is_whole(item: Any, kind: Kind) -> bool:
    """Whether it has all the figures that pages show."""
    if not isinstance(item, dict) or not isinstance(item.get("name"), str):
        return False
    if kind == "volumes" and not isinstance(item.get("base"), dict):
        return False
    return all(is_number(item.get(name)) for name in FIGURES[kind])


def is_number(value: Any) -> bool:
    """Whether it is a number that a page can show."""
    return isinstance(value, int | float) and abs(value) <= sys.float_info.max  # NaN is not; an int may be any size


def _stored(out: Path) -> dict[str, Any]:
    path = out / MEASURED
    try:
        value = read_json(path, MAX_FILE_BYTES)
    except (OSError, ValueError):
        return {}
    return value if isinstance(value, dict) and value.get("format") == FORMAT else {}
