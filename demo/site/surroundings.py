"""The house's surroundings: ground, van, shed, fence, trees, neighbours, hills. Plot coordinates as in house.py."""

from __future__ import annotations

import cv2
import numpy as np

from splatpipe.demo.site.mesh import WORLD, Array, Builder, Face, Plane, Superellipsoid
from splatpipe.demo.site.textures import (
    Image,
    Painter,
    TextureTile,
    blobs,
    bricks,
    colour,
    fractal,
    interior,
    mix,
    mottled,
    noise,
    painted,
    planks,
    plaster,
    roof_tiles,
    slabs,
    smooth,
)

NEAR, FAR = 32.0, 320.0  # half sizes of the flat plot and of the land around it, metres
NEAR_TEXEL, FAR_TEXEL = 0.016, 0.16

LAWN = mottled(("6a7a3c", "7d8548", "5c6b34", "8f8a55", "526231"), 3.2, 0.2, 0.12)
FIELD = mottled(("76813f", "938f50", "5d7036", "a69a5c", "4f632f"), 40.0, 3.0, 0.07)
SOIL = mottled(("5c4634", "6f5540", "4a382a", "806348"), 0.9, 0.15, 0.1)
GRAVEL = mottled(("a89f8d", "bcb29d", "918878", "c6bda8"), 0.8, 0.15, 0.07)
ASPHALT = mottled(("5d5d5c", "696967", "4e4f50", "757370", "454647"), 2.6, 0.2, 0.06)
PAVERS = slabs(("9d8f7d", "8a7c6d", "ada08c", "7d7368", "a3866f"), "5f574d", 0.4, 0.25, 0.4)
TERRACE = slabs(("b0a08a", "a08f78", "bfb19b", "8f8270", "a58f7f"), "6a6152", 0.8, 0.6, 0.4)
SIDEWALK = slabs(("a4a19b", "959189", "b0ada6", "87847e"), "6b6862", 0.9, 0.9, 0.4)
FENCE = planks(("7d6247", "8f7353", "6a523b", "a18360"), 0.16, 2.4)
STONE_WALL = bricks(("a0968a", "8f8577", "b0a698", "7c7368", "9a8a72"), "6d655a", 0.45, 0.22)

LEAVES = {
    "oak": ("27381a", "3c5226", "567034", "74883f"),
    "birch": ("3a4a20", "5a6c2c", "7f8c3c", "a5a652"),
    "maple": ("4a2a1c", "7a4424", "a5652c", "c08a3c"),
    "pine": ("1c2c22", "2c4432", "41604a", "5a7a5c"),
}


def _blend(
    base: Image, tile: TextureTile, area: tuple[float, float, float, float], paint: Painter, ragged: float = 0.0
) -> Image:
    """Paint a rectangle (x0, y0, x1, y1) of the ground; its border varies by ``ragged`` metres."""
    x0, y0, x1, y1 = area
    cols = np.flatnonzero((tile.u - NEAR > x0 - 2 * ragged) & (tile.u - NEAR < x1 + 2 * ragged))
    rows = np.flatnonzero((tile.v - NEAR > y0 - 2 * ragged) & (tile.v - NEAR < y1 + 2 * ragged))
    part = TextureTile(tile.u[cols[0] : cols[-1] + 1], tile.v[rows[0] : rows[-1] + 1], tile.texel_m, tile.rng)
    u, v = part.u[None, :] - NEAR, part.v[:, None] - NEAR
    inside = np.minimum(np.minimum(u - x0, x1 - u), np.minimum(v - y0, y1 - v))
    if ragged:
        inside = inside + 0.5 * ragged * np.clip(fractal(part, 2.0, 0.3), -2, 2)
    window = np.s_[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
    base[window] = mix(base[window], paint(part), smooth(inside.astype(np.float32), -0.01, 0.02 + 0.3 * ragged))
    return base


def _plot(far: Image) -> Painter:
    """The flat plot, which fades into the land around it (``far``: that texture) towards its border."""

    def paint(tile: TextureTile) -> Image:
        base = LAWN(tile)
        base = mix(base, colour("4c5a2b"), 0.4 * smooth(noise(tile, 0.42), 0.9, 1.9))  # tufts
        base = mix(base, colour("a09a62"), 0.4 * smooth(noise(tile, 0.33), 1.2, 2.1))
        base = mix(base, colour("9a9460"), 0.6 * blobs(tile, 4.0, 0.15))
        flowers = smooth(noise(tile, 0.3), 1.5, 1.9) * blobs(tile, 3.0, 0.10)
        base = mix(
            base,
            mix(np.broadcast_to(colour("c8b04a"), base.shape), colour("b9556a"), blobs(tile, 2.0, 0.4)),
            0.8 * flowers,
        )
        base = _blend(base, tile, (-40, -24.5, 40, -17.5), ASPHALT)
        base = _blend(base, tile, (-40, -17.5, 40, -15.9), SIDEWALK)
        for x in np.arange(-31, 32, 6.0):
            base = _blend(base, tile, (x, -21.1, x + 3.0, -20.95), painted("d9d7cf", 1.0))
        base = _blend(base, tile, (-9.5, -23.6, -5.0, -21.6), mottled(("45474a", "3a3c40", "55565a"), 1.2, 0.2), 0.3)
        base = _blend(base, tile, (0.1, -15.9, 2.5, -6.0), PAVERS)
        base = _blend(
            base, tile, (6.0, -15.9, 10.8, -2.6), mottled(("8f8a82", "a09a90", "7d7872", "b0a898"), 1.6, 0.2, 0.06)
        )
        base = _blend(base, tile, (7.0, -12.4, 9.6, -9.0), mottled(("5b5650", "77716a"), 1.0, 0.2), 0.5)
        base = _blend(base, tile, (-5.0, 4.5, 4.2, 10.2), TERRACE)
        base = _blend(base, tile, (-7.1, -5.6, 0.0, -4.5), SOIL, 0.15)
        base = _blend(base, tile, (2.7, -5.6, 5.8, -4.5), SOIL, 0.15)
        base = _blend(base, tile, (-7.2, -4.5, -6.0, 4.5), GRAVEL)
        base = _blend(base, tile, (6.5, 11.0, 12.5, 15.0), SOIL, 0.3)
        base = _blend(base, tile, (-14.5, -12.5, -10.5, -8.5), SOIL, 0.9)
        for k in range(9):
            x, y = -5.5 - 0.75 * k, 8.0 + 0.9 * np.sin(0.9 * k)
            base = _blend(base, tile, (x - 0.3, y - 0.25, x + 0.3, y + 0.25), TERRACE, 0.05)
        u, v = tile.u[None, :] - NEAR, tile.v[:, None] - NEAR
        edge = NEAR - np.maximum(np.abs(u), np.abs(v)).astype(np.float32)
        size = round(2 * NEAR / FAR_TEXEL)
        start = round((FAR - NEAR) / FAR_TEXEL)
        crop = far[start : start + size, start : start + size]
        scale = FAR_TEXEL / tile.texel_m
        at = [((axis / tile.texel_m) / scale - 0.5).astype(np.float32) for axis in (tile.u, tile.v)]
        across, up = np.meshgrid(*at)
        outer = cv2.remap(crop, across, up, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return mix(base, outer, 1 - smooth(edge, 0.1, 3.0))

    return paint


def _land(seed: int) -> Image:
    """The far land's texture (rows grow with y): fields, a few ploughed strips, the street going on."""
    count = round(2 * FAR / FAR_TEXEL)
    axis = ((np.arange(count) + 0.5) * FAR_TEXEL).astype(np.float32)
    tile = TextureTile(axis, axis, FAR_TEXEL, np.random.default_rng(seed))
    base = FIELD(tile)
    for code, share in (("8a7350", 0.12), ("b5a766", 0.14), ("4a6034", 0.15)):
        base = mix(base, colour(code), 0.8 * blobs(tile, 60.0, share))
    v = tile.v[:, None] - FAR
    street = smooth(np.minimum(v + 24.5, -15.9 - v) * np.ones((1, count), np.float32), -0.1, 0.1)
    return mix(base, ASPHALT(tile), street)


def _heights(x: Array, y: Array) -> Array:
    """Flat in the plot, hills beyond."""
    r = np.hypot(x, y)
    rise = np.clip((r - 48) / 260, 0, 1)
    waves = 0.55 + 0.25 * np.sin(x / 43 + 1.0) * np.cos(y / 51) + 0.2 * np.sin((x + 1.7 * y) / 70 + 2)
    return np.asarray(58 * rise**1.6 * waves)


def _ground(b: Builder, seed: int) -> None:
    far = _land(seed)
    b.rect(WORLD, (-NEAR, -NEAR), (NEAR, NEAR), _plot(far), texel_m=NEAR_TEXEL)
    lines = np.unique(
        np.concatenate([np.linspace(-FAR, -NEAR, 19), np.linspace(-NEAR, NEAR, 5), np.linspace(NEAR, FAR, 19)])
    )
    y, x = np.meshgrid(lines, lines, indexing="ij")
    vertices = np.stack([x, y, _heights(x, y)], -1).reshape(-1, 3)
    n = len(lines)
    quads = [
        (j * n + i)
        for j in range(n - 1)
        for i in range(n - 1)
        if max(abs(lines[i] + lines[i + 1]), abs(lines[j] + lines[j + 1])) / 2 > NEAR
    ]
    first = np.array(quads)
    triangles = np.vstack([np.c_[first, first + 1, first + n + 1], np.c_[first, first + n + 1, first + n]])
    vertices, triangles = vertices[triangles.ravel()], np.arange(triangles.size).reshape(-1, 3)  # flat shading
    b.add(Face(vertices, triangles, vertices[:, :2] + FAR, lambda tile: _pad(far, tile), FAR_TEXEL))


def _pad(image: Image, tile: TextureTile) -> Image:
    rows, cols = tile.shape[0] - image.shape[0], tile.shape[1] - image.shape[1]
    return np.pad(image, ((rows // 2, rows - rows // 2), (cols // 2, cols - cols // 2), (0, 0)), mode="edge")


def _van(b: Builder, at: tuple[float, float], heading: float, base: str) -> None:
    """A delivery van: body in profile, windows, wheels, bumpers. ``at`` is under its rear left corner."""
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    side = Plane.make((*at, 0.0), along, (0, 0, 1))
    profile = [(0.0, 0.35), (5.2, 0.35), (5.25, 0.95), (4.75, 1.3), (4.15, 2.1), (3.8, 2.3), (0.1, 2.35), (0.0, 2.2)]
    body = painted(base, 1.0)
    b.prism(side.at(0, 0, -1.9), profile, 1.9, body, body, gloss=True)
    for plane in (side.at(0, 0, 0.01), Plane(side.point(5.25, 0, -1.91), -side.u, side.v)):
        flip = plane.u @ side.u < 0
        glass = [(3.05, 1.35), (4.35, 1.35), (3.95, 2.05), (3.05, 2.05)]
        outline = [(5.25 - u, v) for u, v in reversed(glass)] if flip else glass
        b.polygon(plane, outline, interior("3a4048", "57606b"), gloss=True)
        b.rect(
            plane,
            (0.9, 1.0) if not flip else (2.3, 1.0),
            (2.7, 1.95) if not flip else (4.3, 1.95),
            mottled(("c8a03c", "2f5f7a", "b5452f", "e3ddd0"), 0.9, 0.1, 0.04),
        )
    screen = Plane.make(side.point(4.735, 1.33, 0), -side.n, side.point(4.16, 2.1) - side.point(4.735, 1.33))
    b.rect(screen.at(0, 0, 0.012), (0.15, 0.05), (1.75, 0.85), interior("3a4048", "4c5560"), gloss=True)
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    ring = np.c_[np.cos(angles), np.sin(angles)]
    for u in (1.0, 4.2):
        for depth in (-1.93, -0.2):
            b.prism(side.at(u, 0.36, depth), 0.36 * ring, 0.23, painted("26272a", 1.0), painted("3a3c40", 1.0))
            b.prism(side.at(u, 0.36, depth - 0.01), 0.2 * ring, 0.25, painted("a9acb0", 1.0), painted("a9acb0", 1.0))
    b.box(side, (-0.08, 0.3, -1.85), (0.0, 0.55, -0.05), painted("3a3c40", 1.0))
    b.box(side, (5.2, 0.3, -1.85), (5.36, 0.6, -0.05), painted("3a3c40", 1.0))


def gabled(b: Builder, plane: Plane, size: tuple[float, float, float, float], wall: Painter, roof: Painter) -> None:
    """A plain gabled building: length, width, eaves and ridge height, about the plane's origin; ridge along u."""
    length, width, eaves, ridge = size
    x, y = length / 2, width / 2
    box = [(0, 0), (length, 0), (length, eaves), (0, eaves)]
    gable = [(0, 0), (width, 0), (width, eaves), (width / 2, ridge), (0, eaves)]
    u, v, n = plane.u, plane.v, plane.n
    for origin, axis, outline in (((-x, -y), u, box), ((x, y), -u, box), ((x, -y), v, gable), ((-x, y), -v, gable)):
        b.wall(Plane(plane.point(*origin), axis, n), outline, [], wall)
    rise = float(np.hypot(y, ridge - eaves))
    for sign in (-1, 1):
        start = plane.point(0, sign * y, eaves)
        slope = Plane.make(start, -sign * u, plane.point(0, 0, ridge) - start)
        b.box(slope, (-x - 0.3, -0.4, 0.0), (x + 0.3, rise, 0.12), wall, top=roof)


def _garden(b: Builder) -> None:
    shed = Plane.make((-11.5, 10.5, 0), (np.cos(0.4), np.sin(0.4), 0), (-np.sin(0.4), np.cos(0.4), 0))
    gabled(
        b,
        shed,
        (4.2, 3.0, 2.1, 3.2),
        planks(("7f5238", "93643f", "6b442f", "a87a50")),
        roof_tiles(("4f5a4c", "646d58", "3f4a40"), 0.5, 0.4),
    )
    door = Plane(shed.point(-0.9, -1.5), shed.u, shed.n)
    b.box(door, (0.0, 0.05, 0.0), (1.1, 1.95, 0.05), painted("4f6f5c", 1.0))
    b.rect(door.at(1.5, 0.9, 0.01), (0, 0), (0.9, 0.7), interior("4c5560", "c9a27c"), gloss=True)
    b.box(WORLD, (-2.2, 6.6, 0.7), (0.2, 7.6, 0.78), planks(("9a7450", "b08a60", "86633f")))
    for x in (-2.0, -0.2):
        b.box(WORLD, (x, 6.75, 0.0), (x + 0.12, 7.45, 0.7), planks(("86633f",)))
    for y in (5.95, 7.9):
        b.box(WORLD, (-2.1, y, 0.38), (0.1, y + 0.35, 0.45), planks(("9a7450", "86633f")))
        b.box(WORLD, (-1.9, y + 0.05, 0.0), (-0.1, y + 0.3, 0.38), planks(("6a4a30",)))
    for k, (x, y) in enumerate([(2.6, 9.4), (3.6, 9.4), (-4.7, 9.6), (3.9, -6.0), (-0.9, -6.1)]):
        b.box(WORLD, (x, y, 0.0), (x + 0.55, y + 0.55, 0.5), painted(("a0533a", "6f7a82", "8a7a5a")[k % 3], 1.0))
        _foliage(b, (x + 0.27, y + 0.27, 0.75), (0.38, 0.38, 0.4), 300 + k, ("maple", "birch", "oak")[k % 3], 4)
    for k in range(3):  # bins
        b.box(
            WORLD,
            (5.0 + 0.75 * k, 4.75, 0.0),
            (5.6 + 0.75 * k, 5.4, 1.1),
            painted(("3f5a45", "4a4f57", "7a6a3a")[k], 1.0),
        )
    b.box(WORLD, (11.2, 0.5, 0.0), (12.0, 3.4, 1.3), mottled(("a58258", "7d5c3c", "c3a070", "5c4430"), 0.3, 0.1, 0.1))
    trampoline = (
        1.7
        * np.c_[
            np.cos(np.linspace(0, 2 * np.pi, 20, endpoint=False)), np.sin(np.linspace(0, 2 * np.pi, 20, endpoint=False))
        ]
    )
    b.prism(
        WORLD.at(-9.5, 4.5, 0.55),
        trampoline,
        0.12,
        painted("2f6f8a", 1.0),
        mottled(("2c3038", "3c424c", "23262c", "4c5a6a"), 0.8, 0.12, 0.1),
    )
    for k in range(4):  # raised vegetable beds
        x = 6.8 + 1.45 * k
        b.box(
            WORLD,
            (x, 11.4, 0.0),
            (x + 1.1, 14.6, 0.4),
            planks(("7d6247", "6a523b")),
            top=mottled(("4a382a", "5a7a34", "7f9a44", "38512a", "a0563c"), 0.8, 0.15, 0.1),
        )


def _borders(b: Builder) -> None:
    for x0, x1 in ((-17.0, -0.2), (2.8, 5.6), (11.2, 17.0)):  # stone wall to the street
        b.box(WORLD, (x0, -15.9, 0.0), (x1, -15.55, 0.9), STONE_WALL)
        b.box(
            WORLD,
            (x0 - 0.05, -15.97, 0.9),
            (x1 + 0.05, -15.48, 1.0),
            slabs(("a4a19b", "8f8b84", "b5b1a9"), "6b6862", 0.8, 0.6),
        )
    for x in (-0.45, 2.8, 5.4, 11.2):
        b.box(WORLD, (x, -16.0, 0.0), (x + 0.5, -15.5, 1.5), BRICK_POST)
    for start in np.arange(-15.4, 17.0, 2.5):  # fence panels
        b.box(WORLD, (17.0, start, 0.05), (17.06, start + 2.42, 1.6), FENCE)
        b.box(WORLD, (16.96, start - 0.1, 0.0), (17.1, start, 1.75), FENCE)
    _hedges(b)


def _hedges(b: Builder) -> None:
    for k, y in enumerate(np.arange(-12.5, 16.0, 4.6)):
        _foliage(b, (-17.0, y, 0.75), (0.75, 2.45, 1.0), 400 + k, "oak", 5, 8.0)
    for k, x in enumerate(np.arange(-14.5, 16.0, 4.8)):
        _foliage(b, (x, 17.2, 0.8), (2.55, 0.8, 1.1), 430 + k, "oak" if k % 2 else "birch", 5, 8.0)


BRICK_POST = bricks(("8d4a34", "a2593d", "b56e4b", "7a3d2e"), "b5aa9a", 0.25, 0.125)


def _foliage(
    b: Builder,
    centre: tuple[float, float, float],
    radii: tuple[float, float, float],
    seed: int,
    leaves: str,
    n: int,
    squareness: float = 2.0,
) -> None:
    texel = 0.02 if max(radii) < 4 and np.hypot(*centre[:2]) < 25 else 0.06
    palette = tuple(colour(c) for c in LEAVES[leaves])
    for face in Superellipsoid(np.array(centre), np.array(radii), seed, n, squareness, palette, texel).faces():
        b.add(face)


def _tree(b: Builder, x: float, y: float, height: float, seed: int, leaves: str, n: int) -> None:
    """A trunk and a crown of one to three lumps."""
    rng = np.random.default_rng(seed)
    ground = float(_heights(np.array(x), np.array(y)))
    crown = 0.36 * height
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    trunk = WORLD.at(x, y, ground)
    b.prism(
        trunk,
        0.028 * height * np.c_[np.cos(angles), np.sin(angles)],
        0.45 * height,
        planks(("5c4a38", "6f5a44", "4a3a2c")),
        painted("5c4a38"),
    )
    _foliage(b, (x, y, ground + height - crown), (0.30 * height, 0.30 * height, crown), seed, leaves, n)
    if n >= 8:
        for k in range(2):
            turn = rng.uniform(0, 2 * np.pi)
            at = (
                x + 0.17 * height * np.cos(turn),
                y + 0.17 * height * np.sin(turn),
                ground + height * rng.uniform(0.48, 0.6),
            )
            _foliage(b, at, (0.22 * height, 0.22 * height, 0.2 * height), seed + 50 + k, leaves, n - 3)


def _trees(b: Builder) -> None:
    near = [
        (-13.5, -11, 5.2, "maple"),
        (13.8, -12.5, 4.6, "birch"),
        (-13.8, 2.2, 5.6, "oak"),
        (13.6, 8.6, 5.4, "birch"),
        (-5.5, 14.2, 4.6, "maple"),
        (3.0, 14.6, 4.0, "oak"),
    ]
    for k, (x, y, height, leaves) in enumerate(near):
        _tree(b, x, y, height, 500 + 7 * k, leaves, 9)
    bushes = [
        (-6.4, -5.1, 0.55),
        (-4.9, -5.0, 0.45),
        (-3.2, -5.1, 0.6),
        (-1.6, -5.0, 0.5),
        (3.2, -5.1, 0.5),
        (4.6, -5.0, 0.6),
        (-11, -9.5, 0.9),
        (-9.2, -12.8, 0.8),
    ]
    for k, (x, y, r) in enumerate(bushes):
        _foliage(b, (x, y, 0.7 * r), (r, r, 0.9 * r), 700 + k, ("birch", "oak", "maple")[k % 3], 5)
    rng = np.random.default_rng(11)
    for k in range(46):
        turn, r = 2 * np.pi * (k + rng.uniform(0, 0.8)) / 46, rng.uniform(38, 88)
        x, y = r * np.cos(turn), r * np.sin(turn)
        if abs(y + 20) < 7:  # the street is kept free
            continue
        _tree(b, x, y, rng.uniform(6, 11), 900 + 7 * k, rng.choice(list(LEAVES)), 4)


def _neighbours(b: Builder) -> None:
    coarse = Builder(texel_m=0.04)
    walls = ("d8cdb8", "c4a68a", "b9bfc0", "cfc3a0", "a8583f", "d2c9c4", "bfae97")
    roofs = (("8a4030", "a05540", "70352a"), ("5a616a", "6f757b", "474d55"), ("9c5a40", "b0704f", "804632"))
    for k, (x, y, turn) in enumerate(
        [(-33, -36, 0.1), (-4, -39, -0.05), (27, -37, 0.2), (47, 6, 1.4), (40, 33, 0.8), (-46, 12, 1.7), (-12, 50, 0.2)]
    ):
        ground = float(_heights(np.array(float(x)), np.array(float(y)))) - 0.5
        plane = Plane.make((x, y, ground), (np.cos(turn), np.sin(turn), 0), (-np.sin(turn), np.cos(turn), 0))
        size = (10 + k % 3 * 1.5, 8.0, 4.6 + 0.4 * (k % 2), 8.0 + 0.5 * (k % 3))
        gabled(coarse, plane, size, plaster(walls[k], "8f8370", 0.6), roof_tiles(roofs[k % 3], 0.8, 0.7))
        _facade(coarse, plane, size, k)
    b.faces.extend(coarse.faces)


def _facade(b: Builder, plane: Plane, size: tuple[float, float, float, float], seed: int) -> None:
    """Flat windows on the four sides of a neighbour's house."""
    length, width, _, _ = size
    u, v, n = plane.u, plane.v, plane.n
    sides = (
        ((-length / 2, -width / 2), u, length),
        ((length / 2, width / 2), -u, length),
        ((length / 2, -width / 2), v, width),
        ((-length / 2, width / 2), -v, width),
    )
    for origin, axis, span in sides:
        wall = Plane(plane.point(*origin), axis, n)
        for k, left in enumerate(np.arange(1.2, span - 1.6, 2.7)):
            for low in (1.2, 3.4):
                b.box(wall, (left - 0.1, low - 0.1, 0.0), (left + 1.2, low + 1.4, 0.06), painted("dedbd2"))
                room = interior("57606b", ("c9a27c", "e3ddd0", "a9b7bf")[(k + seed) % 3])
                b.rect(wall.at(0, 0, 0.07), (left, low), (left + 1.1, low + 1.3), room)


def add_foliage(b: Builder) -> None:
    """Add hedges, bushes and trees."""
    _hedges(b)
    _trees(b)


def add_surroundings(b: Builder, seed: int) -> None:
    """Add everything except the house."""
    _ground(b, seed)
    _van(b, (6.9, -13.9), 1.5, "d9d9d4")
    _van(b, (-12.0, -18.0), 0.02, "5f7f9a")
    _garden(b)
    _borders(b)
    _trees(b)
    _neighbours(b)
