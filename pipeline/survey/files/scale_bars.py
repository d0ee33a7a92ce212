"""Scale bars: two targets and their distance per line; they give a model metric scale without known coordinates.

``scale_bars.csv`` has the columns name_a, name_b, metres and, if known, sigma (metres).
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.survey.files.survey_text import (
    UNKNOWN,
    LineError,
    TableKind,
    delimiter_of,
    find_columns,
    line_errors,
    number_in,
    read_lines,
    written_lines,
)

MAX_BARS = 1000
MAX_NAME = 255
LENGTH_BOUNDS_M = (1e-3, 1e5)
SIGMA_BOUNDS_M = (1e-6, 1e3)
DEFAULT_SIGMA_M = 0.001  # sigma of a bar whose file states none: a folding rule's
MAX_DEVIATION = 0.05  # relative deviation from the bars' median above which a bar is left out
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "a": ("name_a", "a", "from", "target_a", "marker_a", "start"),
    "b": ("name_b", "b", "to", "target_b", "marker_b", "end"),
    "metres": ("metres", "meters", "distance", "length", "distance_m", "length_m", "m"),
    "sigma": ("sigma", "sigma_m", "accuracy", "accuracy_m"),
}
_KIND = TableKind(
    "file of scale bars",
    "A CSV with the header name_a,name_b,metres and, if known, sigma: two targets and their distance a line.",
    max_bytes=1 << 20,
    max_lines=10_000,
)


@dataclass(frozen=True)
class ScaleBar:
    """A distance between two targets.

    Attributes:
        a: Name of the first.
        b: Name of the second.
        metres: Distance between their centres.
        sigma_m: Its standard deviation.
    """

    a: str
    b: str
    metres: float
    sigma_m: float


@dataclass(frozen=True)
class ModelScale:
    """A model's scale by scale bars.

    Attributes:
        metres_per_unit: Of the model.
        sigma: Relative standard deviation.
        used: Indices of the bars used.
        errors_m: The model's length less the stated one, for each bar whose targets were found; else NaN.
    """

    metres_per_unit: float
    sigma: float
    used: tuple[int, ...]
    errors_m: tuple[float, ...]


def read_scale_bars(path: Path) -> tuple[ScaleBar, ...]:
    """Read a file of scale bars.

    Raises:
        SplatpipeError: if it is not such a file; the message names the line, the hint what is expected there.
    """
    written = written_lines(read_lines(path, _KIND), path, _KIND)
    with line_errors(path, _KIND):
        number, header = written[0]
        delimiter = delimiter_of(header)
        places = find_columns(_cells(number, header, delimiter), COLUMNS)
        missing = [COLUMNS[key][0] for key in ("a", "b", "metres") if key not in places]
        if missing:
            raise LineError(number, f"a header without the columns {', '.join(missing)}")
        if len(written) - 1 > MAX_BARS:
            raise LineError(0, f"it has more than {MAX_BARS:,} bars")
        if len(written) == 1:
            raise LineError(0, "it has no bars")
        return tuple(_bar(number, _cells(number, text, delimiter), places) for number, text in written[1:])


def _cells(number: int, text: str, delimiter: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([text], delimiter=delimiter))]
    except csv.Error as error:
        raise LineError(number, str(error)) from error


def _bar(number: int, cells: Sequence[str], places: Mapping[str, int]) -> ScaleBar:
    row = {key: cells[place] if place < len(cells) else "" for key, place in places.items()}
    for key in ("a", "b"):
        if not row[key] or len(row[key]) > MAX_NAME:
            raise LineError(number, "a name that is empty or too long")
    if row["a"].casefold() == row["b"].casefold():
        raise LineError(number, "a bar from a target to itself")
    length = number_in(number, "the distance", row["metres"])
    if not LENGTH_BOUNDS_M[0] <= length <= LENGTH_BOUNDS_M[1]:
        raise LineError(number, f"a distance of {length:g} m")
    sigma = DEFAULT_SIGMA_M
    if row.get("sigma", "").casefold() not in UNKNOWN:
        sigma = number_in(number, "the standard deviation", row["sigma"])
        if not SIGMA_BOUNDS_M[0] <= sigma <= SIGMA_BOUNDS_M[1]:
            raise LineError(number, f"a standard deviation of {sigma:g} m")
    return ScaleBar(row["a"], row["b"], length, sigma)


def scale_by(bars: Sequence[ScaleBar], places: Mapping[str, Float64[np.ndarray, " 3"]]) -> ModelScale | None:
    """Compute a model's scale from bars; None if no bar has both targets found, or if no bar agrees with the median.

    Args:
        bars: With names as in ``places``.
        places: Positions of targets in the model.
    """
    ratios, sigmas, index = [], [], []
    for k, bar in enumerate(bars):
        if bar.a in places and bar.b in places:
            length = float(np.linalg.norm(places[bar.a] - places[bar.b]))
            if length > 0.0:
                ratios.append(bar.metres / length)
                sigmas.append(bar.sigma_m / bar.metres)
                index.append(k)
    if not ratios:
        return None
    ratio, sigma = np.array(ratios), np.array(sigmas)
    middle = float(np.median(ratio))
    good = np.abs(ratio / middle - 1.0) <= np.maximum(MAX_DEVIATION, 3.0 * sigma)
    if not good.any():  # two that contradict each other
        return None
    weight = np.where(good, sigma**-2.0, 0.0)
    found = float((weight * ratio).sum() / weight.sum())
    spread = float(np.sqrt((weight * (ratio / found - 1.0) ** 2).sum() / weight.sum() / max(int(good.sum()) - 1, 1)))
    errors = np.full(len(bars), math.nan)
    errors[index] = [(found / each - 1.0) * bars[k].metres for each, k in zip(ratio, index, strict=True)]
    used = tuple(k for k, is_good in zip(index, good.tolist(), strict=True) if is_good)
    return ModelScale(found, max(spread, float(weight.sum() ** -0.5)), used, tuple(errors.tolist()))
