"""The 3DGS PLY with header comments on the splat's frame, for people and, as a record, for programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.splat.ply import MIP_COMMENT, read_splat, read_splat_header, write_splat
from splatpipe.pipeline.splat.scene import Axes, Scene, SceneFacts, facts_of_record

RECORD = "splatpipe "
"""Prefix of the comment with the record."""
_AXES: dict[Axes, str] = {"z up": "z up", "y up": "y up", "y down": "y down (−y is up)"}


def write(path: Path, scene: Scene, comments: Sequence[str] = ()) -> None:
    """Write a scene z up if it is georeferenced or metric, as in surveying; else y down, as viewers assume.

    A scene that has these axes already is not turned.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.
        comments: Further header comments, one line each.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    facts = scene.facts
    surveyed = facts.place is not None or facts.metres or facts.axes == "z up"
    _write(path, scene.turned("z up" if surveyed else "y down"), comments)


def write_for_viewers(path: Path, scene: Scene) -> None:
    """Write a scene y down, as viewers assume for a PLY.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    _write(path, scene.turned("y down"))


def _write(path: Path, scene: Scene, comments: Sequence[str] = ()) -> None:
    write_splat(path, scene.gaussians, [*header_comments(scene.facts), *comments])


def header_comments(facts: SceneFacts) -> list[str]:
    """Header comments with a splat's metadata, for people and for ``facts_of_comments``."""
    return [*frame_comments(facts), f"{RECORD}{facts.record()}"]


def facts_of_comments(comments: Sequence[str]) -> SceneFacts:
    """Metadata from a PLY's comments; without a record of ours, y down, as viewers assume, and not georeferenced."""
    record = next((text.removeprefix(RECORD) for text in comments if text.startswith(RECORD)), None)
    return facts_of_record(record, SceneFacts("y down", antialias=MIP_COMMENT in comments))


def frame_comments(facts: SceneFacts) -> list[str]:
    """Header comments that describe a splat's frame to people."""
    comments = [MIP_COMMENT] if facts.antialias else []
    place = facts.place
    if place is None:
        scale = "metres, arbitrary place" if facts.metres else "arbitrary scale"
        comments += [f"frame: {_AXES[facts.axes]}, {scale} and heading"]
    else:
        turned = "" if facts.axes == "z up" else f", turned to {_AXES[facts.axes]}"
        where = f"{place.latitude:.9f} {place.longitude:.9f} {place.height_m:.4f}"
        comments += [
            f"frame: local east north up, metres{turned}",
            f"origin: {where} (latitude longitude in degrees, WGS 84; height in metres, in the vertical datum)",
            f"vertical datum: {place.vertical_datum}",
            f"crs: {place.crs} (see georef.json)",
        ]
    return comments


def read(path: Path) -> Scene:
    """Read a file; without a record of ours it is assumed to be y down, as in viewers, and not georeferenced.

    Raises:
        SplatpipeError: as ``read_splat``.
    """
    return Scene(read_splat(path), facts_of_comments(read_splat_header(path).comments))
