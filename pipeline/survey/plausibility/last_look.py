"""A last look at a placed model: it is held against everything that is known and was not used to place it.

A contradiction does not say which side is wrong, and changes nothing: it becomes the first line of the verdict. Each
has a tolerance that sound captures keep, odd ones too: take-off from a cliff, a camera clock of whole seconds, a survey
in the neighbour's zone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.engine.stage import Reporter
from splatpipe.pipeline.geometry.similarity import Similarity
from splatpipe.pipeline.photos.files.photo_list import Photo
from splatpipe.pipeline.survey.control.blunders import EXACT_M
from splatpipe.pipeline.survey.control.control import MISTAKEN_SIGMAS, ControlResult
from splatpipe.pipeline.survey.crs.crs import Crs, outside_area_km, parse_crs
from splatpipe.pipeline.survey.crs.frames import Frame
from splatpipe.pipeline.survey.placing.level import Positions, gimbal_rotation
from splatpipe.pipeline.survey.placing.model import SparseModel
from splatpipe.pipeline.survey.placing.up_witnesses import FLYING, check_up, values_of
from splatpipe.pipeline.survey.plausibility.barometer import altitude_climbs, climb_ratio, climb_sentence
from splatpipe.pipeline.survey.plausibility.foot_readings import other_foot
from splatpipe.pipeline.survey.positions.flight_steps import MIN_STEP_M, FlightSteps, steps_of
from splatpipe.pipeline.survey.positions.position_lag import position_lag
from splatpipe.pipeline.survey.positions.position_repeats import repeats, ways_m
from splatpipe.pipeline.survey.positions.position_sources import ALTITUDE_BOUNDS_M, MOST_DATUMS_M

TURNED_RAD = math.radians(45.0)  # from the gimbal's north: compasses, declinations and conventions differ by less
LAG_TURN_RAD = math.radians(15.0)  # a turn that a lag on a loop may explain, and a compass hardly
HALF_TURN_RAD = math.radians(150.0)
LEANING_RAD = math.radians(30.0)  # from the gimbal's up; what is more is told by the witnesses of up, too
MIN_WITNESSES = 6
ODD_SHARE = 0.4  # share of the positions that are odd, above which the others may be the wrong ones
CLOCK_S = 1.0  # EXIF's times are whole seconds
DRONE_M_S, AIRCRAFT_M_S = 50.0, 150.0  # no survey is flown faster: drones, and manned aircraft (or unknown)
OUTSIDE_KM = 100.0  # distance from the CRS's area of use, at most: surveyors stay in their zone across a border
DATUM_M, DATUM_SIGMAS = 20.0, 5.0  # control off the positions: more is another datum or CRS
MAX_MISFIT_SHARE = 0.05  # misfit over the control's width: tape and hand-held receivers do better, or say so
BASE_M = 3.0  # control off positions stated to EXACT_M: modern datums differ by less, wrong bases and points by more
MAX_LOG_SCALE, SCALE_SIGMAS = 0.2, 5.0  # scale by control over that by the positions: its logarithm, and in sigmas
MAX_TURN_RAD = math.radians(20.0)  # angle between north by control and by the positions


@dataclass(frozen=True)
class Contradiction:
    """Something known that the result contradicts.

    Attributes:
        text: What, a sentence.
        hint: What to check, a sentence or two.
    """

    text: str
    hint: str


@dataclass(frozen=True)
class Placed:
    """A georeferenced result.

    Attributes:
        frame: Its frame, in the CRS of the output.
        model: The sparse model that the frame places.
        positions: The photos' positions, used or not.
        photos: All photos of the capture by name.
        controlled: Georeferencing by control, if there was any.
        by_positions: The frame by positions alone, if there is one.
    """

    frame: Frame
    model: SparseModel
    positions: Positions
    photos: Mapping[str, Photo]
    controlled: ControlResult | None = None
    by_positions: Frame | None = None
    steps: FlightSteps = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "steps", steps_of(self.model.names, self.positions.by_name, self.photos))

    @property
    def world_from_model(self) -> Similarity:
        """The frame's similarity."""
        return self.frame.world_from_model

    def centres(self) -> Float64[np.ndarray, "n 3"]:
        """The cameras: east, north, up, metres."""
        return self.world_from_model.apply(self.model.centres)

    def stated(self, key: str) -> Float64[np.ndarray, " n"]:
        """A number of each photo's record; NaN where it is unknown."""
        return values_of([self.positions.by_name.get(name, {}) for name in self.model.names], key)


def report_contradictions(placed: Placed, report: Reporter) -> list[Contradiction]:
    """Report and return what the result contradicts; nothing is held against an arbitrary frame.

    Raises:
        SplatpipeError: if control places the model upside down by all that is known besides it.
    """
    if placed.frame.origin is None:
        return []
    found = [each for check in CHECKS for each in check(placed)]
    for each in found:
        report.warning(each.text, each.hint)
    return found


def _up(placed: Placed) -> Iterator[Contradiction]:
    """Up and sides, by gimbal, pictures, ground and headings."""
    verdict = check_up(placed.world_from_model, placed.model, placed.positions, placed.photos)
    if verdict.refuted and placed.controlled is not None:
        raise SplatpipeError(
            f"The control of {placed.controlled.survey.name} places the model upside down or mirrored:"
            f" {verdict.sentence()}.",
            "Check the order and the signs of its coordinates (east first), and that names and marks match. "
            "--set georef.control=none runs without control.",
        )
    if verdict.doubtful and verdict.against == (FLYING,):
        yield Contradiction(
            "The flight in the result leads against the aircraft's headings: the positions look turned or mirrored.",
            "Check the signs of latitude and longitude (S and W), and their order.",
        )
    elif verdict.doubtful:
        yield Contradiction(
            f"The model may be placed upside down or mirrored: {verdict.sentence()}.",
            "Check the signs of latitude and longitude (W and S), and that up is up in the result.",
        )


def _turn(placed: Placed) -> float | None:
    """Angle, radians counter-clockwise, of north in the result against the gimbal's, where up is not in question."""
    gimbal = gimbal_rotation(placed.model, placed.positions)
    if gimbal is None:
        return None
    turn = placed.world_from_model.rotation @ gimbal.T  # from the gimbal's world to the placed one
    return None if turn[2, 2] < math.cos(LEANING_RAD) else math.atan2(turn[1, 0], turn[0, 0])


def _north(placed: Placed) -> Iterator[Contradiction]:
    """North by the gimbal."""
    angle = _turn(placed)
    if angle is not None and abs(angle) > TURNED_RAD:
        cause = (
            "Missing signs of both latitude and longitude (S and W) do that: check them."
            if abs(angle) > HALF_TURN_RAD
            else "Check the positions' signs and order, and the north arrow of the result."
        )
        yield Contradiction(
            f"North in the result is {abs(math.degrees(angle)):.0f}° off the headings of the gimbal.", cause
        )


def _climbs(placed: Placed) -> Iterator[Contradiction]:
    """How far the drone climbed by its barometer; the ground's height does not matter."""
    above, flights = placed.stated("relative_altitude_m"), np.nan_to_num(placed.stated("flight"))
    ratio = climb_ratio(placed.centres()[:, 2], above, flights)
    if ratio is not None:
        yield Contradiction(
            f"{climb_sentence(ratio, 'the result')}.",
            "Check the scale of the result on a known length, and the positions' altitudes.",
        )
    if placed.controlled is None:  # else heights are the control's
        contradiction = altitude_climbs([placed.positions.by_name.get(name, {}) for name in placed.model.names])
        if contradiction is not None:
            yield Contradiction(*contradiction)


def _speed(placed: Placed) -> Iterator[Contradiction]:
    """Places and times against speeds that are flown; the camera's clock may be a second off between two photos."""
    steps, centres = placed.steps, placed.centres()
    if len(steps.seconds) < MIN_WITNESSES:
        return
    way = np.linalg.norm(centres[steps.second] - centres[steps.first], axis=1)
    speed = float(np.median(way / (steps.seconds + CLOCK_S)))
    is_drone = np.isfinite(placed.stated("relative_altitude_m")).any() or np.isfinite(placed.stated("pitch_deg")).any()
    if speed > (DRONE_M_S if is_drone else AIRCRAFT_M_S):
        yield Contradiction(
            f"By the photos' times and their places in the result, the camera moved at {speed:,.0f} m/s.",
            "Check the scale of the result on a known length, and whether the times are those of the flight.",
        )


def _lag(placed: Placed) -> Iterator[Contradiction]:
    """Positions against the order and times of the flight."""
    residuals = placed.frame.residuals.get("photos", {})
    if not residuals or not placed.positions.by_name:
        return
    unknown = [np.nan, np.nan]
    used = residuals.keys() - set(placed.frame.left_out)
    off = np.array([residuals[name][:2] if name in used else unknown for name in placed.model.names])
    way = placed.centres()[:, :2]
    sigma = float(np.nanmedian(placed.stated("sigma_horizontal_m")))
    found = position_lag(way, way - off, placed.steps, sigma)
    turn, turned = _turn(placed), ""
    if found is None and turn is not None and abs(turn) > LAG_TURN_RAD:
        found = position_lag(way, way - off, placed.steps, sigma, turn)
        turned = f"North in the result is {abs(math.degrees(turn)):.0f}° off the headings of the gimbal. "
    if found is not None:
        reading, evidence, near = found
        yield Contradiction(
            f"{turned}The positions do not keep the order and times of the flight: if {reading.cause}, "
            f"{evidence.share:.0%} of them fit to {near:.1f} m.",
            reading.remedy,
        )


def _repeats(placed: Placed) -> Iterator[Contradiction]:
    """Photos that state the position of the one before, and were taken elsewhere."""
    records = [placed.positions.by_name.get(name) for name in placed.model.names]
    places = [None if record is None else (record["latitude"], record["longitude"]) for record in records]
    again = repeats(places, placed.steps)
    if len(again) < MIN_WITNESSES:
        return
    way = float(np.median(ways_m(placed.centres(), placed.steps)[again]))
    if way > max(MIN_STEP_M, float(np.nanmedian(placed.stated("sigma_horizontal_m")))):
        yield Contradiction(
            f"{len(again)} of {len(places)} photos state the position of the photo before, and lie {way:.1f} m off it.",
            "The receiver was slower than the camera, or stood still: scale and north may be wrong. Give each photo "
            "its own position in geo.txt, or control points.",
        )


def _left_out(placed: Placed) -> Iterator[Contradiction]:
    """Positions that contradict those that were used, where they are nearly as many."""
    if placed.controlled is not None:
        return
    stated = placed.positions.by_name.keys() & set(placed.model.names)
    odd = len(stated & set(placed.frame.left_out))
    if odd >= MIN_WITNESSES and odd >= ODD_SHARE * len(stated):
        yield Contradiction(
            f"{odd} of {len(stated)} stated positions do not fit the others, and are left out.",
            "Check which of them are right: if it is those, the result is in the wrong place.",
        )


def _other_sources(placed: Placed) -> Iterator[Contradiction]:
    """Other statements of the same photos' positions: EXIF's and XMP's where others are used."""
    for source, metres in placed.positions.elsewhere.items():
        if placed.controlled is None or len(placed.controlled.site.stations):
            others = {"exif": "The photos' own positions (EXIF)", "xmp": "The positions in the drone's XMP"}[source]
            apart = f"{metres / 1000.0:,.1f} km" if metres >= 1000.0 else f"{metres:.0f} m"
            yield Contradiction(f"{others} lie {apart} from those used.", "Check which of them are right.")


def _areas(placed: Placed) -> Iterator[Contradiction]:
    """The areas of use of the CRSs, and heights of the earth."""
    origin = placed.frame.origin
    assert origin is not None
    crss: dict[str, Crs] = {}
    if placed.frame.crs:
        crss[placed.frame.crs] = parse_crs(placed.frame.crs)
    if placed.controlled is not None:
        crss.setdefault(placed.controlled.survey.crs.text, placed.controlled.survey.crs)
    for crs in crss.values():
        away = outside_area_km(crs, origin.latitude, origin.longitude)
        if away > OUTSIDE_KM:
            yield Contradiction(
                f"The site lies {away:,.0f} km outside the area of use of {crs.text} ({crs.name}).",
                "Check the CRS, its zone, and the order of the coordinates (east first).",
            )
    if not ALTITUDE_BOUNDS_M[0] <= origin.height_m <= ALTITUDE_BOUNDS_M[1]:
        yield Contradiction(
            f"The site lies {origin.height_m:,.0f} m above the sea, as no place on Earth does.",
            "Check whether the heights are in feet or millimetres, and that the third coordinate is the height.",
        )


def _control(placed: Placed) -> Iterator[Contradiction]:
    """Control against the photos' positions."""
    controlled = placed.controlled
    if controlled is None or len(controlled.site.stations) == 0 or not controlled.survey.of_role("control"):
        return
    survey, stations, offsets = controlled.survey, controlled.site.stations, controlled.placed.offsets
    follows = "The georeference follows the control."
    foot = other_foot(controlled)
    if foot is not None:
        reading, evidence = foot
        yield Contradiction(
            f"If {reading.cause}, {evidence.share:.0%} of the photos' positions agree with {survey.name};"
            " as stated, few do.",
            f"{reading.remedy} {follows}",
        )
    shift = np.hypot(offsets[:, 0], offsets[:, 1])
    sigma = float(np.median(stations.sigmas[:, 0]))
    if float(shift.min()) > max(BASE_M if sigma <= EXACT_M else DATUM_M, DATUM_SIGMAS * sigma):
        yield Contradiction(
            f"The control of {survey.name} lies {shift.min():.0f} m horizontally off the photos' positions.",
            f"Check that {survey.crs.text} is its CRS and datum"
            f"{', and the coordinates of the base station' if sigma <= EXACT_M else ''}. {follows}",
        )
    lift = offsets[:, 2]
    has_heights = any(point.surveyed.z is not None for point in survey.of_role("control"))
    if has_heights and stations.absolute and float(np.abs(lift).min()) > MOST_DATUMS_M:
        yield Contradiction(
            f"The heights of {survey.name} lie {abs(lift[0]):.0f} m {'below' if lift[0] > 0 else 'above'} the photos'"
            " positions, more than vertical datums can differ.",
            f"Check whether they are in feet, or relative to a local benchmark. {follows}",
        )
    alone = placed.by_positions
    if alone is not None and "sigma_scale_percent" in alone.residuals:
        yield from _shape(placed.world_from_model, alone, survey.name)


def _agreement(placed: Placed) -> Iterator[Contradiction]:
    """Control whose points lie off each other by a good part of the site: they do not have the model's shape."""
    controlled = placed.controlled
    if controlled is None or controlled.sigma_factor <= MISTAKEN_SIGMAS:
        return
    chosen = [k for k, point in enumerate(controlled.survey.points) if point.role == "control"]
    targets = controlled.site.targets
    apart = controlled.sigma_factor * float(np.median(targets.sigmas[chosen, 0]))
    extent = float(np.linalg.norm(np.ptp(targets.enu[chosen, :2], axis=0)))
    if apart > MAX_MISFIT_SHARE * extent:
        yield Contradiction(
            f"The control points of {controlled.survey.name} agree with the photos to {apart:.1f} m only,"
            f" {apart / extent:.0%} of the width of their area.",
            "Check the order and signs of the coordinates (latitude and longitude swapped mirror them), the names and "
            "the marks.",
        )


def _shape(ours: Similarity, alone: Frame, name: str) -> Iterator[Contradiction]:
    """Scale and north by control against those by the positions alone."""
    theirs = alone.world_from_model
    ratio = ours.scale / theirs.scale
    sigma = SCALE_SIGMAS * float(alone.residuals["sigma_scale_percent"]) / 100.0
    if abs(math.log(ratio)) > max(MAX_LOG_SCALE, sigma):
        yield Contradiction(
            f"By the control of {name}, lengths are {ratio:.2f} times those by the photos' positions.",
            "Check the unit of its coordinates, and its CRS.",
        )
    turn = ours.rotation @ theirs.rotation.T
    angle = math.acos(min(1.0, max(-1.0, (float(np.trace(turn)) - 1.0) / 2.0)))
    spread = math.radians(SCALE_SIGMAS * float(alone.residuals["sigma_rotation_deg"]))
    if angle > max(MAX_TURN_RAD, spread):
        yield Contradiction(
            f"The control of {name} turns the model by {math.degrees(angle):.0f}° against the photos' positions.",
            "Check the order and signs of its coordinates, and that names and marks match.",
        )


CHECKS: tuple[Callable[[Placed], Iterator[Contradiction]], ...] = (
    _up,
    _north,
    _control,
    _agreement,
    _other_sources,
    _left_out,
    _repeats,
    _lag,
    _areas,
    _climbs,
    _speed,
)
