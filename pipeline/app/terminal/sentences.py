"""Describes a finished stage's result in one sentence, for the terminal and ``splatpipe status``.

It gives what a surveyor wants to know, with units, and omits what is as expected. All figures come from the stage's
summary, which is also in ``--json``, the manifest and the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from splatpipe.pipeline.app.report.facts.wording import count, judged_of, length, number, plural, share, size
from splatpipe.pipeline.engine.stage import Summary, stage_name

Figures = Mapping[str, Any]
PAIRINGS = {
    "exhaustive": "every photo with every other",
    "spatial": "neighbours by position",
    "retrieval": "photos of similar appearance",
}


def sentence(stage: str, summary: Summary) -> str:
    """One line without a full stop; empty if the summary is from another version and does not fit.

    Args:
        stage: The stage's or shard's name.
        summary: The artifact's summary.
    """
    describe = SENTENCES.get(stage_name(stage))
    if describe is None:
        return ""
    try:
        return describe(summary)
    except (KeyError, TypeError, ValueError, AttributeError):
        return ""


def _ingest(facts: Figures) -> str:
    parts = [f"{plural(facts['photos'], 'photo')} of {plural(facts['cameras'], 'camera')}"]
    if facts["positions"]:
        known = (
            "all with positions"
            if facts["positions"] == facts["photos"]
            else f"{count(facts['positions'])} with positions"
        )
        if facts.get("sigma_horizontal_m"):
            known += f" accurate to {_sigmas(facts)}"
            known += ", without altitudes" if facts.get("sigma_vertical_m", 0.0) is None else ""
        parts.append(known)
    else:
        parts.append("none with a position")
    parts += [plural(facts["masks"], "mask")] if facts["masks"] else []
    parts += [f"{plural(facts['left_out'], 'file')} left out"] if facts["left_out"] else []
    return ", ".join(parts)


def _sigmas(facts: Figures) -> str:
    horizontal, vertical = f"{facts['sigma_horizontal_m']:g} m", facts.get("sigma_vertical_m")
    return f"{horizontal} ({vertical:g} m in height)" if vertical else horizontal


def _control(facts: Figures) -> str:
    parts = [plural(facts["points"], "surveyed point")] if facts["points"] else []
    parts += [plural(facts["scale_bars"], "scale bar")] if facts["scale_bars"] else []
    return ", ".join(parts) or "no surveyed points"


def _features(facts: Figures) -> str:
    return f"{count(facts['keypoints_per_photo'])} keypoints per photo"


def _matches(facts: Figures) -> str:
    how = PAIRINGS.get(facts["pairing"], facts["pairing"])
    text = f"{count(facts['verified'])} of {count(facts['pairs'])} pairs match ({how}), "
    return text + f"median {count(facts['median_inliers'])} inliers"


def _sparse(facts: Figures) -> str:
    photos, placed = facts["photos"], facts["registered"]
    who = (
        f"all {count(photos)} photos placed"
        if placed == photos
        else f"{count(placed)} of {count(photos)} photos placed"
    )
    error = number(facts["mean_reprojection_error_px"], 2)
    return f"{who}, reprojection error {error} px, {count(facts['points3d'])} tie points"


def _targets(facts: Figures) -> str:
    parts = [plural(facts["coded"], "coded target")] if facts["coded"] else []
    parts += [plural(facts["quadrants"], "detection") + " of black-and-white quadrants"] if facts["quadrants"] else []
    return ", ".join(parts) + " found" if parts else "no targets"


def _georef(facts: Figures) -> str:
    parts = [str(facts["note"]).rstrip(".")]
    tables = facts.get("tables") or {}
    for role in ("check", "control"):
        table = tables.get(role)
        if table:
            horizontal, up = length(table["rmse_horizontal_m"]), length(table["rmse_up_m"])
            points = plural(table["count"], f"{role} point")
            parts.append(f"{points} off by {horizontal} horizontally and {up} in height (RMSE)")
            break
    else:
        if facts.get("rmse_horizontal_m") is not None:
            vertical = facts.get("rmse_vertical_m")
            up = "" if vertical is None else f" and {length(vertical)} in height"
            parts.append(f"photo positions off by {length(facts['rmse_horizontal_m'])} horizontally{up} (RMSE)")
    parts += [f"{plural(facts['positions_left_out'], 'position')} left out"] if facts.get("positions_left_out") else []
    parts += [f"{plural(facts['points_left_out'], 'point')} left out"] if facts.get("points_left_out") else []
    parts += ["cameras adjusted to the control points"] if facts.get("model_bent") else []
    return "; ".join(parts)


def _undistort(facts: Figures) -> str:
    return f"{plural(facts['photos'], 'photo')}, {number(facts['megapixels'], 0)} megapixels without lens distortion"


def _split(facts: Figures) -> str:
    return f"{plural(facts['trained_on'], 'photo')} for training, {count(facts['held_out'])} held out for evaluation"


def _initialize(facts: Figures) -> str:
    text = f"{plural(facts['gaussians'], 'Gaussian')} from {count(facts['points'])} tie points"
    return text + (f" and {count(facts['dense_points'])} dense points" if facts.get("dense_points") else "")


def _blocks(facts: Figures) -> str:
    return "trained as one" if facts["blocks"] == 1 else f"trained in {count(facts['blocks'])} blocks"


def _train(facts: Figures) -> str:
    done, planned = facts["iterations"], facts.get("planned_iterations")
    text = f"{plural(facts['gaussians'], 'Gaussian')} after {count(done)}"
    text += f" of {count(planned)} iterations" if planned and planned != done else " iterations"
    text += " (stopped when the loss was flat)" if facts.get("flat_at") else ""
    return text + (f", on {facts['device']}" if facts.get("device") not in (None, "cpu") else "")


def _clean(facts: Figures) -> str:
    if not facts["removed"]:
        return "nothing removed"
    whole = facts["gaussians"] + facts["removed"]
    return f"{count(facts['removed'])} of {count(whole)} Gaussians removed ({share(facts['removed'] / whole, 1)})"


def _evaluate(facts: Figures) -> str:
    if not facts["test_views"]:
        return "no photo was held out for evaluation"
    psnr, ssim = number(facts["psnr"], 1), number(facts["ssim"], 2)
    seen = judged_of(facts["test_views"], facts.get("held_out_views", 0), "held-out photo")
    return f"{seen}: PSNR {psnr} dB, SSIM {ssim}"


def _export(facts: Figures) -> str:
    return f"{plural(facts['gaussians'], 'Gaussian')} and their files"


def _flythrough(facts: Figures) -> str:
    if not facts["frames"]:
        return "no film"
    return f"a film of {number(facts['seconds'], 0)} s, {facts['width']} × {facts['height']} pixels"


def _depths(facts: Figures) -> str:
    if not facts.get("maps"):
        return "none needed"
    return f"{plural(facts['maps'], 'depth map')}, {share(facts['found'])} of their pixels"


def _dsm(facts: Figures) -> str:
    if not facts["cells"]:
        return "no surface model"
    return f"surface model of {count(facts['area_m2'])} m² in cells of {length(facts['cell_m'])}"


def _dtm(facts: Figures) -> str:
    if not facts["cells"]:
        return "no terrain model"
    return f"terrain model, {facts['ground_share']:.0%} of it seen, {facts['building_share']:.0%} under buildings"


def _ortho(facts: Figures) -> str:
    if not facts["pixels"]:
        return "no orthophoto"
    return f"orthophoto of {facts['width']:,} × {facts['height']:,} pixels of {length(facts['pixel_m'])}"


def _facades(facts: Figures) -> str:
    return plural(facts["facades"], "façade") if facts["facades"] else "no façades"


def _cloud(facts: Figures) -> str:
    return (
        f"{count(facts['points'])} points, {length(facts['spacing_m'])} apart" if facts["points"] else "no point cloud"
    )


def _mesh(facts: Figures) -> str:
    if not facts["triangles"]:
        return "no mesh"
    return f"{count(facts['triangles'])} triangles, textures of {facts['texture_pixels'] / 1e6:.0f} megapixels"


def _publish(facts: Figures) -> str:
    made = [*(f"{name} ({size(each['bytes'])})" for name, each in facts["formats"].items())]
    shown = f"viewer: splat, {' and '.join(facts['viewer'])}" if facts["viewer"] else ""
    return ", ".join(filter(None, (*made, shown))) or "nothing to publish"


SENTENCES: Mapping[str, Callable[[Figures], str]] = {
    "ingest": _ingest,
    "control": _control,
    "features": _features,
    "matches": _matches,
    "sparse": _sparse,
    "targets": _targets,
    "georef": _georef,
    "undistort": _undistort,
    "split": _split,
    "initialize": _initialize,
    "blocks": _blocks,
    "train": _train,
    "clean": _clean,
    "evaluate": _evaluate,
    "export": _export,
    "flythrough": _flythrough,
    "depths": _depths,
    "splat_depths": _depths,
    "dsm": _dsm,
    "dtm": _dtm,
    "ortho": _ortho,
    "facades": _facades,
    "cloud": _cloud,
    "mesh": _mesh,
    "publish": _publish,
}
