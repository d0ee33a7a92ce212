"""Sound captures of odd places and kinds: nothing stops them, and nothing known contradicts their result."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from odd_sites import Site, flat, joined, orbit, place, strips

from splatpipe.pipeline.survey.crs.geodesy import Origin

BARE = ("place",)
FALSE_ALARMS = {"position-mirrored", "position-contradiction", "position-far", "position-impossible"}


def at(latitude: float, longitude: float, height: float = 100.0) -> Site:
    """A survey to and fro anywhere."""
    return replace(strips(35.0, count=3, each=6), place=Origin(latitude, longitude, height))


def strip(heading: float, **fields: object) -> Site:
    return replace(strips(heading, count=1, each=12, pitch=-60.0), **fields)


def levels(*sites: Site) -> Site:
    """Rings above each other."""
    return joined(*(replace(each, centres=np.add(each.centres, [0.0, 0.0, 15.0 * k])) for k, each in enumerate(sites)))


def tower() -> Site:
    """A mast of 60 m: rings around it, and no ground in view."""
    mast = np.random.default_rng(2).uniform([-2.0, -2.0, 0.0], [2.0, 2.0, 60.0], (200, 3))
    return replace(levels(*(orbit(9, 15.0, 10.0, 0.0) for _ in range(4))), ground=mast)


def cliff(takeoff: float) -> Site:
    """A wall of 120 m to the north, flown sideways, level, in three rows."""
    east = np.concatenate([np.arange(8) * 8.0, np.arange(8)[::-1] * 8.0, np.arange(8) * 8.0]) - 28.0
    centres = np.stack([east, np.zeros(24), np.repeat([40.0, 65.0, 90.0], 8)], axis=1)
    wall = np.random.default_rng(3).uniform([-50.0, 25.0, 0.0], [50.0, 30.0, 120.0], (200, 3))
    nose = np.zeros(24)
    return Site(centres, nose, np.zeros(24), wall, nose_deg=nose, takeoff_m=takeoff)


def hall() -> Site:
    """A hall from within: floor, ceiling, and a camera that looks level and up; positions from a total station."""
    ring = orbit(16, 6.0, 2.0, 0.0)
    box = np.random.default_rng(4).uniform([-12.0, -12.0, 0.0], [12.0, 12.0, 10.0], (200, 3))
    pitch = np.tile([0.0, 40.0], 8)
    return replace(ring, ground=box, pitch_deg=pitch, yaw_deg=ring.yaw_deg + 180.0, tags=BARE, noise_m=0.02)


def slope() -> Site:
    """A mountainside of 40 %, flown at one height above it."""
    site = strips(90.0, count=4, each=6)
    rise = np.array([0.0, 0.4])
    centres, ground = site.centres.copy(), flat()
    centres[:, 2] += centres[:, :2] @ rise
    ground[:, 2] += ground[:, :2] @ rise
    return replace(site, centres=centres, ground=ground)


def beneath() -> Site:
    """A bridge from beneath: nothing but its deck is seen, above flying cameras."""
    site = strips(90.0, count=3, each=6, height=12.0, pitch=70.0)
    return replace(site, ground=np.add(flat(), [0.0, 0.0, 30.0]), yaw_deg=np.full(18, 90.0))


def fixed_nose() -> Site:
    site = strips(90.0, count=4, each=6)
    return replace(site, yaw_deg=np.full(24, 30.0), nose_deg=np.full(24, 30.0))


def handheld() -> Site:
    """A walk around a house, held by hand, in portrait."""
    site = orbit(16, 15.0, 1.6, 5.0)
    house = np.random.default_rng(5).uniform([-6.0, -6.0, 0.0], [6.0, 6.0, 8.0], (200, 3))
    return replace(site, ground=house, tags=BARE, orientation=6)


def manned() -> Site:
    """From an aeroplane: 70 m/s, 900 m above the ground, no angles."""
    site = strips(20.0, count=3, each=6)
    return replace(
        site, centres=site.centres * [18.0, 18.0, 18.0], ground=flat(1400.0, 20.0), tags=BARE, step_s=3.1, noise_m=3.0
    )


def corridor() -> Site:
    """A road of 6 km."""
    way = np.arange(24) * 250.0
    centres = np.stack([way, 200.0 * np.sin(way / 900.0), np.full(24, 100.0)], axis=1)
    yaw = np.degrees(np.arctan2(900.0, 200.0 * np.cos(way / 900.0)))
    ground = np.random.default_rng(6).uniform([-200.0, -300.0, 0.0], [6000.0, 300.0, 3.0], (300, 3))
    return Site(centres, yaw, np.full(24, -90.0), ground, step_s=15.0)


def two_cameras() -> Site:
    return joined(strips(0.0, count=2, each=6), orbit(10))


SITES: dict[str, Callable[[], Site]] = {
    "the Dead Sea's shore": lambda: at(31.5, 35.48, -432.0),
    "Death Valley": lambda: at(36.24, -116.83, -85.0),
    "Patagonia": lambda: at(-50.3, -72.3),
    "Sydney": lambda: at(-33.86, 151.2),
    "Montana": lambda: at(46.87, -113.99),
    "across the equator": lambda: at(0.0, -78.45, 2800.0),
    "across Greenwich": lambda: at(51.478, 0.0),
    "across 180°": lambda: at(-16.8, 180.0),
    "just west of 180°": lambda: at(66.0, 179.9999),
    "the north pole": lambda: at(89.9995, 40.0, 3.0),
    "the south pole": lambda: at(-89.9995, -120.0, 2835.0),
    "Svalbard": lambda: at(78.2, 15.6),
    "a zone's border": lambda: at(52.0, 12.0),
    "a southern zone's border": lambda: at(-30.0, -54.0),
    "Everest": lambda: at(27.988, 86.925, 8700.0),
    "a strip to the north": lambda: strip(0.0),
    "a strip to the east": lambda: strip(90.0),
    "a strip flown backwards": lambda: strip(60.0, nose_deg=np.full(12, -120.0), yaw_deg=np.full(12, -120.0)),
    "a tower": tower,
    "a cliff from its top": lambda: cliff(110.0),
    "a cliff from its foot": lambda: cliff(0.0),
    "a hall": hall,
    "a mountainside": slope,
    "a valley below its station": lambda: replace(strips(70.0, each=6), takeoff_m=-260.0),
    "take-off above the ground that is flown": lambda: replace(strips(70.0, each=6), takeoff_m=45.5),
    "a bridge from beneath": beneath,
    "a nose that always points one way": fixed_nose,
    "a façade flown sideways around": lambda: orbit(18),
    "a walk in portrait": handheld,
    "a camera mounted upside down": lambda: replace(orbit(14), orientation=3),
    "an aeroplane": manned,
    "a corridor": corridor,
    "two flights": two_cameras,
    "RTK over ten metres": lambda: replace(orbit(14, 5.0, 6.0), noise_m=0.02),
    "times of one second": lambda: replace(orbit(14), step_s=0.0),
    "no times": lambda: replace(strips(10.0, count=3, each=6), step_s=None),
    "no altitudes": lambda: replace(orbit(16), altitude=False, tags=("angles", "place")),
    "heights above take-off only": lambda: replace(orbit(16), altitude=False),
    "no angles": lambda: replace(strips(10.0, count=3, each=6), tags=BARE),
    "a compass that is 25° off": lambda: replace(strips(10.0, count=3, each=6), compass_deg=25.0),
}


@pytest.mark.parametrize("name", SITES)
def test_an_odd_but_sound_site_is_neither_stopped_nor_contradicted(name: str) -> None:
    found = place(SITES[name]())
    assert found.stopped == ""
    assert found.says == ""
    assert not FALSE_ALARMS & set(found.issues)
