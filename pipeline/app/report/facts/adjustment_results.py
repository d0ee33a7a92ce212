"""What ``accuracy.json`` says of the adjustment to camera positions and control; damaged entries are left out."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs

Entry = TypeVar("Entry")


@dataclass(frozen=True)
class LensResult:
    """The free parameters of a camera's lens.

    Attributes:
        names: ``f``, ``cx``, ``cy`` in pixels, ``aspect`` (relative excess of the vertical focal length), ``k1``, …
        values: Their values.
        sigmas: Their standard deviations.
        correlations: Between them, a row each; empty if not stated.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    correlations: tuple[tuple[float, ...], ...]

    @property
    def focal_px(self) -> float | None:
        """Mean of both focal lengths, pixels; None if it was held."""
        values = dict(zip(self.names, self.values, strict=True))
        return values["f"] * (1.0 + 0.5 * values.get("aspect", 0.0)) if "f" in values else None


@dataclass(frozen=True)
class PositionResidual:
    """A camera position in the adjustment: adjusted minus stated, east, north, up in metres."""

    photo: str
    flight: int
    residual_m: tuple[float, float, float]


@dataclass(frozen=True)
class Remedy:
    """What another observation would make of the ground's mean height.

    Attributes:
        height_sigma_m: Its standard deviation then.
        places_m: East, north, up of the control points; empty for photos.
    """

    height_sigma_m: float
    places_m: tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class Heights:
    """The accuracy of the ground.

    Attributes:
        together_m: Standard deviations of its mean place: east, north, up.
        typical_m: Of a single point: east, north, up; None if not stated.
        places: East, north and the height's standard deviation of some ground points.
        remedies: By name: ``control_1``, ``control_3``, ``cross_strip``.
        sentence: The warning that heights are uncertain; empty if they are not.
    """

    together_m: tuple[float, float, float] | None
    typical_m: tuple[float, float, float] | None
    places: Sequence[tuple[float, float, float]]
    remedies: Mapping[str, Remedy]
    sentence: str


@dataclass(frozen=True)
class Judgement:
    """Errors of tie points (pixels) and positions (horizontally and in height, metres) that a fit did not use.

    Attributes:
        tie_points_px: With a simple lens, and with the whole lens free.
        positions_m: The same.
        whole: Whether the whole lens was taken.
    """

    tie_points_px: tuple[float, float]
    positions_m: tuple[tuple[float, float], tuple[float, float]]
    whole: bool


@dataclass(frozen=True)
class AdjustmentResults:
    """The adjustment's results; without positions in ``accuracy.json`` only lenses and heights.

    Attributes:
        adopted: Whether the adjusted model is used; None if not stated.
        moved_px: RMS shift of what the photos show; None if not stated.
        positions: In the order of capture.
        sentence: How well positions that the fit did not use are predicted.
        noise: Flight and state of the receiver, with the factors on the stated standard deviations, horizontally and in
            height.
        judged: Of the lens; None if it was not.
        lenses: One for each camera, in the order of their numbers.
        heights: The ground's accuracy; None if unknown.
    """

    adopted: bool | None
    moved_px: float | None
    positions: Sequence[PositionResidual] = ()
    sentence: str = ""
    noise: Sequence[tuple[str, float, float]] = ()
    judged: Judgement | None = None
    lenses: Sequence[LensResult] = ()
    heights: Heights | None = None


def read_adjustment(accuracy: object) -> AdjustmentResults | None:
    """Read the adjustment from the content of ``accuracy.json``; None if there was none."""
    found = accuracy.get("adjustment") if isinstance(accuracy, Mapping) else None
    if not isinstance(found, Mapping):
        return None
    adopted = found.get("adopted")
    return AdjustmentResults(
        adopted if isinstance(adopted, bool) else None,
        _number(found.get("moved_px")),
        _each(found.get("positions"), _position),
        _text(found.get("sentence")),
        _each(found.get("noise"), _noise),
        _judgement(found.get("lens_judged")),
        [_lens(item) for item in _list(found.get("lenses"))],
        _heights(found.get("heights")),
    )


def adopted_focals_px(inputs: ReportInputs, cameras: Sequence[Mapping[str, Any]]) -> dict[int, float]:
    """Focal lengths that georeferencing gave the model, pixels, by the camera's index in a list.

    Args:
        inputs: The report's inputs.
        cameras: The cameras of ``sparse``'s summary.

    Returns:
        Empty if the model was not adjusted, or if its cameras are others.
    """
    if "georef" not in inputs.artifacts:
        return {}
    found = read_adjustment(inputs.read("georef.accuracy"))
    if found is None:
        return {}
    bent = (inputs.summary("georef") or {}).get("model_bent")  # by control
    if not (bent if found.adopted is None else found.adopted):
        return {}
    placed = [k for k, camera in enumerate(cameras) if camera.get("placed", 1)]
    placed.sort(key=lambda k: cameras[k].get("id", k))
    if len(placed) != len(found.lenses):
        return {}
    focals = zip(placed, (lens.focal_px for lens in found.lenses), strict=True)
    return {index: focal for index, focal in focals if focal is not None}


def _lens(value: object) -> LensResult:
    """A lens with the parameters that are whole; without any if it is damaged, since its place in the list counts."""
    item = value if isinstance(value, Mapping) else {}
    listed = (_list(item.get(key)) for key in ("names", "values", "sigmas"))
    rows = [
        (k, str(name), number, sigma)
        for k, (name, of, by) in enumerate(zip(*listed, strict=False))
        if (number := _number(of)) is not None and (sigma := _number(by)) is not None
    ]
    kept = [k for k, *_ in rows]
    table = [_list(row) for row in _list(item.get("correlations"))]
    square = [tuple(_number(table[a][b]) if a < len(table) and b < len(table[a]) else None for b in kept) for a in kept]
    correlations = [tuple(r for r in row if r is not None) for row in square]
    if any(len(row) < len(kept) for row in correlations):
        correlations = []
    names = tuple(name for _, name, *_ in rows)
    return LensResult(names, tuple(row[2] for row in rows), tuple(row[3] for row in rows), tuple(correlations))


def _position(value: object) -> PositionResidual | None:
    item = value if isinstance(value, Mapping) else {}
    residual, flight = _triple(item.get("residual_m")), _number(item.get("flight", 0))
    if residual is None or flight is None:
        return None
    return PositionResidual(str(item.get("photo", "")), int(flight), residual)


def _noise(value: object) -> tuple[str, float, float] | None:
    item = value if isinstance(value, Mapping) else {}
    factors = [_number(factor) for factor in _list(item.get("factors"))]
    if len(factors) != 2 or factors[0] is None or factors[1] is None:
        return None
    return str(item.get("of", "")), factors[0], factors[1]


def _judgement(value: object) -> Judgement | None:
    item = value if isinstance(value, Mapping) else {}
    tie_points = _pair(item.get("tie_points_px"))
    positions = [_pair(entry) for entry in _list(item.get("positions_m"))]
    if tie_points is None or len(positions) != 2 or positions[0] is None or positions[1] is None:
        return None
    return Judgement(tie_points, (positions[0], positions[1]), bool(item.get("whole")))


def _heights(value: object) -> Heights | None:
    if not isinstance(value, Mapping):
        return None
    remedies = value.get("remedies")
    listed = remedies.items() if isinstance(remedies, Mapping) else ()
    return Heights(
        _triple(value.get("together_sigma_m")),
        _triple(value.get("typical_sigma_m")),
        _each(value.get("map"), _triple),
        {str(name): remedy for name, item in listed if (remedy := _remedy(item)) is not None},
        _text(value.get("sentence")),
    )


def _remedy(value: object) -> Remedy | None:
    item = value if isinstance(value, Mapping) else {}
    sigma = _number(item.get("height_sigma_m"))
    if sigma is None:
        return None
    return Remedy(sigma, tuple(_each(item.get("places_m"), _triple)))


def _each(value: object, read: Callable[[object], Entry | None]) -> list[Entry]:
    """The entries of a list that can be read."""
    return [entry for item in _list(value) if (entry := read(item)) is not None]


def _triple(value: object) -> tuple[float, float, float] | None:
    found = [_number(entry) for entry in _list(value)]
    if len(found) != 3 or found[0] is None or found[1] is None or found[2] is None:
        return None
    return found[0], found[1], found[2]


def _pair(value: object) -> tuple[float, float] | None:
    found = [_number(entry) for entry in _list(value)]
    return None if len(found) != 2 or found[0] is None or found[1] is None else (found[0], found[1])


def _list(value: object) -> list[Any]:
    return value if isinstance(value, list) else []


def _text(value: object) -> str:
    return value if isinstance(value, str) else ""


def _number(value: object) -> float | None:
    """A finite number; None for anything else."""
    usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if usable else None  # type: ignore[arg-type]
