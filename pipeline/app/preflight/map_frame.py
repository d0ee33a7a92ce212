"""The frame of a capture's map: the area shown, and its mapping to drawing coordinates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from splatpipe.pipeline.app.preflight.findings import Place, Preflight

WIDTH = 2000  # width of the drawing, in its own units: integers are precise enough, and short
MIN_ASPECT, MAX_ASPECT = 0.4, 1.0  # height over width
MARGIN_SHARE = 0.06  # border around the content, as a share of its longer side
REACH_SHARE = 0.3  # farthest content in extents of the photos: oblique footprints and points beyond are cut off
MIN_SPAN_M = 10.0  # a capture from one spot still has a map
SCALE_SHARE = 0.25  # largest share of the width that the scale bar occupies


@dataclass(frozen=True)
class MapFrame:
    """Maps east and north to the drawing's x (right) and y (down).

    Attributes:
        west: East coordinate of the left edge, metres.
        north: North coordinate of the upper edge, metres.
        metres: Width of the drawing in metres.
        height: Height of the drawing in its units; it is `WIDTH` wide.
    """

    west: float
    north: float
    metres: float
    height: int

    def point(self, place: Sequence[float]) -> tuple[int, int]:
        """Drawing coordinates, right and down, of a place."""
        scale = WIDTH / self.metres
        return round((place[0] - self.west) * scale), round((self.north - place[1]) * scale)

    def holds(self, place: Sequence[float]) -> bool:
        """Whether a place is within the drawing."""
        x, y = self.point(place)
        return 0 <= x <= WIDTH and 0 <= y <= self.height

    def at_edge(self, place: Sequence[float]) -> tuple[int, int]:
        """Where the line from the centre to a place outside the drawing crosses its edge, slightly inside."""
        x, y = self.point(place)
        right, down = x - WIDTH / 2, y - self.height / 2
        inside = min(0.47 * WIDTH / max(abs(right), 1e-9), 0.46 * self.height / max(abs(down), 1e-9))
        return round(WIDTH / 2 + inside * right), round(self.height / 2 + inside * down)

    def path(self, outline: Iterable[Sequence[float]]) -> str:
        """A closed outline as an SVG path."""
        return "M" + "L".join(f"{x} {y}" for x, y in map(self.point, outline)) + "Z"

    @property
    def scale_bar(self) -> tuple[int, float]:
        """A round length for the scale bar, in the drawing's units and in metres."""
        most = SCALE_SHARE * self.metres
        power = 10.0 ** math.floor(math.log10(most))
        length = next(step * power for step in (5.0, 2.0, 1.0) if step * power <= most)
        return round(length / self.metres * WIDTH), length


def frame_of(preflight: Preflight) -> MapFrame | None:
    """The frame of all photos with positions and their footprints, gaps and nearby control; None without any."""
    cameras = [photo.position_m[:2] for photo in preflight.photos if photo.position_m is not None]
    if not cameras:
        return None
    reach = REACH_SHARE * max(_span(cameras, 0), _span(cameras, 1), MIN_SPAN_M)
    content: list[Place] = [place for photo in preflight.photos for place in photo.footprint_m or ()]
    content += [place for gap in preflight.gaps for place in gap.outline_m]
    low, high = ([bound(place[axis] for place in cameras) for axis in (0, 1)] for bound in (min, max))
    for point in (point.position_m for point in preflight.control):
        if all(low[axis] - reach <= point[axis] <= high[axis] + reach for axis in (0, 1)):
            content.append(point)
    for axis in (0, 1):
        near = [min(max(place[axis], low[axis] - reach), high[axis] + reach) for place in content]
        low[axis], high[axis] = min([low[axis], *near]), max([high[axis], *near])
    east, north = (high[0] + low[0]) / 2, (high[1] + low[1]) / 2
    margin = MARGIN_SHARE * max(high[0] - low[0], high[1] - low[1], MIN_SPAN_M)
    wide, tall = high[0] - low[0] + 2 * margin, high[1] - low[1] + 2 * margin
    tall = max(tall, MIN_ASPECT * wide)
    wide = max(wide, tall / MAX_ASPECT)
    return MapFrame(east - wide / 2, north + tall / 2, wide, round(WIDTH * tall / wide))


def _span(places: Sequence[Sequence[float]], axis: int) -> float:
    return max(place[axis] for place in places) - min(place[axis] for place in places)
