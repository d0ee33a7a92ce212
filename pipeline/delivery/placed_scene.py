"""Places a splat whose coordinates are in a CRS, such as another program's, in a local frame on the earth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import NO_OFFSET, Scene, SplatOrigin
from splatpipe.pipeline.survey.crs.crs import parse_crs, to_geodetic, usable_for_maps
from splatpipe.pipeline.survey.crs.frames import Origin
from splatpipe.pipeline.survey.crs.world import World

MAX_SHEAR = 0.01  # share by which a CRS's units may differ by axis; projections stretch lengths by a tenth of it
SAMPLE = 200_000  # Gaussians whose median is the new origin


def placed_in_crs(scene: Scene, text: str, approximate: bool = False) -> Scene:
    """Read a splat's coordinates in a CRS, and move it to local east, north, up about its own middle.

    Positions are converted exactly, one by one; the Gaussians' sizes and rotations by the scale and the meridian
    convergence at the middle.

    Args:
        scene: Its coordinates, z up and with what was taken off them, are easting, northing and height.
        text: The CRS, as ``parse_crs`` reads it.
        approximate: As in ``open_operation``.

    Raises:
        SplatpipeError: if it has a place already, or the CRS is none of lengths, east and north, or cannot be used
            there.
    """
    if scene.facts.place is not None:
        raise SplatpipeError("The splat is georeferenced already.", hint="Its CRS is that of its place.")
    if not len(scene.gaussians):
        raise SplatpipeError("The splat has no Gaussians.", hint="There is nothing to place.")
    crs = parse_crs(text)
    if not usable_for_maps(crs):
        raise SplatpipeError(
            f"{crs.text} ({crs.name}) has degrees or counts to the west, so that no splat can be in it.",
            hint="Export the splat in projected coordinates, east and north.",
        )
    turned = scene.turned("z up")
    offset = np.array(turned.facts.offset)
    every = max(1, len(turned.gaussians) // SAMPLE)
    middle = offset + np.median(turned.gaussians.means[::every].double().numpy(), axis=0)
    located = to_geodetic(middle[None], crs, approximate)
    latitude, longitude, height_m = located.geodetic[0].tolist()
    world = World(Origin(latitude, longitude, height_m), crs.vertical, crs, located.operation)
    scale, rotation = _local_from_grid(world)
    gaussians = Gaussians.gathered(_moved(turned.gaussians, world, offset, scale, rotation), turned.gaussians)
    place = SplatOrigin(latitude, longitude, height_m, crs.vertical, crs.text, approximate)
    facts = replace(turned.facts, metres=True, place=place, offset=NO_OFFSET)
    return Scene(gaussians, facts, turned.notes)


def _local_from_grid(world: World) -> tuple[float, Float64[np.ndarray, "3 3"]]:
    """Scale and rotation from the CRS to the local frame at its origin.

    Raises:
        SplatpipeError: if the axes have different units.
    """
    derivative = np.linalg.inv(world.tangent(np.zeros((2, 3))).matrix[:3, :3])
    u, sizes, vt = np.linalg.svd(derivative)
    if sizes[0] > (1.0 + MAX_SHEAR) * sizes[2]:
        raise SplatpipeError(
            f"Heights in {world.crs.text} ({world.crs.name}) have another unit than eastings and northings.",
            hint="Export the splat in a CRS whose units are all the same.",
        )
    return float(sizes.prod() ** (1.0 / 3.0)), np.asarray(u @ vt)


def _moved(
    gaussians: Gaussians,
    world: World,
    offset: Float64[np.ndarray, " 3"],
    scale: float,
    rotation: Float64[np.ndarray, "3 3"],
) -> Iterator[Gaussians]:
    turn, nowhere = torch.from_numpy(rotation), torch.zeros(3, dtype=torch.float64)
    for piece in gaussians.pieces():
        local = world.local_from_crs(offset + piece.means.double().numpy())
        if not np.isfinite(local).all():
            raise SplatpipeError(
                f"{world.crs.text} ({world.crs.name}) is not defined at some of the splat's coordinates.",
                hint="Check the CRS, and remove what lies far away: splatpipe edit IN OUT --clean.",
            )
        yield replace(piece.transformed(scale, turn, nowhere), means=torch.from_numpy(local).float())
