"""The 3DGS PLY with header comments on the splat's frame, for people and, as a record, for programs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values
from splatpipe.pipeline.splat.containers.ply import MIP_COMMENT, read_stored_splat, write_splat
from splatpipe.pipeline.splat.containers.ply_dialects import stored_activated, take_logarithms
from splatpipe.pipeline.splat.formats.near_origin import scene_near_origin
from splatpipe.pipeline.splat.model.position_cost import PositionCost, float32_cost
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, Axes, Scene, SceneFacts, facts_of_record

RECORD = "splatpipe "
"""Prefix of the comment with the record."""
_OFFSET = re.compile("shift|offset|origin|translat|georef", re.IGNORECASE)
_NUMBER = re.compile(r"[-+]?[0-9]+(?:\.[0-9]+)?")
_MIN_NUMBERS = 2  # numbers in a comment that may state an offset
_MAX_SHOWN, _MAX_NOTES = 120, 3
_AXES: dict[Axes, str] = {"z up": "z up", "y up": "y up", "y down": "y down (−y is up)"}


def write(path: Path, scene: Scene, comments: Sequence[str] = ()) -> PositionCost:
    """Write a scene z up if it is georeferenced or metric, as in surveying; else y down, as viewers assume.

    A scene that has these axes already is not turned. If an origin was taken off its coordinates, it is added again,
    and positions are float64.

    Args:
        path: The file; replaced if it exists.
        scene: The scene.
        comments: Further header comments, one line each.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    there = _in_file_axes(scene)
    near = replace(there.facts, offset=NO_OFFSET)
    write_splat(path, there.gaussians, [*header_comments(near), *comments], there.facts.offset)
    return float32_cost(there.gaussians)


def write_about_origin(path: Path, scene: Scene) -> PositionCost:
    """Write a scene as ``write``, but always with float32 positions: an origin that was taken off is only recorded.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    return _write(path, _in_file_axes(scene))


def _in_file_axes(scene: Scene) -> Scene:
    facts = scene.facts
    surveyed = facts.place is not None or facts.metres or facts.offset != NO_OFFSET or facts.axes == "z up"
    return scene.turned("z up" if surveyed else "y down")


def write_for_viewers(path: Path, scene: Scene) -> PositionCost:
    """Write a scene y down, as viewers assume for a PLY.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    return _write(path, scene.turned("y down"))


def _write(path: Path, scene: Scene) -> PositionCost:
    write_splat(path, scene.gaussians, header_comments(scene.facts))
    return float32_cost(scene.gaussians)


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
        if facts.offset != NO_OFFSET:
            x, y, z = (f"{number:.15g}" for number in facts.offset)
            comments += [f"offset: {x} {y} {z} (added to x y z, it gives the coordinates of the original)"]
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


def read(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a file; without a record of ours it is assumed to be y down, as in viewers, and not georeferenced.

    Raises:
        SplatpipeError: as ``read_splat``.
    """
    gaussians, header = read_stored_splat(path)
    notes = header.dialect.notes(path)
    if stored_activated(gaussians):
        take_logarithms(gaussians)
        notes += (f"{path} has opacities and scales as they are, not as logits and logarithms: they are read as such.",)
    check(path, gaussians)
    scene = scene_near_origin(path, gaussians, facts_of_comments(header.comments))
    return replace(scene, notes=notes + scene.notes + _others_offsets(path, header.comments))


def _others_offsets(path: Path, comments: Sequence[str]) -> tuple[str, ...]:
    """Notes on comments of other programs that appear to say where the splat lies; each has its own sign and order."""
    if any(text.startswith(RECORD) for text in comments):
        return ()
    stated = [text for text in comments if _OFFSET.search(text) and len(_NUMBER.findall(text)) >= _MIN_NUMBERS]
    return tuple(
        f"{path}: its header says {text[:_MAX_SHOWN]!r}, which is neither applied nor copied to another file."
        for text in stated[:_MAX_NOTES]
    )
