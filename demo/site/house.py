"""The house: walls with windows, pitched roof, dormer, chimneys, annex.

Plot coordinates: x along the ridge, the street at -y, z up, metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatpipe.demo.site.mesh import WORLD, Builder, Plane
from splatpipe.demo.site.textures import Painter, bricks, interior, mottled, painted, planks, plaster, roof_tiles, slabs

HALF_LENGTH, HALF_WIDTH = 6.0, 4.5
EAVES, RIDGE = 5.2, 8.8
SLOPE = (RIDGE - EAVES) / HALF_WIDTH

STONE = slabs(("a79c8a", "958a79", "b7ad9b", "8a8175", "a8977c"), "6f6759", 0.55, 0.3, 0.4)
FRAME = painted("e8e6df", 0.3)
CREAM = plaster("d9c6a0", "a58d6a")
NORTH_PLASTER = plaster("c9c3b4", "8f9079")
BRICK = bricks(("8d4a34", "a2593d", "b56e4b", "7a3d2e", "9c6148", "c0825e"), "b5aa9a")
CLADDING = planks(("7a5a3c", "8d6b49", "6b4c33", "a07d56"))
TILES = roof_tiles(("8f5340", "a2634a", "7d4a3c", "b27a5c", "6f4438", "9c6e58"))
SLATE = roof_tiles(("59616b", "6b727a", "4a515c", "7d8388", "66605f"))
METAL = painted("6f7274", 0.8)
SHEET = mottled(("7c8a80", "8f9a8c", "69756d", "9ba394"), 1.6, 0.15, 0.07)  # roof of the annex
WOOD = planks(("6a4a30", "7d5a3a", "5a3d28"), 0.14, 1.5)


@dataclass(frozen=True)
class HouseWindow:
    """An opening in a wall: lower left and upper right corner in the wall's plane, panes across, shutters or not."""

    left: float
    low: float
    right: float
    high: float
    panes: int = 2
    shutters: str = ""

    @property
    def hole(self) -> tuple[float, float, float, float]:
        return self.left, self.low, self.right, self.high


def add_window(b: Builder, wall: Plane, w: HouseWindow, seed: int, reveal: Painter) -> None:
    """Add a window: reveal, pane with a room behind, frame, mullions, sill, shutters."""
    depth = -0.16
    corners = [(w.left, w.low), (w.right, w.low), (w.right, w.high), (w.left, w.high)]
    for (u0, v0), (u1, v1) in zip(corners, corners[1:] + corners[:1], strict=True):
        start, end = wall.point(u0, v0, depth), wall.point(u1, v1, depth)
        side = Plane.make(end, start - end, wall.n)
        b.rect(side, (0, 0), (float(np.linalg.norm(end - start)), -depth), reveal)
    walls, curtains = ("6b6256", "57606b", "73675a", "4c5560"), ("e3ddd0", "c9a27c", "a9b7bf", "d8c6c9", "b7c2a4")
    glass = wall.at(w.left, w.low, depth + 0.02)
    room = interior(walls[seed % len(walls)], curtains[seed % len(curtains)])
    b.rect(glass, (0, 0), (w.right - w.left, w.high - w.low), room, gloss=True)
    bar, front = 0.07, depth + 0.08
    verticals = np.linspace(w.left, w.right - bar, w.panes + 1)
    for u in verticals:
        b.box(wall, (u, w.low, depth), (u + bar, w.high, front), FRAME)
    for v in (w.low, w.low + 0.68 * (w.high - w.low), w.high - bar):
        b.box(wall, (w.left + bar, v, depth), (w.right - bar, v + bar, front - 0.01), FRAME)
    b.box(wall, (w.left - 0.08, w.low - 0.09, -0.1), (w.right + 0.08, w.low, 0.1), STONE)
    if w.shutters:
        width = (w.right - w.left) / 2
        for left in (w.left - width - 0.04, w.right + 0.04):
            b.box(wall, (left, w.low, 0.0), (left + width, w.high, 0.045), planks((w.shutters,), 0.12, 2.0))


def add_wall(
    b: Builder,
    wall: Plane,
    outline: Sequence[tuple[float | int, float | int]],
    windows: Sequence[HouseWindow],
    paint: Painter,
    seed: int,
) -> None:
    """Add a wall with its windows."""
    b.wall(wall, outline, [w.hole for w in windows], paint)
    for k, window in enumerate(windows):
        add_window(b, wall, window, seed + k, paint)


def _walls(b: Builder) -> None:
    length, width = 2 * HALF_LENGTH, 2 * HALF_WIDTH
    green, blue = "4f6f5c", "54708a"
    south = Plane.make((-HALF_LENGTH, -HALF_WIDTH, 0), (1, 0, 0), (0, 0, 1))
    front = [HouseWindow(a, 0.95, a + 1.2, 2.35, 2, green) for a in (1.2, 3.9)] + [
        HouseWindow(9.3, 0.95, 10.9, 2.35, 3)
    ]
    front += [HouseWindow(a, 3.35, a + 1.15, 4.65, 2, green) for a in (1.2, 3.9)]
    front += [HouseWindow(6.75, 3.35, 7.65, 4.65, 1), HouseWindow(9.5, 3.35, 10.7, 4.65, 2, green)]
    box = [(0.0, 0.0), (length, 0.0), (length, EAVES), (0.0, EAVES)]
    add_wall(b, south, box, front, CREAM, 0)
    north = Plane.make((HALF_LENGTH, HALF_WIDTH, 0), (-1, 0, 0), (0, 0, 1))
    back = [HouseWindow(4.6, 0.35, 7.2, 2.45, 3), HouseWindow(1.3, 1.0, 2.6, 2.3), HouseWindow(9.0, 0.95, 10.5, 2.3, 3)]
    back += [HouseWindow(a, 3.35, a + 1.2, 4.6, 2, blue) for a in (1.4, 5.3, 9.2)]
    add_wall(b, north, box, back, NORTH_PLASTER, 20)
    gable = [(0.0, 0.0), (width, 0.0), (width, EAVES), (width / 2, RIDGE), (0.0, EAVES)]
    west = Plane.make((-HALF_LENGTH, HALF_WIDTH, 0), (0, -1, 0), (0, 0, 1))
    side = [
        HouseWindow(1.4, 0.95, 2.6, 2.3),
        HouseWindow(5.9, 0.95, 7.6, 2.3, 3),
        HouseWindow(1.5, 3.3, 2.6, 4.6),
        HouseWindow(6.2, 3.3, 7.3, 4.6),
    ]
    add_wall(b, west, gable, side, BRICK, 40)
    east = Plane.make((HALF_LENGTH, -HALF_WIDTH, 0), (0, 1, 0), (0, 0, 1))
    add_wall(b, east, gable, [HouseWindow(1.6, 3.9, 2.7, 5.0), HouseWindow(6.2, 3.9, 7.3, 5.0)], CREAM, 60)
    for plane, paint, seed in ((west, CLADDING, 50), (east, CLADDING, 70)):
        attic = plane.at(0, 0, 0.05)
        b.polygon(attic, [(1.0, EAVES + 0.8), (8.0, EAVES + 0.8), (4.5, RIDGE - 0.05)], paint)
        b.box(attic, (3.9, EAVES + 1.0, -0.02), (5.1, EAVES + 2.1, 0.02), FRAME)
        b.rect(attic.at(0, 0, 0.025), (4.0, EAVES + 1.1), (5.0, EAVES + 2.0), interior("57606b", "d8c6c9"), gloss=True)
        add_window_bars(b, attic, seed)
    for plane, span in ((south, length), (north, length), (west, width), (east, width)):
        b.box(plane, (-0.06, 0.0, -0.1), (span + 0.06, 0.45, 0.06), STONE)
        for k in range(15):  # quoins
            reach = 0.5 if k % 2 else 0.3
            low = 0.45 + k * 0.315
            b.box(plane, (-0.03, low, -0.1), (reach, low + 0.3, 0.035), STONE)
            b.box(plane, (span - reach, low, -0.1), (span + 0.03, low + 0.3, 0.035), STONE)


def add_window_bars(b: Builder, attic: Plane, seed: int) -> None:
    """Add the cross in an attic window; its position varies slightly."""
    middle = 4.47 + 0.01 * (seed % 3)
    b.box(attic, (middle, EAVES + 1.1, 0.0), (middle + 0.06, EAVES + 2.0, 0.045), FRAME)
    b.box(attic, (4.0, EAVES + 1.52, 0.0), (5.0, EAVES + 1.58, 0.04), FRAME)


def _slope_planes() -> tuple[Plane, Plane]:
    """South and north roof planes: origin at mid-length on the wall's top, u along the ridge, v up the slope."""
    south = Plane.make((0, -HALF_WIDTH, EAVES), (1, 0, 0), (0, HALF_WIDTH, RIDGE - EAVES))
    north = Plane.make((0, HALF_WIDTH, EAVES), (-1, 0, 0), (0, -HALF_WIDTH, RIDGE - EAVES))
    return south, north


def _roof(b: Builder) -> None:
    rise = float(np.hypot(HALF_WIDTH, RIDGE - EAVES))
    reach = HALF_LENGTH + 0.45
    south, north = _slope_planes()
    for plane in (south, north):
        b.box(plane, (-reach, -0.65, 0.02), (reach, rise, 0.2), WOOD, top=TILES)
        eaves = plane.point(-reach, -0.65)
        gutter = Plane.make(eaves, plane.u, np.cross((0, 0, 1), plane.u))
        b.box(gutter, (0.0, -0.16, -0.06), (2 * reach, 0.0, 0.08), METAL)
    b.box(
        WORLD,
        (-reach, -0.2, RIDGE + 0.13),
        (reach, 0.2, RIDGE + 0.32),
        roof_tiles(("8a4030", "a2523a", "743629"), 0.4, 0.6),
    )
    for x, y in ((-6.12, -4.62), (6.04, -4.62), (-6.12, 4.54), (6.04, 4.54)):
        b.box(WORLD, (x, y, 0.1), (x + 0.09, y + 0.09, EAVES - 0.3), METAL)
    panel = painted("1f2c47", 1.0)
    for i in range(4):  # photovoltaics
        for j in range(2):
            low = (1.35 + i * 1.08, 0.9 + j * 1.72, 0.26)
            b.box(south, low, (low[0] + 1.03, low[1] + 1.66, 0.30), painted("b9bcc0", 0.2), top=_cells_painter(panel))
    for u in (-3.6, -0.6, 2.6):  # skylights
        b.box(north, (u, 2.1, 0.2), (u + 0.95, 3.4, 0.29), painted("4c4a48"))
        b.rect(north.at(0, 0, 0.295), (u + 0.09, 2.2), (u + 0.86, 3.3), interior("6b6256", "e3ddd0"), gloss=True)
    b.box(north, (4.0, 1.2, 0.2), (4.5, 1.7, 0.5), METAL)


def _cells_painter(base: Painter) -> Painter:
    """Solar panel: cells with thin bright lines and slightly different blues."""
    grid = slabs(("1d2a45", "24365a", "1a2338", "2c3f63"), "7f8a99", 0.17, 0.17, 0.3)
    return lambda tile: 0.35 * base(tile) + 0.65 * grid(tile)


def _chimneys(b: Builder) -> None:
    for x, y, top, w, paint in ((-4.3, 1.0, 10.3, 0.5, BRICK), (3.4, 2.6, 8.9, 0.36, plaster("b9ab93", "6f6555", 1.4))):
        b.box(WORLD, (x - w, y - w * 0.8, 5.5), (x + w, y + w * 0.8, top), paint)
        b.box(WORLD, (x - w - 0.1, y - w * 0.8 - 0.1, top), (x + w + 0.1, y + w * 0.8 + 0.1, top + 0.14), STONE)
        for shift in (-0.22, 0.22) if w > 0.4 else (0.0,):
            b.box(
                WORLD,
                (x + shift - 0.13, y - 0.13, top + 0.14),
                (x + shift + 0.13, y + 0.13, top + 0.55),
                painted("a0533a", 1.0),
            )


def _dormer(b: Builder) -> None:
    x0, x1, front, low, eaves, ridge = -3.5, -1.1, -3.4, 5.7, 7.15, 8.2
    middle, half = (x0 + x1) / 2, (x1 - x0) / 2
    face = Plane.make((x0, front, 0), (1, 0, 0), (0, 0, 1))
    outline = [(0.0, low), (2 * half, low), (2 * half, eaves), (half, ridge), (0.0, eaves)]
    add_wall(
        b, face, outline, [HouseWindow(0.45, 6.25, 1.95, 7.1, 3)], planks(("c3b596", "b2a383", "d0c4a8"), 0.18, 1.6), 80
    )
    for origin, u in (((x1, front, 0), (0, 1, 0)), ((x0, -0.5, 0), (0, -1, 0))):
        b.rect(Plane.make(origin, u, (0, 0, 1)), (0, low), (2.9, eaves), CLADDING)
    rise = float(np.hypot(half, ridge - eaves))
    for sign in (-1, 1):
        slope = Plane.make((middle + sign * half, -0.3, eaves), (0, sign, 0), (-sign * half, 0, ridge - eaves))
        start = -3.5 if sign > 0 else 0.0
        b.box(slope, (start, -0.3, 0.0), (start + 3.5, rise + 0.05, 0.12), WOOD, top=SLATE)


def _entrance(b: Builder) -> None:
    door = Plane.make((0.75, -HALF_WIDTH, 0), (1, 0, 0), (0, 0, 1))
    b.box(door, (-0.15, 0.0, 0.0), (1.25, 2.75, 0.07), STONE)
    b.box(door, (0.0, 0.45, 0.0), (1.1, 2.6, 0.1), planks(("7b2f2a", "8b3a31", "6a2722"), 0.27, 2.2))
    b.rect(door.at(0.3, 1.6, 0.105), (0, 0), (0.5, 0.7), interior("57606b", "d9d2c3"), gloss=True)
    for k, height in enumerate((0.15, 0.3, 0.45)):
        b.box(WORLD, (0.2 - 0.35 * (2 - k), -6.0 - 0.34 * (2 - k), 0.0), (2.4 + 0.35 * (2 - k), -4.5, height), STONE)
    canopy = Plane.make((-0.1, -6.15, 2.85), (1, 0, 0), (0, 1.65, 0.5))
    b.box(canopy, (0.0, 0.0, 0.0), (2.8, 1.75, 0.1), WOOD, top=SLATE)
    for x in (0.05, 2.4):
        b.box(WORLD, (x, -6.0, 0.45), (x + 0.14, -5.86, 2.9), WOOD)


def _annex(b: Builder) -> None:
    """Garage on the east side with a lean-to roof."""
    x1, y0, y1, low, high = 10.6, -2.6, 4.0, 2.7, 3.6
    stone = bricks(("b9a98c", "a89878", "c9bca1", "988a70", "ad9a83"), "8d8371", 0.5, 0.25)
    front = Plane.make((HALF_LENGTH, y0, 0), (1, 0, 0), (0, 0, 1))
    span = x1 - HALF_LENGTH
    b.rect(front, (0, 0), (span, low), stone)
    b.polygon(front, [(0, low), (span, low), (0, high)], stone)
    back = Plane.make((x1, y1, 0), (-1, 0, 0), (0, 0, 1))
    add_wall(b, back, [(0, 0), (span, 0), (span, low), (0, low)], [HouseWindow(1.2, 0.9, 2.6, 2.0)], stone, 90)
    b.polygon(back, [(0, low), (span, low), (span, high)], stone)
    side = Plane.make((x1, y0, 0), (0, 1, 0), (0, 0, 1))
    add_wall(
        b,
        side,
        [(0, 0), (y1 - y0, 0), (y1 - y0, low), (0, low)],
        [HouseWindow(1.5, 1.1, 2.7, 2.0), HouseWindow(4.0, 1.1, 5.2, 2.0)],
        stone,
        94,
    )
    b.box(front, (0.7, 0.02, 0.0), (3.6, 2.3, 0.06), planks(("8c9aa3", "7d8c96", "9aa7ae"), 0.3, 3.5))
    b.rect(front.at(0, 0, 0.065), (0.9, 1.75), (3.4, 2.1), interior("4c5560", "a9b7bf"), gloss=True)
    roof = Plane.make((x1, y0, low), (0, 1, 0), (-span, 0, high - low))
    length = float(np.hypot(span, high - low))
    b.box(roof, (-0.35, -0.4, 0.0), (y1 - y0 + 0.35, length, 0.14), WOOD, top=SHEET)
    for u in np.arange(0.3, y1 - y0, 1.1):  # standing seams
        b.box(roof, (u, -0.4, 0.14), (u + 0.06, length, 0.2), METAL)


def add_house(b: Builder) -> None:
    """Add everything that belongs to the building."""
    _walls(b)
    _roof(b)
    _chimneys(b)
    _dormer(b)
    _entrance(b)
    _annex(b)
