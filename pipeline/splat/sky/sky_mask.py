"""Sky segmentation in photos with known cameras, without learned weights; when in doubt, no sky.

A pixel is sky if all of these hold, which are known from photos and the sparse model alone: its surroundings are
smooth; its colour is that of a sky (bluish, or a bright grey); its ray does not point below the horizon; no
triangulated point of any photo lies on its ray; it is connected to the image's upper border with respect to gravity;
and other photos that look in the same direction see sky, too (a sky is the same from everywhere, a wall is not).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatpipe.pipeline.engine.parallel import ordered_map
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.upright import up_without_orientation

WORK_MEGAPIXELS = 0.1  # resolution of the search: noise and distant texture are averaged out, edges stay
SMOOTH_SLOPE = 0.03  # change of a channel over a pixel, of 1: haze and soft clouds are below, edges and leaves above
BLUE_STEP = 0.03  # least blue minus red, and most green minus blue, of a bluish sky
CLEARLY_BLUE = 0.1  # blue minus red from which it is not just grey made bluish by shade or haze
MIN_BLUE_LIGHT = 0.3  # blue channel of a bluish sky, 0 to 1
MIN_GREY_LIGHT = 0.75  # darkest channel of a grey sky, 0 to 1: clouds, haze, overexposed
GREY_OUTSHINES = 0.7  # share of the rest of the picture: walls in the sun stand beside shade
BLUE_OUTSHINES = 0.4  # a deep blue sky is darker than that wall; bluish haze and shadows are darker still
HORIZON_MARGIN_DEG = 2.0  # below the horizon: error of the estimated up, dip of the horizon for a drone
ZENITH_DEG = 85.0
TOP_COSINE = 0.5  # between up and the way out of the picture over its top border: a corner up has two top borders
POINT_CLEARANCE_PX = 3  # around a triangulated point nothing is sky
CORE_PX = 5  # depth inside a region from which points are not those of the roof under it
MAX_SPREAD = 0.2  # share of a region's core near points over that of the rest: spires, outliers, birds, clouds
MIN_SHARE = 0.002  # area of a region over the picture: smaller patches are not worth the risk
MIN_CONTACT = 0.5  # region's width at the top over the root of its area: a sky is open, a road or a wall narrow
GROW_STEPS = 3  # pixels by which the slope's window keeps regions from edges
GROW_COLOUR = 0.06  # most distance, in any channel, from the mean of the sky close by
GROW_WINDOW = 7
DIRECTION_ROWS = 64  # rows of the grid of directions, elevation by azimuth: cells of 2.8°
MIN_WITNESSES = 2  # other photos that look the same way, before their word counts
MIN_AGREEMENT = 0.15  # agreeing share of the witnesses: buildings rightly hide much of one's sky from another
ROOF_COLUMNS = 72  # sectors of azimuth, 5° each, tested for something above a region
ROOF_REACH_DEG = 5.0  # azimuth on either side that a point above covers: points of smooth ceilings are far apart
ROOF_MARGIN_DEG = 3.0  # elevation of such a point above a region's top: a roof's edge does not cover the sky beside it
ROOF_POINTS = 3  # points needed: a single one may be wrong, or a bird
MAX_ROOFED_SHARE = 0.5  # covered share of a region's pixels: a branch or a wire over the sky does not make it a wall
OPEN_FROM_DEG = 5.0  # rays above this elevation pass over low walls and furniture
MIN_OPEN_SHARE = 0.05  # sky's share of all that the photos see above it: most of it outdoors, a few patches in a room


@dataclass(frozen=True)
class SkyPhoto:
    """A reduced photo for the sky search, at most ``WORK_MEGAPIXELS``.

    Attributes:
        camera: Camera at the size of ``pixels``.
        pixels: RGB.
        ignored: True where the user's mask excludes pixels; None without a mask.
        drawn: Sky mask drawn by the user; None if the sky has to be detected.
    """

    camera: Camera
    pixels: UInt8[np.ndarray, "h w 3"]
    ignored: Bool[np.ndarray, "h w"] | None = None
    drawn: Bool[np.ndarray, "h w"] | None = None


@dataclass(frozen=True)
class SkyMask:
    """A photo's sky mask, one bit per pixel.

    Attributes:
        bits: ``np.packbits`` of the mask.
        shape: Its height and width, those of the ``SkyPhoto``.
    """

    bits: UInt8[np.ndarray, " n"]
    shape: tuple[int, int]

    @staticmethod
    def packed(mask: Bool[np.ndarray, "h w"]) -> SkyMask:
        """Pack a mask."""
        return SkyMask(np.packbits(mask), (mask.shape[0], mask.shape[1]))

    def unpacked(self) -> Bool[np.ndarray, "h w"]:
        """The mask, True where the sky is."""
        flat = np.unpackbits(self.bits, count=self.shape[0] * self.shape[1])
        return flat.reshape(self.shape).astype(bool)

    def emptied(self) -> SkyMask:
        """A mask of the same size without sky."""
        return SkyMask(np.zeros_like(self.bits), self.shape)

    def any(self) -> bool:
        """Whether there is any sky."""
        return bool(self.bits.any())


@dataclass(frozen=True)
class SkyVotes:
    """The cells of the direction grid that a photo sees, and those that are sky in it."""

    seen: Int64[np.ndarray, " s"]
    sky: Int64[np.ndarray, " k"]


def find_skies(
    cameras: Sequence[Camera],
    photo: Callable[[int], SkyPhoto],
    points: Float64[np.ndarray, "m 3"],
    up: Float64[np.ndarray, " 3"],
    threads: int = 1,
) -> list[SkyMask]:
    """The sky mask of each photo of a capture: drawn by the user, or else detected.

    Args:
        cameras: Cameras of the photos, in one world frame, of any size.
        photo: Loads a photo by index; called from several threads.
        points: Triangulated points in that frame, without those of few photos or with large errors.
        up: Unit vector opposite to gravity, from ``up_of``.
        threads: Number of threads that load and search.
    """

    def search(index: int) -> tuple[SkyMask, SkyVotes, bool]:
        seen = photo(index)
        if seen.drawn is not None:
            return SkyMask.packed(seen.drawn), votes_of(seen.camera, seen.drawn, up), True
        mask = find_sky(seen, seen.camera.in_view(points)[1], up)
        mask &= ~below_structure(seen.camera, mask, points, up)
        return SkyMask.packed(mask), votes_of(seen.camera, mask, up), False

    searched = list(ordered_map(search, range(len(cameras)), threads))
    votes = [each for _, each, _ in searched]
    kept = agreed(votes) if is_open(votes) else [False] * len(votes)
    return [mask if keep or drawn else mask.emptied() for (mask, _, drawn), keep in zip(searched, kept, strict=True)]


def below_structure(
    camera: Camera, sky: Bool[np.ndarray, "h w"], points: Float64[np.ndarray, "m 3"], up: Float64[np.ndarray, " 3"]
) -> Bool[np.ndarray, "h w"]:
    """Regions of a sky mask with something above, such as a ceiling or a lintel, which therefore are not sky.

    The points need not be in the image: anything above a wall is mostly seen in other photos.

    Args:
        camera: The photo's camera.
        sky: Candidate sky mask.
        points: Triangulated points in the world.
        up: Unit vector opposite to gravity, as for ``find_sky``.
    """
    count, labels = cv2.connectedComponents(sky.astype(np.uint8), connectivity=4)
    result = np.zeros_like(sky)
    if count == 1:
        return result
    azimuth, height = azimuths_elevations_deg(directions(camera), up)
    above = points - camera.centre()
    around, over = azimuths_elevations_deg(above[above @ up > 0.0], up)
    column = (azimuth * (ROOF_COLUMNS / 360.0)).astype(np.int64) % ROOF_COLUMNS
    roofs = np.full(ROOF_COLUMNS, -np.inf)  # elevations in degrees: the lowest of the ROOF_POINTS highest points around
    for each in np.unique(column[sky]):  # one by one: a table of points by columns is hundreds of megabytes
        middle = (each + 0.5) * (360.0 / ROOF_COLUMNS)
        reached = over[np.abs((around - middle + 180.0) % 360.0 - 180.0) < ROOF_REACH_DEG]
        if len(reached) >= ROOF_POINTS:
            roofs[each] = np.partition(reached, -ROOF_POINTS)[-ROOF_POINTS]
    for label in range(1, count):
        region = labels == label
        top = np.full(ROOF_COLUMNS, 90.0)
        pixels = np.bincount(column[region], minlength=ROOF_COLUMNS)
        for each in np.flatnonzero(pixels):
            top[each] = height[region & (column == each)].max()
        under = roofs > top + ROOF_MARGIN_DEG
        if pixels[under].sum() > MAX_ROOFED_SHARE * pixels.sum():
            result |= region
    return result


def is_open(votes: Sequence[SkyVotes]) -> bool:
    """Whether a capture is outdoors: enough of what it shows above the horizon is sky.

    A few bright patches among hundreds of photos are walls, windows and lamps.
    """
    lowest = math.ceil((OPEN_FROM_DEG / 180.0 + 0.5) * DIRECTION_ROWS) * 2 * DIRECTION_ROWS
    seen = sum(int((vote.seen >= lowest).sum()) for vote in votes)
    return sum(int((vote.sky >= lowest).sum()) for vote in votes) >= MIN_OPEN_SHARE * seen


def up_of(
    cameras: Sequence[Camera], photo: Callable[[int], SkyPhoto], points: Float64[np.ndarray, "m 3"], threads: int = 1
) -> Float64[np.ndarray, " 3"]:
    """Unit vector opposite to gravity, from the cameras alone: datasets have no EXIF orientation.

    Args:
        cameras: At least one camera.
        photo: As for ``find_skies``; called only if the photos seem to be rotated.
        points: As for ``find_skies``.
        threads: Number of threads that load photos.
    """
    rotations = np.stack([camera.cam_from_world[:3, :3] for camera in cameras])
    centres = np.stack([camera.centre() for camera in cameras])

    def brighter() -> Float64[np.ndarray, "n 2"]:
        light = ordered_map(lambda index: _brighter(photo(index).pixels), range(len(cameras)), threads)
        return np.stack(list(light))

    return up_without_orientation(rotations, centres, points, brighter).up


def find_sky(
    photo: SkyPhoto, points_px: Float64[np.ndarray, "n 2"], up: Float64[np.ndarray, " 3"]
) -> Bool[np.ndarray, "h w"]:
    """Detect the sky in one photo by all criteria except the agreement with other photos; True is sky.

    Pixels excluded by the user's mask count as sky-coloured; rays, points and the upper border still decide.

    Args:
        photo: The photo.
        points_px: Projections of triangulated points, visible in this photo or hidden, pixels of ``pixels``.
        up: Unit vector opposite to gravity, in the world.
    """
    colour = photo.pixels.astype(np.float32) / np.float32(255.0)
    elevation = elevations_deg(photo.camera, up)
    near = _near_points(points_px, elevation.shape)
    clear = (elevation > -HORIZON_MARGIN_DEG) & ~near
    alike = (_slopes(colour) < SMOOTH_SLOPE) & _sky_coloured(colour)
    if photo.ignored is not None:
        alike |= photo.ignored
    regions = _regions(alike & clear, _top(elevation))
    kept = [region for region in regions if _is_sky(region, colour, near, photo.ignored)]
    sky = np.logical_or.reduce(kept) if kept else np.zeros(elevation.shape, bool)
    return _grown(sky, colour, clear)


def elevations_deg(camera: Camera, up: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "h w"]:
    """Elevation of each pixel's ray above the horizon, degrees."""
    rays = directions(camera)
    sine = rays @ up / np.linalg.norm(rays, axis=2)
    return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))


def directions(camera: Camera, step: int = 1) -> Float64[np.ndarray, "h w 3"]:
    """Rays of pixels in the world, with length 1 along the optical axis.

    Args:
        camera: The camera.
        step: Spacing of the rays in pixels, from the first pixel; the last is at the last pixel or slightly outside.
    """
    x = (step * np.arange(-((1 - camera.width) // step) + 1) + 0.5 - camera.cx) / camera.fx
    y = (step * np.arange(-((1 - camera.height) // step) + 1) + 0.5 - camera.cy) / camera.fy
    rotation = camera.cam_from_world[:3, :3]
    return np.asarray(x[None, :, None] * rotation[0] + y[:, None, None] * rotation[1] + rotation[2])


def votes_of(camera: Camera, mask: Bool[np.ndarray, "h w"], up: Float64[np.ndarray, " 3"]) -> SkyVotes:
    """A photo's votes on directions: a cell is sky if most of the photo's pixels in it are."""
    cell = direction_cells(camera, up)
    cells = 2 * DIRECTION_ROWS * DIRECTION_ROWS
    count = np.bincount(cell.ravel(), minlength=cells)
    return SkyVotes(np.flatnonzero(count), np.flatnonzero(2 * np.bincount(cell[mask], minlength=cells) > count))


def agreed(votes: Sequence[SkyVotes]) -> list[bool]:
    """Whether other photos confirm each photo's sky; False if those that look the same way see something else."""
    seen, sky = np.zeros((2, 2 * DIRECTION_ROWS * DIRECTION_ROWS))
    for vote in votes:
        seen[vote.seen] += 1.0
        sky[vote.sky] += 1.0
    kept = []
    for vote in votes:
        witnesses, agreeing = seen[vote.sky] - 1.0, sky[vote.sky] - 1.0
        asked = witnesses >= MIN_WITNESSES
        heard = 2 * int(asked.sum()) > len(vote.sky)
        kept.append(not heard or float(agreeing[asked].sum()) >= MIN_AGREEMENT * float(witnesses[asked].sum()))
    return kept


def direction_cells(camera: Camera, up: Float64[np.ndarray, " 3"]) -> Int64[np.ndarray, "h w"]:
    """The cell of the direction grid for each pixel's ray."""
    rays = directions(camera)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    east, north = horizontal_axes(up)
    azimuth = np.arctan2(rays @ north, rays @ east) / (2.0 * math.pi) + 0.5  # turns, 0 to 1
    height = np.arcsin(np.clip(rays @ up, -1.0, 1.0)) / math.pi + 0.5
    columns = 2 * DIRECTION_ROWS
    row = np.minimum((height * DIRECTION_ROWS).astype(np.int64), DIRECTION_ROWS - 1)
    return np.asarray(row * columns + (azimuth * columns).astype(np.int64) % columns)


def azimuths_elevations_deg(
    rays: Float64[np.ndarray, "*n 3"], up: Float64[np.ndarray, " 3"]
) -> tuple[Float64[np.ndarray, "*n"], Float64[np.ndarray, "*n"]]:
    """Azimuths (0 to 360°, from ``horizontal_axes``) and elevations in degrees, of rays of any non-zero length."""
    east, north = horizontal_axes(up)
    level = np.hypot(rays @ east, rays @ north)
    azimuth = np.degrees(np.arctan2(rays @ north, rays @ east)) % 360.0
    return np.asarray(azimuth), np.asarray(np.degrees(np.arctan2(rays @ up, level)))


def horizontal_axes(up: Float64[np.ndarray, " 3"]) -> tuple[Float64[np.ndarray, " 3"], Float64[np.ndarray, " 3"]]:
    """Two unit vectors that form a right-handed frame with ``up``: arbitrary but deterministic."""
    axis = np.eye(3)[int(np.argmin(np.abs(up)))]
    east = np.cross(axis, up)
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def _brighter(pixels: UInt8[np.ndarray, "h w 3"]) -> Float64[np.ndarray, " 2"]:
    """Brightness gradient: mean of the right minus the left half, and of the lower minus the upper half."""
    light = pixels.mean(axis=2)
    rows, columns = light.mean(axis=1), light.mean(axis=0)
    return np.array([np.diff([half.mean() for half in np.array_split(line, 2)])[0] for line in (columns, rows)])


def _slopes(colour: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w"]:
    """Largest gradient magnitude over the channels, per pixel."""
    along_x = cv2.Sobel(colour, cv2.CV_32F, 1, 0, ksize=3, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    along_y = cv2.Sobel(colour, cv2.CV_32F, 0, 1, ksize=3, scale=0.125, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.hypot(along_x, along_y).max(axis=2), np.float32)


def _sky_coloured(colour: Float32[np.ndarray, "h w 3"]) -> Bool[np.ndarray, "h w"]:
    red, green, blue = colour[:, :, 0], colour[:, :, 1], colour[:, :, 2]
    bluish = (blue > red + BLUE_STEP) & (blue > green - BLUE_STEP) & (blue > MIN_BLUE_LIGHT)
    return np.asarray(bluish | (colour.min(axis=2) > MIN_GREY_LIGHT))


def _near_points(points_px: Float64[np.ndarray, "n 2"], shape: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    hit = np.zeros(shape, np.uint8)
    columns, rows = points_px.astype(np.int64).T
    hit[rows, columns] = 1
    size = 2 * POINT_CLEARANCE_PX + 1
    return np.asarray(cv2.dilate(hit, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))) > 0)


def _top(elevation: Float64[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Border pixels over which up leads out of the image, and pixels around the zenith if it is inside."""
    down, right = np.gradient(elevation)
    steepness = TOP_COSINE * np.maximum(np.hypot(down, right), 1e-12)
    top = elevation > ZENITH_DEG
    top[0] |= -down[0] > steepness[0]
    top[-1] |= down[-1] > steepness[-1]
    top[:, 0] |= -right[:, 0] > steepness[:, 0]
    top[:, -1] |= right[:, -1] > steepness[:, -1]
    return top


def _regions(candidates: Bool[np.ndarray, "h w"], top: Bool[np.ndarray, "h w"]) -> list[Bool[np.ndarray, "h w"]]:
    """Connected regions that are open to the top and not tiny."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(candidates.astype(np.uint8), connectivity=4)
    contact = np.bincount(labels[top & candidates], minlength=count)
    area = stats[:, cv2.CC_STAT_AREA]
    wide = (contact >= MIN_CONTACT * np.sqrt(area)) & (area >= MIN_SHARE * candidates.size)
    return [labels == label for label in range(1, count) if wide[label]]


def _is_sky(
    region: Bool[np.ndarray, "h w"],
    colour: Float32[np.ndarray, "h w 3"],
    near: Bool[np.ndarray, "h w"],
    ignored: Bool[np.ndarray, "h w"] | None,
) -> bool:
    """Whether a smooth region is sky and not a wall: almost no points inside, and grey only if brighter than the rest.

    It counts how widely points are spread: a spire has many in one place.
    """
    window = np.ones((2 * CORE_PX + 1, 2 * CORE_PX + 1), np.uint8)
    filled = np.pad(cv2.morphologyEx(region.astype(np.uint8), cv2.MORPH_CLOSE, window), 1)  # points made holes in it
    core = cv2.distanceTransform(filled, cv2.DIST_L2, 3)[1:-1, 1:-1] > CORE_PX
    if core.any() and near[core].mean() > MAX_SPREAD * near[~core].mean():
        return False
    seen = region if ignored is None else region & ~ignored
    rest = ~region if ignored is None else ~region & ~ignored
    if not seen.any() or not rest.any():
        return bool(rest.any())  # nothing but what a mask left out beside something seen
    red, green, blue = np.median(colour[seen], axis=0)
    least = BLUE_OUTSHINES if blue > red + CLEARLY_BLUE and blue > green else GREY_OUTSHINES
    light = np.median(colour[seen].mean(axis=1))
    return bool((colour[rest].mean(axis=1) < light).mean() > least)


def _grown(
    sky: Bool[np.ndarray, "h w"], colour: Float32[np.ndarray, "h w 3"], clear: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Grow the sky towards edges, which the gradient's window keeps free, over pixels of the nearby sky's colour."""
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(GROW_STEPS):
        weight = sky.astype(np.float32)
        total = cv2.boxFilter(weight, -1, (GROW_WINDOW, GROW_WINDOW), normalize=False)
        mean = cv2.boxFilter(colour * weight[:, :, None], -1, (GROW_WINDOW, GROW_WINDOW), normalize=False)
        near = np.abs(colour - mean / np.maximum(total, 1.0)[:, :, None]).max(axis=2) < GROW_COLOUR
        sky = sky | ((cv2.dilate(sky.astype(np.uint8), cross) > 0) & near & clear)
    return sky
