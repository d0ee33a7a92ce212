"""Describes a finished stage's result in one sentence, for the terminal and ``splatpipe status``.

It says what a surveyor wants to know, with units, and omits what is as expected. All figures come from the stage's
summary, which is also in ``--json``, the manifest and the report.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from splatpipe.pipeline.app.report.wording import count, length, number, plural, share
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
    say = SENTENCES.get(stage_name(stage))
    if say is None:
        return ""
    try:
        return say(summary)
    except (KeyError, TypeError, ValueError, AttributeError):
        return ""


def _ingest(made: Figures) -> str:
    said = [f"{plural(made['photos'], 'photo')} of {plural(made['cameras'], 'camera')}"]
    if made["positions"]:
        known = (
            "all with positions"
            if made["positions"] == made["photos"]
            else f"{count(made['positions'])} with positions"
        )
        known += f" accurate to {_sigmas(made)}" if made.get("sigma_horizontal_m") else ""
        said.append(known)
    else:
        said.append("none with a position")
    said += [plural(made["masks"], "mask")] if made["masks"] else []
    said += [f"{plural(made['left_out'], 'file')} left out"] if made["left_out"] else []
    return ", ".join(said)


def _sigmas(made: Figures) -> str:
    horizontal, vertical = f"{made['sigma_horizontal_m']:g} m", made.get("sigma_vertical_m")
    return f"{horizontal} ({vertical:g} m in height)" if vertical else horizontal


def _control(made: Figures) -> str:
    said = [plural(made["points"], "surveyed point")] if made["points"] else []
    said += [plural(made["scale_bars"], "scale bar")] if made["scale_bars"] else []
    return ", ".join(said) or "no surveyed points"


def _features(made: Figures) -> str:
    return f"{count(made['keypoints_per_photo'])} keypoints per photo"


def _matches(made: Figures) -> str:
    how = PAIRINGS.get(made["pairing"], made["pairing"])
    text = f"{count(made['verified'])} of {count(made['pairs'])} pairs match ({how}), "
    return text + f"median {count(made['median_inliers'])} inliers"


def _sparse(made: Figures) -> str:
    photos, placed = made["photos"], made["registered"]
    who = (
        f"all {count(photos)} photos placed"
        if placed == photos
        else f"{count(placed)} of {count(photos)} photos placed"
    )
    error = number(made["mean_reprojection_error_px"], 2)
    return f"{who}, reprojection error {error} px, {count(made['points3d'])} tie points"


def _targets(made: Figures) -> str:
    said = [plural(made["coded"], "coded target")] if made["coded"] else []
    said += [plural(made["quadrants"], "sighting") + " of black-and-white quadrants"] if made["quadrants"] else []
    return ", ".join(said) + " found" if said else "no targets"


def _georef(made: Figures) -> str:
    said = [str(made["note"]).rstrip(".")]
    tables = made.get("tables") or {}
    for role in ("check", "control"):
        table = tables.get(role)
        if table:
            across, up = length(table["rmse_horizontal_m"]), length(table["rmse_up_m"])
            said.append(f"{plural(table['count'], f'{role} point')} off by {across} across and {up} in height (RMSE)")
            break
    else:
        if made.get("rmse_horizontal_m") is not None:
            across, up = length(made["rmse_horizontal_m"]), length(made["rmse_vertical_m"])
            said.append(f"photo positions off by {across} across and {up} in height (RMSE)")
    said += [f"{plural(made['positions_left_out'], 'position')} left out"] if made.get("positions_left_out") else []
    said += [f"{plural(made['points_left_out'], 'point')} left out"] if made.get("points_left_out") else []
    said += ["cameras adjusted to the control points"] if made.get("model_bent") else []
    return "; ".join(said)


def _undistort(made: Figures) -> str:
    return f"{plural(made['photos'], 'photo')}, {number(made['megapixels'], 0)} megapixels without lens distortion"


def _split(made: Figures) -> str:
    return f"{plural(made['trained_on'], 'photo')} for training, {count(made['held_out'])} held out for evaluation"


def _initialize(made: Figures) -> str:
    said = f"{count(made['gaussians'])} Gaussians from {count(made['points'])} tie points"
    return said + (f" and {count(made['dense_points'])} dense points" if made.get("dense_points") else "")


def _blocks(made: Figures) -> str:
    return "trained as one" if made["blocks"] == 1 else f"trained in {count(made['blocks'])} blocks"


def _train(made: Figures) -> str:
    done, planned = made["iterations"], made.get("planned_iterations")
    said = f"{count(made['gaussians'])} Gaussians after {count(done)}"
    said += f" of {count(planned)} iterations" if planned and planned != done else " iterations"
    said += " (stopped when the loss was flat)" if made.get("flat_at") else ""
    return said + (f", on {made['device']}" if made.get("device") not in (None, "cpu") else "")


def _clean(made: Figures) -> str:
    if not made["removed"]:
        return "nothing removed"
    whole = made["gaussians"] + made["removed"]
    return f"{count(made['removed'])} of {count(whole)} Gaussians removed ({share(made['removed'] / whole, 1)})"


def _evaluate(made: Figures) -> str:
    if not made["test_views"]:
        return "no photo was held out for evaluation"
    psnr, ssim = number(made["psnr"], 1), number(made["ssim"], 2)
    return f"{plural(made['test_views'], 'held-out photo')}: PSNR {psnr} dB, SSIM {ssim}"


def _export(made: Figures) -> str:
    return f"{count(made['gaussians'])} Gaussians and their files"


def _flythrough(made: Figures) -> str:
    if not made["frames"]:
        return "no film"
    return f"a film of {number(made['seconds'], 0)} s, {made['width']} × {made['height']} pixels"


def _depths(made: Figures) -> str:
    if not made.get("maps"):
        return "none needed"
    return f"{plural(made['maps'], 'depth map')}, {share(made['found'])} of their pixels"


def _dsm(made: Figures) -> str:
    if not made["cells"]:
        return "no surface model"
    return f"surface model of {count(made['area_m2'])} m² in cells of {length(made['cell_m'])}"


def _ortho(made: Figures) -> str:
    if not made["pixels"]:
        return "no orthophoto"
    return f"orthophoto of {made['width']:,} × {made['height']:,} pixels of {length(made['pixel_m'])}"


def _facades(made: Figures) -> str:
    return plural(made["facades"], "façade") if made["facades"] else "no façades"


def _cloud(made: Figures) -> str:
    return f"{count(made['points'])} points, {length(made['spacing_m'])} apart" if made["points"] else "no point cloud"


def _mesh(made: Figures) -> str:
    return f"{count(made['triangles'])} triangles" if made["triangles"] else "no mesh"


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
    "ortho": _ortho,
    "facades": _facades,
    "cloud": _cloud,
    "mesh": _mesh,
}
