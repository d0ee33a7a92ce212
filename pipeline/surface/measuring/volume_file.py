"""`volumes.json`: volumes above and below a base inside each polygon of a boundary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatpipe.pipeline.engine.files.durable import write_durably
from splatpipe.pipeline.engine.files.json_file import json_text
from splatpipe.pipeline.surface.measuring.volumes import Amount, Volume
from splatpipe.pipeline.surface.rasters.map_crs import MapCrs

FORMAT = 1
DIGITS = 4
HOW = (
    "One standard deviation: the cells' expected deviations, shared by some 13 neighbours each; the base's, by the "
    "misfit of the rim to it; for a stated height that of photo positions, where these place the run; for the ground, "
    "that of filled ground, as if all of it in a polygon were off alike. Volumes are of the part that has heights, and "
    "nothing is filled in but the ground. Lengths are on the ground. Noise about the base makes cut "
    "and fill larger alike, and not the net."
)


def write_volumes(path: Path, facts: Sequence[Mapping[str, Any]], crs: MapCrs) -> None:
    """Write the measured volumes.

    Args:
        path: Output file.
        facts: Results of ``volume_facts`` for each polygon.
        crs: CRS of the surface model.

    Raises:
        OSError: if the disk is full or not writable.
    """
    value = {"format": FORMAT, "crs": crs.horizontal.name, "heights": crs.described_heights(), "uncertainty": HOW}
    write_durably(path, json_text({**value, "volumes": list(facts)}))


def volume_facts(number: int, name: str, volume: Volume) -> dict[str, Any]:
    """A volume as JSON values; the base's height is in metres in the CRS's datum, its position in the CRS's unit.

    Args:
        number: Number of the polygon in its file, from 1.
        name: Name of the polygon; empty for none.
        volume: The volume in it.
    """
    kinds = {"cut": volume.cut, "fill": volume.fill, "net": volume.net}
    return {
        "polygon": number,
        "name": name,
        **{key: value for kind, amount in kinds.items() for key, value in _numbers(kind, amount).items()},
        "area_m2": round(volume.area_m2, DIGITS),
        "area_without_height_m2": round(volume.area_m2 - volume.known_m2, DIGITS),
        "share_without_height": round(1.0 - volume.known_m2 / volume.area_m2, DIGITS),
        "base": volume.base.facts(),
    }


def _numbers(kind: str, amount: Amount) -> dict[str, float]:
    return {f"{kind}_m3": round(amount.m3, DIGITS), f"{kind}_sigma_m3": round(amount.sigma_m3, DIGITS)}
