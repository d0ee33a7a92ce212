"""Checks the photos' content: blur, exposure, copies that were saved again."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from splatpipe.pipeline.app.preflight.findings import Finding
from splatpipe.pipeline.geometry.robust import MAD_TO_SIGMA
from splatpipe.pipeline.photos.files.names import list_names, printable
from splatpipe.pipeline.photos.intake.check import CheckedPhoto
from splatpipe.pipeline.sfm.matching.quick_match import QuickFeatures
from splatpipe.pipeline.sfm.recovery.refusal import texture_hint

MAX_LOG_ENERGY_RATIO = 0.85  # log energy ratio: motion blur of 3 px gives at least 1.1, sharp photos at most 0.5
MAX_LOG_ENERGY_SPREADS = 4.0  # times the usual deviation between photos, if a whole capture is blurred
WHOLE_CAPTURE_SHARE = 0.08  # share of the photos above which it is reported once, for the whole capture
JUMP_EV = 1.1  # relative to the neighbours; light and automatic exposure vary by 1.0 in good captures
CLIPPED, CLIPPED_MORE = 0.5, 0.25  # share of clipped pixels, and its excess over most photos
DARK_LEVEL, BRIGHT_LEVEL = 14.0, 244.0  # mean grey levels of a photo that shows nothing
# Median of the keypoints at 640 px; all captures tried have 740 or more, blurred small ones 250.
MIN_MEDIAN_KEYPOINTS = 400
MAX_DUPLICATE_DIFFERENCE = 1.0  # largest grey level difference between thumbnails of a photo saved twice


def sharpness(detail_loss: Float64[np.ndarray, "n directions"]) -> Float64[np.ndarray, " n"]:
    """Amplitude of fine detail relative to the neighbours, in the direction where it is least; NaN if unknown."""
    known = np.isfinite(detail_loss).any(axis=1)
    worst = np.where(known, np.max(np.where(np.isfinite(detail_loss), detail_loss, -np.inf), axis=1), np.nan)
    return np.asarray(np.exp(-worst / 2.0))


def find_blurred(photos: Sequence[CheckedPhoto], detail_loss: Float64[np.ndarray, "n directions"]) -> list[Finding]:
    """Find photos with less fine detail than their neighbours in the area both show."""
    worst = -2.0 * np.log(sharpness(detail_loss))
    known = worst[np.isfinite(worst)]
    if not len(known):
        return []
    usual = float(np.median(known))
    spread = MAD_TO_SIGMA * float(np.median(np.abs(known - usual)))
    limit = max(MAX_LOG_ENERGY_RATIO, usual + MAX_LOG_ENERGY_SPREADS * spread)
    dull = np.flatnonzero(np.nan_to_num(worst) > limit).tolist()
    soft = np.flatnonzero(np.nan_to_num(worst) > MAX_LOG_ENERGY_RATIO)
    findings = []
    if len(soft) > max(2.0, WHOLE_CAPTURE_SHARE * len(photos)) and len(soft) > len(dull):
        findings.append(
            Finding(
                "blurred",
                "warning",
                f"{len(soft)} of {len(photos)} photos are clearly less sharp than their neighbours, throughout the "
                "capture.",
                "Fly slower, or use a faster shutter.",
            )
        )
    if len(dull):
        names = tuple(photos[k].name for k in dull)
        least = float(np.exp(-worst[dull].max() / 2.0))
        text = f"Blurred: {list_names(names)} (down to {least:.0%} of their neighbours' detail)."
        findings.append(Finding("blurred", "warning", text, "Retake them, or leave them out.", names))
    return findings


def find_little_texture(all_features: Sequence[QuickFeatures]) -> list[Finding]:
    """Find captures that show hardly anything to match, as thermal ones."""
    usual = float(np.median([len(features.places) for features in all_features]))
    if usual >= MIN_MEDIAN_KEYPOINTS:
        return []
    hint = texture_hint((features.width, features.height) for features in all_features)
    return [Finding("texture", "warning", "The photos have little texture: few of them will be placed.", hint)]


def find_exposures(
    photos: Sequence[CheckedPhoto], all_features: Sequence[QuickFeatures], brighter_ev: Float64[np.ndarray, " n"]
) -> list[Finding]:
    """Find photos much brighter or darker than their neighbours in the area both show, and white or black photos."""
    findings = []
    jumps = np.flatnonzero(np.abs(np.nan_to_num(brighter_ev)) > JUMP_EV).tolist()
    for k in jumps:
        name, step = photos[k].name, float(brighter_ev[k])
        text = f"{printable(name)} is {abs(step):.1f} EV {'brighter' if step > 0 else 'darker'} than its neighbours"
        text += f" where both show the same{_by_settings(photos, k, step)}."
        hint = "Lock the exposure during a flight, or leave the photo out."
        code = "overexposed" if step > 0 else "underexposed"
        findings.append(Finding(code, "warning", text, hint, (name,)))
    reported = set(jumps)
    means = [features.brightness.mean_level for features in all_features]
    whites, blacks = [g.brightness.white for g in all_features], [g.brightness.black for g in all_features]
    findings += _empty(photos, "overexposed", whites, [mean > BRIGHT_LEVEL for mean in means], reported)
    findings += _empty(photos, "underexposed", blacks, [mean < DARK_LEVEL for mean in means], reported)
    return findings


def _empty(
    photos: Sequence[CheckedPhoto], code: str, shares: Sequence[float], beyond: Sequence[bool], reported: set[int]
) -> list[Finding]:
    """Find mostly white or black photos, except those already reported."""
    level = "white" if code == "overexposed" else "black"
    usual = float(np.median(shares)) if shares else 0.0
    if usual > CLIPPED:
        text = f"Most photos are {level} over more than half of their pixels."
        return [Finding(code, "warning", text, "Correct the exposure: nothing can be matched in those areas.")]
    clipped = [share > max(CLIPPED, usual + CLIPPED_MORE) for share in shares]
    found = [k for k in range(len(photos)) if k not in reported and (clipped[k] or beyond[k])]
    if not found:
        return []
    names = tuple(photos[k].name for k in found)
    text = f"Hardly any detail, {level} over most of the picture: {list_names(names)}."
    return [Finding(code, "warning", text, "Retake them, or leave them out.", names)]


def _by_settings(photos: Sequence[CheckedPhoto], at: int, step: float) -> str:
    """Whether shutter, aperture and ISO explain the step, compared with the photos before and after."""
    own = photos[at].exif.exposure_ev
    beside = [photos[k].exif.exposure_ev for k in (at - 2, at - 1, at + 1, at + 2) if 0 <= k < len(photos)]
    known = [value for value in beside if value is not None]
    if own is None or not known:
        return ""
    by_settings = float(np.median(known)) - own
    return ", as its exposure settings say" if by_settings * step > 0.5 * step * step else ""


def find_copies(photos: Sequence[CheckedPhoto], all_features: Sequence[QuickFeatures]) -> list[Finding]:
    """Find copies saved again: the same image and time, but different bytes."""
    if len(photos) < 2:
        return []
    small = np.stack([features.signature.ravel() for features in all_features])
    copies: dict[str, str] = {}
    for k in range(1, len(photos)):
        apart = np.sqrt(((small[:k] - small[k]) ** 2).mean(axis=1))
        j = int(apart.argmin())
        times = photos[j].exif.time, photos[k].exif.time
        if apart[j] < MAX_DUPLICATE_DIFFERENCE and (times[0] == times[1] or None in times):
            copies[photos[k].name] = photos[j].name
    if not copies:
        return []
    descriptions = [f"{printable(name)} is {printable(twin)} saved again" for name, twin in list(copies.items())[:5]]
    more = f"; and {len(copies) - 5} more" if len(copies) > 5 else ""
    text = f"Duplicate photos: {'; '.join(descriptions)}{more}."
    hint = "Leave the copies out: they count twice, and a held-out photo may also be trained on."
    return [Finding("duplicate", "warning", text, hint, tuple(sorted({*copies, *copies.values()})))]
