"""Seam detection in a splat merged from blocks: gaps, doubled surfaces and colour steps along borders.

Each border is rendered by cameras in the vertical plane that it spans, from flight height: nadir, and oblique along it
both ways. The border is then exactly the image's middle column, whatever the depth, so the splat's own depth is not
needed to tell its two sides apart. A render of a model without blocks, e.g. the coarse one, is subtracted from each
image, and with it most of the scene's own edges. Each measure at the border's column is also taken at the columns
beside it, where there is no border: a seam is what stands out among them, along the whole border or a piece of it.
Remaining edges of the scene thus raise the threshold for a seam instead of causing false alarms.

| measure | in a strip at the border, compared with strips on its two sides | kind |
|---|---|---|
| alpha | how much lower the opacity is | gap |
| hole | how much deeper the surface lies, pixels | gap |
| bump | how much nearer the surface lies, pixels | doubled |
| spread | how much larger the spread of depths along the rays is, pixels | doubled |
| line | difference of its colour from the mean of both sides | colour |
| step | difference between the two sides' colours | colour |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from block_borders import PlanLine
from jaxtyping import Float64

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.geometry.ground_plan import GroundPlan
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.splat.model.gaussians import Gaussians

KINDS = {"alpha": "gap", "hole": "gap", "bump": "doubled", "spread": "doubled", "line": "colour", "step": "colour"}
WIDTHS = (2, 4, 8, 16)  # half widths of a strip, pixels: of a gap, or of a step made by Gaussians of several pixels
REACH_COLUMNS = 160  # columns beside the border that are compared with it
GUARD_WIDTHS = 2  # columns left out beside the border, over the strip's width: they see the seam themselves
ROW_CAPS = {"alpha": 1.0, "hole": 2.0, "bump": 2.0, "spread": 2.0, "line": 0.05, "step": 0.08}  # cap per row: a single
# edge of a house must not outweigh all others
STATION_SPACING = 0.7  # spacing of cameras along the border, as a share of the height above the surface
MAX_DEPTH_RATIO = 2.5  # depth of a row over that height, at most: farther ones are seen at too small an angle
PIECE_LENGTH = 0.35  # least length of a piece of border that is judged by itself, over the height above the surface
MIN_ROWS = 24  # per piece, over all images
TILT_RAD = math.radians(45.0)  # angle of the oblique cameras below the horizon
SEAM_LIMITS = {  # minimum score and size of a seam along a whole border; `seams` prints what they detect
    "alpha": (5.0, 0.002),
    "hole": (4.2, 0.15),
    "bump": (4.2, 0.25),
    "spread": (5.0, 0.5),
    "line": (7.5, 0.015),
    "step": (5.5, 0.012),
}
PIECE_FACTORS = (2.2, 2.5)  # on both limits for a piece or a short border, where chance has more tries
SHORT_LENGTH = 0.7  # length of a border over the height above the surface, up to which it counts as one piece
LEVEL_COLUMNS = 32  # on each side of the border: their median depth locates a row


@dataclass(frozen=True, eq=False)
class Response:
    """The value of a measure at one piece of a border.

    Attributes:
        measure: One of `KINDS`.
        piece: Index of the piece along the border; -1 for the whole border.
        width: Half the strip's width, pixels.
        size: Value at the border.
        others: Values at the columns beside it.
        rows: Number of image rows that it was taken from.
    """

    measure: str
    piece: int
    width: int
    size: float
    others: Float64[np.ndarray, " k"]
    rows: int

    @property
    def score(self) -> float:
        """How far it stands out from the others, in their standard deviations."""
        return (self.size - float(self.others.mean())) / max(float(self.others.std()), 1e-9)

    def excess(self, score_factor: float, size_factor: float) -> float:
        """Ratio to the seam limits; 1 or more is a seam.

        Args:
            score_factor: Factor on the minimum score.
            size_factor: Factor on the minimum size.
        """
        score, size = SEAM_LIMITS[self.measure]
        return min(self.score / (score * score_factor), self.size / (size * size_factor))


@dataclass(frozen=True)
class Seam:
    """A visible border.

    Attributes:
        kind: ``gap``, ``doubled`` or ``colour``.
        response: The strongest response.
        start: Where along the border it begins, plan units.
        end: Where it ends, plan units.
    """

    kind: str
    response: Response
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class _BorderRows:
    """The rows of an image that show the border, around its column.

    Attributes:
        along: Position of each row along the border, plan units.
        channels: Opacity, depth and spread of depth in pixels, red, green, blue of the columns from left to right.
    """

    along: Float64[np.ndarray, " r"]
    channels: Float64[np.ndarray, "6 r c"]


def border_cameras(
    gaussians: Gaussians, plan: GroundPlan, line: PlanLine, like: Sequence[Camera], options: rasterizer.RenderOptions
) -> tuple[list[Camera], float]:
    """Cameras over a border and their height above the surface, world units; no cameras where there is no surface.

    Args:
        gaussians: The model.
        plan: The ground plan.
        line: The border.
        like: The photos' cameras, at the evaluation size; the new ones copy the one of median focal length.
        options: How the model is rendered.
    """
    middle = sorted(like, key=lambda camera: (camera.fx, camera.name))[len(like) // 2]
    level = float(np.median(plan.heights(np.array([camera.centre() for camera in like]))))
    ahead = np.array([*line.direction]) @ plan.axes
    down = _view(middle, plan, ahead, -plan.up)
    found, heights, along = [], [], 0.0
    while along <= line.length:
        centre = plan.points(line.place(along)[None], np.array([level]))[0]
        height = _height_above(gaussians, _placed(down, centre), options)
        if height is None:
            along += line.length / 8.0
            continue
        heights.append(height)
        back = math.cos(TILT_RAD) / math.sin(TILT_RAD) * height * ahead
        for sign in (1.0, -1.0):
            tilted = sign * math.cos(TILT_RAD) * ahead - math.sin(TILT_RAD) * plan.up
            found.append(_placed(_view(middle, plan, sign * ahead, tilted), centre - sign * back))
        found.append(_placed(down, centre))
        along += STATION_SPACING * height
    return found, float(np.median(heights)) if heights else 0.0


def find_seams(
    models: tuple[Gaussians, Gaussians],
    plan: GroundPlan,
    line: PlanLine,
    like: Sequence[Camera],
    options: rasterizer.RenderOptions,
) -> list[Seam]:
    """The visible seams of a border: the strongest of each kind; empty if none is visible.

    Args:
        models: As for ``responses``.
        plan: The ground plan, in the model's frame.
        line: The border, in plan.
        like: The photos' cameras, at the evaluation size.
        options: How the model is rendered.
    """
    found, height = responses(models, plan, line, like, options)
    pieces = 1 + max((response.piece for response in found), default=0)
    strongest: dict[str, tuple[float, Seam]] = {}
    for response in found:
        part = response.piece >= 0 or line.length < SHORT_LENGTH * height
        excess = response.excess(*(PIECE_FACTORS if part else (1.0, 1.0)))
        kind = KINDS[response.measure]
        if excess >= 1.0 and excess > strongest.get(kind, (0.0, None))[0]:
            first, last = (0, pieces) if response.piece < 0 else (response.piece, response.piece + 1)
            seam = Seam(kind, response, first / pieces * line.length, last / pieces * line.length)
            strongest[kind] = (excess, seam)
    return [seam for _, seam in strongest.values()]


def responses(
    models: tuple[Gaussians, Gaussians],
    plan: GroundPlan,
    line: PlanLine,
    like: Sequence[Camera],
    options: rasterizer.RenderOptions,
) -> tuple[list[Response], float]:
    """All measures of a border, for each piece and the whole, and the height of the cameras, world units.

    Args:
        models: The merged model, and one of the same scene without blocks; both without sky.
        plan: The ground plan, in the model's frame.
        line: The border, in plan.
        like: The photos' cameras, at the evaluation size.
        options: How the model is rendered.
    """
    cameras, height = border_cameras(models[0], plan, line, like, options)
    if not cameras:
        return [], height
    pieces = max(1, int(line.length / (PIECE_LENGTH * height)))
    sums: dict[tuple[int, str], Float64[np.ndarray, "p _ k"]] = {}
    counts = np.zeros(pieces + 1, np.int64)  # rows in total, and of each piece
    for camera in cameras:  # summed per image: all rows together would take hundreds of megabytes
        rows = _rows(models, plan, line, camera, (options, height))
        number = np.clip((rows.along / line.length * pieces).astype(np.int64), 0, pieces - 1)
        chosen = [np.ones(len(number), np.bool_), *(number == piece for piece in range(pieces))]
        counts += [int(part.sum()) for part in chosen]
        reach = rows.channels.shape[2] // 2
        for width in (width for width in WIDTHS if reach >= (4 + GUARD_WIDTHS) * width + 4):  # narrow images have fewer
            for name, values in _measured(rows.channels, width).items():
                added = np.stack([values[:, part].sum(axis=1) for part in chosen])
                sums[width, name] = sums.get((width, name), 0.0) + added
    judged = np.flatnonzero(counts >= MIN_ROWS).tolist()
    found = [
        _response(total[piece] / counts[piece], (name, piece - 1, width), int(counts[piece]))
        for (width, name), total in sums.items()
        for piece in judged
    ]
    return found, height


def _response(mean: Float64[np.ndarray, "_ k"], which: tuple[str, int, int], rows: int) -> Response:
    """The response from a measure's mean over rows at each column."""
    curve = np.linalg.norm(mean, axis=0) if len(mean) > 1 else mean[0]
    middle = len(curve) // 2
    beside = np.abs(np.arange(len(curve)) - middle) >= GUARD_WIDTHS * which[2] + 4
    return Response(*which, float(curve[middle]), curve[beside], rows)


def _measured(channels: Float64[np.ndarray, "6 r c"], width: int) -> dict[str, Float64[np.ndarray, "_ r k"]]:
    """Each measure for each row, at each column with room for the strips."""
    sums = np.concatenate([np.zeros((*channels.shape[:2], 1)), np.cumsum(channels, axis=2)], axis=2)
    places = channels.shape[2] + 1 - 6 * width

    def mean(begin: int, end: int) -> Float64[np.ndarray, "6 r k"]:
        """Mean of the columns from ``begin`` to ``end`` right of each place."""
        first, last = (sums[..., 3 * width + at :][..., :places] for at in (begin, end))
        return np.asarray((last - first) / (end - begin))

    left, right, strip = mean(-3 * width, -width), mean(width, 3 * width), mean(-width, width)
    apart = (left + right) / 2.0 - strip
    step = mean(0, 2 * width)[3:] - mean(-2 * width, 0)[3:]
    found = {
        "alpha": apart[:1],
        "hole": -apart[1:2],
        "bump": apart[1:2],
        "spread": -apart[2:3],
        "line": apart[3:],
        "step": step,
    }
    return {name: np.clip(values, -ROW_CAPS[name], ROW_CAPS[name]) for name, values in found.items()}


def _rows(
    models: tuple[Gaussians, Gaussians],
    plan: GroundPlan,
    line: PlanLine,
    camera: Camera,
    how: tuple[rasterizer.RenderOptions, float],
) -> _BorderRows:
    """The rows of a camera over a border, less those of the second model."""
    options, height = how
    stacks = [_stack(model, camera, options, height) for model in models]
    reach = stacks[0].shape[2] // 2
    about = stacks[0][1][:, reach - LEVEL_COLUMNS : reach + LEVEL_COLUMNS]
    about = np.where(about > 0.0, about, np.nan)
    image_rows = np.flatnonzero(np.isfinite(about).any(axis=1))
    level = np.nanmedian(about[image_rows], axis=1)
    pixels = np.column_stack([np.full(len(image_rows), camera.cx), image_rows + 0.5])
    along = line.along(plan.places(camera.unproject(pixels, level)))
    inside = (along >= 0.0) & (along <= line.length) & (level <= MAX_DEPTH_RATIO * height)
    image_rows, level, along = image_rows[inside], level[inside], along[inside]
    pixel = (level / camera.fx)[:, None]
    channels = np.zeros((6, len(image_rows), 2 * reach))
    for sign, stack in zip((1.0, -1.0), stacks, strict=True):
        part = stack[:, image_rows]
        part[1] = np.where(part[1] > 0.0, part[1] - level[:, None], 0.0) / pixel
        part[2] /= pixel
        channels += sign * part
    backward = bool((line.direction @ plan.axes) @ np.cross(plan.up, camera.cam_from_world[0, :3]) < 0.0)
    return _BorderRows(along, channels[..., ::-1] if backward else channels)  # the line's left is always on the left


def _stack(
    gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions, height: float
) -> Float64[np.ndarray, "6 h c"]:
    """Opacity, median depth, spread of depth, red, green and blue of the columns around an image's middle."""
    with torch.no_grad():
        seen = rasterizer.render(gaussians, camera, options).colour
        deep = rasterizer.render(gaussians, camera, replace(options.for_depths(), depth_origin=height))
    reach = min(REACH_COLUMNS, camera.width // 2)
    columns = slice(camera.width // 2 - reach, camera.width // 2 + reach)
    parts = (deep.alpha, deep.median_depth, deep.depth_sum, deep.depth_square_sum, *seen.unbind(2))
    alpha, depth, sums, squares, *colours = (part.double().numpy(force=True)[:, columns] for part in parts)
    weight = np.maximum(alpha, 1e-6)
    spread = np.sqrt(np.maximum(squares / weight - np.square(sums / weight - height), 0.0))
    return np.stack([alpha, depth, spread, *colours])


def _height_above(gaussians: Gaussians, camera: Camera, options: rasterizer.RenderOptions) -> float | None:
    """The median depth below a nadir camera; None if it sees no surface."""
    with torch.no_grad():
        depth = rasterizer.render(gaussians, camera, options.for_depths()).median_depth.numpy(force=True)
    near = depth[:, camera.width // 2 - LEVEL_COLUMNS : camera.width // 2 + LEVEL_COLUMNS]
    return float(np.median(near[near > 0.0])) if (near > 0.0).mean() > 0.5 else None


def _view(like: Camera, plan: GroundPlan, ahead: np.ndarray, forward: np.ndarray) -> Camera:
    """A centred camera of even size at the origin that looks forward, its middle column in a vertical plane."""
    width, height = min(like.width - like.width % 2, 2 * REACH_COLUMNS), like.height - like.height % 2
    right = np.cross(ahead, plan.up)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    focal = math.sqrt(like.fx * like.fy)
    return Camera("seam", width, height, focal, focal, width / 2.0, height / 2.0, pose)


def _placed(camera: Camera, centre: np.ndarray) -> Camera:
    pose = camera.cam_from_world.copy()
    pose[:3, 3] = -pose[:3, :3] @ centre
    return replace(camera, cam_from_world=pose)
