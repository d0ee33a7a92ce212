"""The overlap map as SVG: footprints, matches, camera positions, gaps, orphans and control.

Without positions the photos are drawn in a ring, in the order of their names. Colours come from the style sheet, for
light and dark mode; dots and lines have the same width on all screens.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from markupsafe import Markup, escape

from splatpipe.pipeline.app.page_file import one_line, printable
from splatpipe.pipeline.app.preflight.coverage import count_footprints, shades
from splatpipe.pipeline.app.preflight.findings import MatchedPair, Preflight
from splatpipe.pipeline.app.preflight.map_frame import WIDTH, MapFrame, frame_of
from splatpipe.pipeline.app.report.facts.wording import count, length, plural
from splatpipe.pipeline.survey.files.control_file import titled

MAX_PAIRS = 5_000  # lines; if there are more, those of weakly connected photos come first
STRENGTHS = ((0, "weak"), (25, "fair"), (80, "strong"))  # least number of matches of each class
CLEAR_PAIRS = 120  # lines drawn opaque; more of them are fainter, so that what is below shows through
MIN_OPACITY = 0.25
MANY_PHOTOS = 400  # photos, whose dots are smaller
MAX_NAMED = 40  # control points with their names on the map
RADIUS, MIDDLE = 880, 1000  # radius and centre of the ring of photos, in the drawing's units
LETTERS = {"wide": 34, "everywhere": 60}  # letter height in the drawing's units: as in the style sheet, and on a phone
MAX_TITLE_LETTERS = 120  # characters of a name in a tooltip


@dataclass(frozen=True)
class OverlapMap:
    """An overlap map.

    Attributes:
        svg: The SVG element.
        kind: ``map``, or ``ring`` without positions.
        layers: Layers that can be hidden: CSS name and title; empty layers are left out.
        unplaced: Photos without a position, which are not on the map.
    """

    svg: Markup
    kind: str
    layers: tuple[tuple[str, str], ...]
    unplaced: int


class Labels:
    """Places labels on a map without overlap; fewer on phones, where letters are larger relative to the map."""

    def __init__(self) -> None:
        self._taken: dict[int, list[tuple[float, float, float, float]]] = {size: [] for size in LETTERS.values()}

    def room(self, x: int, y: int, text: str, side: str) -> str:
        """Where a label fits at a place: ``everywhere``, or only on ``wide`` screens; empty if nowhere."""
        free = [name for name, size in LETTERS.items() if self._take(x, y, text, side, size)]
        return "everywhere" if "everywhere" in free else "wide" if free else ""

    def _take(self, x: int, y: int, text: str, side: str, size: int) -> bool:
        wide = 0.62 * size * len(text)
        left = x - wide if side == "end" else x
        box = (left, left + wide, y - 0.8 * size, y + 0.25 * size)
        taken = self._taken[size]
        if any(box[0] < b[1] and b[0] < box[1] and box[2] < b[3] and b[2] < box[3] for b in taken):
            return False
        taken.append(box)
        return True


def overlap_map(preflight: Preflight, doubtful: Mapping[str, str]) -> OverlapMap | None:
    """Draw the overlap map of a capture.

    Args:
        preflight: The preflight's result.
        doubtful: For photos with findings, the findings in a few words.

    Returns:
        The map; None without photos.
    """
    if not preflight.photos:
        return None
    frame = frame_of(preflight)
    if frame is None:
        places = _ring(len(preflight.photos))
        drawn = {"pairs": _pairs(preflight.pairs, places, curved=True)}
        size, kind = (2 * MIDDLE, 2 * MIDDLE), "ring"
    else:
        places = {i: frame.point(it.position_m) for i, it in enumerate(preflight.photos) if it.position_m is not None}
        outlines = [it.footprint_m for it in preflight.photos if it.footprint_m and len(it.footprint_m) > 2]
        drawn = {
            "overlap": _overlap(frame, outlines),
            "footprints": _path("footprint", "".join(map(frame.path, outlines))),
            "gaps": _gaps(frame, preflight),
            "pairs": _pairs(preflight.pairs, places, curved=False),
        }
        size, kind = (WIDTH, frame.height), "map"
    drawn["photos"] = _photos(preflight, places, doubtful)
    if frame is not None:
        drawn["control"] = _control(frame, preflight)
    groups = "".join(f'<g class="layer-{name}">{inner}</g>' for name, inner in drawn.items() if inner)
    titles = {
        "overlap": "overlap",
        "footprints": "outlines",
        "gaps": "gaps",
        "pairs": "matched pairs",
        "photos": "photos",
        "control": "control points",
    }
    return OverlapMap(
        svg=_svg(
            size,
            _summary(preflight, kind),
            len(places) > MANY_PHOTOS,
            groups + (_scale(frame) if frame is not None else ""),
        ),
        kind=kind,
        layers=tuple((name, titles[name]) for name, inner in drawn.items() if inner),
        unplaced=len(preflight.photos) - len(places),
    )


def _svg(size: tuple[int, int], summary: str, many: bool, inner: str) -> Markup:
    hatch = (
        '<defs><pattern id="hatch" width="44" height="44" patternUnits="userSpaceOnUse" '
        'patternTransform="rotate(45)"><path class="hatch" d="M0 0v44"/></pattern></defs>'
    )
    facts = f'viewBox="0 0 {size[0]} {size[1]}" class="{"many" if many else "few"}"'
    return Markup(f'<svg {facts} role="img" aria-label="{escape(summary)}">{hatch}{inner}</svg>')


def _summary(preflight: Preflight, kind: str) -> str:
    """A text alternative for the map."""
    what = "Map of the photos" if kind == "map" else "The photos in a ring, in name order"
    parts = [plural(len(preflight.photos), "photo"), plural(len(preflight.pairs), "pair") + " compared"]
    parts += [plural(len(preflight.gaps), "gap"), plural(len(preflight.orphans), "photo") + " that match no other"]
    return f"{what}: {', '.join(parts)}."


def _path(name: str, d: str, title: str = "") -> str:
    inner = f"<title>{escape(one_line(title))}</title>" if title else ""
    return f'<path class="{name}" d="{d}">{inner}</path>' if d else ""


def _overlap(frame: MapFrame, outlines: Sequence[Sequence[Sequence[float]]]) -> str:
    paths = shades(count_footprints(frame, outlines)) if outlines else []
    return "".join(_path(f"cover{step}", d) for step, d in enumerate(paths, start=1))


def _gaps(frame: MapFrame, preflight: Preflight) -> str:
    drawn = []
    for number, gap in enumerate(preflight.gaps, start=1):
        if len(gap.outline_m) < 3:
            continue
        x, y = (sum(values) / len(gap.outline_m) for values in zip(*map(frame.point, gap.outline_m), strict=True))
        drawn.append(_path("gap", frame.path(gap.outline_m), gap.text))
        drawn.append(f'<text class="gap-number" x="{x:.0f}" y="{y:.0f}">{number}</text>')
    return "".join(drawn)


def _pairs(pairs: Sequence[MatchedPair], places: Mapping[int, tuple[int, int]], *, curved: bool) -> str:
    """The matched pairs, as one path per strength class."""
    known = [pair for pair in pairs if pair.matches > 0 and pair.first in places and pair.second in places]
    paths = dict.fromkeys((name for _, name in STRENGTHS), "")
    for pair in _strongest(known):
        (x0, y0), (x1, y1) = places[pair.first], places[pair.second]
        name = [name for least, name in STRENGTHS if pair.matches >= least][-1]
        if curved:  # towards the centre, more strongly for photos farther apart
            pull = 0.75 * min(1.0, math.hypot(x1 - x0, y1 - y0) / RADIUS)
            x, y = ((a + b) / 2 * (1 - pull) + MIDDLE * pull for a, b in ((x0, x1), (y0, y1)))
            paths[name] += f"M{x0} {y0}Q{x:.0f} {y:.0f} {x1} {y1}"
        else:
            paths[name] += f"M{x0} {y0}L{x1} {y1}"
    lines = "".join(_path(f"pair {name}", d) for name, d in paths.items())
    clear = max(MIN_OPACITY, min(1.0, math.sqrt(CLEAR_PAIRS / max(len(known), 1))))
    return f'<g opacity="{clear:.2f}">{lines}</g>' if lines else ""


def _strongest(pairs: Sequence[MatchedPair]) -> list[MatchedPair]:
    """The pairs to draw, weakest first; if there are too many, each photo's strongest have priority."""
    strongest_first = sorted(pairs, key=lambda pair: (-pair.matches, pair.first, pair.second))
    if len(strongest_first) > MAX_PAIRS:
        held: dict[int, int] = {}
        needed = []  # for each pair, the smaller number of lines so far of its two photos
        for pair in strongest_first:
            needed.append(min(held.get(pair.first, 0), held.get(pair.second, 0)))
            for photo in (pair.first, pair.second):
                held[photo] = held.get(photo, 0) + 1
        order = sorted(range(len(strongest_first)), key=lambda i: (needed[i], i))
        strongest_first = [strongest_first[i] for i in order[:MAX_PAIRS]]
    return sorted(strongest_first, key=lambda pair: (pair.matches, pair.first, pair.second))


def _photos(preflight: Preflight, places: Mapping[int, tuple[int, int]], doubtful: Mapping[str, str]) -> str:
    """One dot per photo; those with findings, in separate components, and orphans are marked and drawn on top."""
    pieces = {photo: number for number, piece in enumerate(preflight.components) for photo in piece}
    orphans = set(preflight.orphans) if len(preflight.photos) > 1 else set()
    drawn: dict[str, list[str]] = {"plain": [], "doubtful": [], "apart": [], "orphan": []}
    for i, (x, y) in places.items():
        photo = preflight.photos[i]
        title = printable(photo.name)[:MAX_TITLE_LETTERS]
        kind = "plain"
        if photo.name in doubtful:
            kind, title = "doubtful", f"{title}: {doubtful[photo.name]}"
        if pieces.get(i, 0) > 0:
            kind, title = "apart", f"{title}, in group {pieces[i] + 1}, not connected to the rest"
        if i in orphans:
            kind, title = "orphan", f"{title}, matches no other photo"
        marks = _path(f"photo {kind}", f"M{x} {y}h0", title)
        if kind == "orphan":
            marks += _path("cross", f"M{x - 14} {y - 14}l28 28m-28 0l28 -28")
        drawn[kind].append(marks)
    return "".join(mark for marks in drawn.values() for mark in marks)


def _control(frame: MapFrame, preflight: Preflight) -> str:
    drawn = []
    labels = Labels()
    for point in preflight.control:
        inside = frame.holds(point.position_m)
        x, y = frame.point(point.position_m) if inside else frame.at_edge(point.position_m)
        name = printable(point.name)[:MAX_TITLE_LETTERS]
        title = titled(point.kind, name)
        if not inside:
            off = math.dist(point.position_m, (frame.west + frame.metres / 2, frame.north - _tall(frame) / 2))
            title += f": {length(off)} from the centre of the map, outside it"
        elif point.photos is not None:
            title += f": {count(point.photos)} photos may show it"
        poor = " poor" if not inside or point.photos == 0 else ""
        drawn.append(_path(f"control {point.kind}{poor}", f"M{x} {y - 22}l20 36h-40z", title))
        side = "end" if x > 0.85 * WIDTH else "start"
        away = -30 if side == "end" else 30
        text = _short(name)
        room = labels.room(x + away, y + 12, text, side) if len(preflight.control) <= MAX_NAMED else ""
        if room:
            spot = f'text-anchor="{side}" x="{x + away}" y="{y + 12}"'
            drawn.append(f'<text class="name {room}" {spot}>{escape(text)}</text>')
    return "".join(drawn)


def _tall(frame: MapFrame) -> float:
    return frame.height / WIDTH * frame.metres


def _short(name: str, most: int = 16) -> str:
    return name if len(name) <= most else name[: most - 1] + "…"


def _scale(frame: MapFrame) -> str:
    units, metres = frame.scale_bar
    y = frame.height - 40
    text = f"{metres:,.0f} m" if metres >= 1.0 else f"{metres:.1f} m"
    bar = f'<path class="scale" d="M40 {y - 16}v16h{units}v-16"/><text class="name" x="56" y="{y - 16}">{text}</text>'
    north = f'<path class="scale" d="M{WIDTH - 60} 110v-70m-18 26l18 -26l18 26"/>'
    return f'{bar}{north}<text class="name" text-anchor="middle" x="{WIDTH - 60}" y="160">N</text>'


def _ring(photos: int) -> dict[int, tuple[int, int]]:
    """The position of each photo in the ring, clockwise from the top."""
    angles: Iterable[float] = (2.0 * math.pi * i / max(photos, 1) for i in range(photos))
    return {
        i: (round(MIDDLE + RADIUS * math.sin(angle)), round(MIDDLE - RADIUS * math.cos(angle)))
        for i, angle in enumerate(angles)
    }
