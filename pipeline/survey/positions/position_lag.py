"""Positions that belong to an earlier or later photo: rows shifted by one, or a clock that is off.

The flight as stated then has the right shape, but the photos sit elsewhere on it. A turn and a scale absorb that on a
loop, where only the gimbal's headings contradict; on strips to and fro nothing does.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Complex128, Float64, Int64

from splatpipe.pipeline.geometry.robust import absolute_weights
from splatpipe.pipeline.survey.crs.readings import Evidence, Reading, plausible
from splatpipe.pipeline.survey.positions.flight_steps import MIN_STEPS, FlightSteps

LAGS = np.arange(-12, 13) / 4.0  # photos
MIN_LAG = 0.5  # photos; shutters and cables make a tenth
MIN_WAY_SIGMAS = 2.0  # way of the lag in sigmas of the positions: a smaller one is not worth a word
NEAR_SHARE = 0.5  # distance over the lag's way up to which a photo sits where it should
ROBUST_ROUNDS = 20  # rounds of reweighting, to the least sum of distances
MIN_WEIGHT_M = 0.01


def position_lag(
    placed: Float64[np.ndarray, "n 2"],
    stated: Float64[np.ndarray, "n 2"],
    steps: FlightSteps,
    sigma_m: float,
    turn_rad: float | None = None,
) -> tuple[Reading, Evidence, float] | None:
    """The lag of positions that explains them where as stated they do not fit; else None.

    Args:
        placed: East and north of the cameras in the result.
        stated: The same, as stated; NaN where unknown.
        steps: From photo to photo.
        sigma_m: Standard deviation of the positions.
        turn_rad: Angle, counter-clockwise, by which the result is turned against headings that are to be believed; None
            if it may turn.

    Returns:
        The cause, its evidence, and how well (metres) these photos then fit.
    """
    runs = [run for run in _runs(steps) if len(run) > MIN_STEPS]
    if not runs:
        return None
    photos = np.concatenate(runs)
    north = 1.0 if turn_rad is None else np.exp(-1.0j * turn_rad)
    ours = north * (placed[photos] @ np.array([1.0, 1.0j]))
    misfits = {}
    for lag in LAGS.tolist():
        theirs = np.concatenate([_along(stated[run], lag) for run in runs]) @ np.array([1.0, 1.0j])
        known = np.isfinite(theirs)
        misfits[lag] = (
            _misfits(ours[known], theirs[known], turn_rad is None) if known.sum() > MIN_STEPS else np.full(1, np.inf)
        )
    best = min(misfits, key=lambda lag: (float(np.median(misfits[lag])), abs(lag)))
    step = float(np.median(np.abs(np.concatenate([np.diff(placed[run] @ np.array([1.0, 1.0j])) for run in runs]))))
    reach = NEAR_SHARE * abs(best) * step
    if abs(best) < MIN_LAG or reach < NEAR_SHARE * MIN_WAY_SIGMAS * sigma_m:
        return None
    evidence = {lag: Evidence(int((misfits[lag] <= reach).sum()), len(misfits[lag])) for lag in (0.0, best)}
    named = plausible(evidence[0.0], [(_reading(best, float(np.median(steps.seconds))), evidence[best])])
    return None if named is None else (*named, reach)


def _reading(lag: float, interval_s: float) -> Reading:
    """What a lag, in photos by which the right position comes later in the file, says."""
    if lag == round(lag):
        photos = f"{abs(lag):.0f} photo{'s' if abs(lag) > 1.0 else ''} {'earlier' if lag > 0.0 else 'later'}"
        return Reading(f"each position is that of {photos}", "Match names and positions again, in order of time.")
    side = "early" if lag > 0.0 else "late"
    return Reading(
        f"the positions are {abs(lag) * interval_s:.1f} s too {side}",
        "Check the camera's clock against the receiver's, and the time zone's seconds (GPS time is ahead of UTC).",
    )


def _runs(steps: FlightSteps) -> Iterator[Int64[np.ndarray, " k"]]:
    """Photos of uninterrupted steps, in order of time."""
    after = dict(zip(steps.first.tolist(), steps.second.tolist(), strict=True))
    for start in sorted(set(after) - set(after.values())):
        run = [start]
        while run[-1] in after:
            run.append(after[run[-1]])
        yield np.array(run, dtype=np.int64)


def _along(places: Float64[np.ndarray, "k 2"], lag: float) -> Float64[np.ndarray, "k 2"]:
    """Places of a run a number of photos later; NaN beyond its ends."""
    at = np.arange(len(places)) + lag
    low = np.clip(np.floor(at).astype(np.int64), 0, len(places) - 2)
    share = (at - low)[:, None]
    found = np.where(share == 0.0, places[low], (1.0 - share) * places[low] + share * places[low + 1])
    return np.where(((at >= 0.0) & (at <= len(places) - 1.0))[:, None], found, np.nan)


def _misfits(
    ours: Complex128[np.ndarray, " n"], theirs: Complex128[np.ndarray, " n"], turning: bool
) -> Float64[np.ndarray, " n"]:
    """Distances that remain after a plane similarity, which may turn or not, fitted so that their sum is least."""
    weights = np.ones(len(ours))
    off = np.zeros(len(ours), dtype=np.complex128)
    for _ in range(ROBUST_ROUNDS):
        share = weights / weights.sum()
        a, b = ours - share @ ours, theirs - share @ theirs
        factor = np.vdot(a, share * b) / max(float((share * np.abs(a) ** 2).sum()), 1e-300)
        off = b - (factor if turning else max(factor.real, 0.0)) * a
        weights = absolute_weights(np.abs(off), MIN_WEIGHT_M)
    return np.asarray(np.abs(off))
