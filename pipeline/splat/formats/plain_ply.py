"""The 3DGS PLY with header comments that say where the splat lies, for people and, as a record, for programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatpipe.pipeline.splat.ply import MIP_COMMENT, read_splat, read_splat_header, write_splat
from splatpipe.pipeline.splat.scene import Axes, Scene, SceneFacts, facts_of_record

RECORD = "splatpipe "
"""Begins the comment that is the record."""
_AXES: dict[Axes, str] = {"z up": "z up", "y up": "y up", "y down": "y down (−y is up)"}


def write(path: Path, scene: Scene, comments: Sequence[str] = ()) -> None:
    """Write it as a survey wants it: z up where it lies on the earth or has metres; else as viewers take it, y down.

    Nothing is turned that has those axes already.

    Args:
        path: The file; replaced if it is there.
        scene: What to write.
        comments: Further header comments, one line each.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    facts = scene.facts
    surveyed = facts.place is not None or facts.metres or facts.axes == "z up"
    _write(path, scene.turned("z up" if surveyed else "y down"), comments)


def write_for_viewers(path: Path, scene: Scene) -> None:
    """Write it y down, as viewers take a PLY.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    _write(path, scene.turned("y down"))


def _write(path: Path, scene: Scene, comments: Sequence[str] = ()) -> None:
    write_splat(path, scene.gaussians, [*header_comments(scene.facts), *comments])


def header_comments(facts: SceneFacts) -> list[str]:
    """Comments of a PLY's header that keep a splat's facts, for people and for ``facts_of_comments``."""
    return [*frame_comments(facts), f"{RECORD}{facts.record()}"]


def facts_of_comments(comments: Sequence[str]) -> SceneFacts:
    """What a PLY's header says; without a record of ours y down, as viewers take it, and nowhere on the earth."""
    record = next((text.removeprefix(RECORD) for text in comments if text.startswith(RECORD)), None)
    return facts_of_record(record, SceneFacts("y down", antialias=MIP_COMMENT in comments))


def frame_comments(facts: SceneFacts) -> list[str]:
    """Header comments that tell people what a splat's frame is."""
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
    """Read one; without a record of ours it is taken for y down, as viewers do, and for nowhere on the earth.

    Raises:
        SplatpipeError: as ``read_splat``.
    """
    return Scene(read_splat(path), facts_of_comments(read_splat_header(path).comments))
