"""The report's chapters on training and on the held-out photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from splatpipe.pipeline.app.report.facts.report_inputs import ReportInputs
from splatpipe.pipeline.app.report.facts.wording import count, duration, judged_size, number, share, size

Chapter = dict[str, Any]
MEASURES = {  # metrics of a held-out photo: title with the unit, digits
    "psnr": ("PSNR (dB)", 2),
    "psnr_cc": ("after colour fit (dB)", 2),
    "ssim": ("SSIM", 3),
    "ms_ssim": ("MS-SSIM", 3),
    "gmsd": ("GMSD", 3),
    "sharpness": ("sharpness", 3),
}
MAX_ROWS = 200  # held-out photos in the table


def training_chapter(inputs: ReportInputs, *, drawn: bool) -> Chapter | None:
    """The chapter on training: plan, result and curves; None if training was not reached.

    Args:
        inputs: The report's inputs.
        drawn: Whether to draw charts.
    """
    stage = inputs.history.stages.get("train")
    in_blocks = any(name.startswith("train.") for name in inputs.history.stages)
    if "train" not in inputs.artifacts and (stage is None or stage.state == "not reached") and not in_blocks:
        return None
    summary, history = inputs.summary("train"), inputs.read("train.history")
    plan, split = summary.get("plan") or {}, inputs.read("split.views")
    # not while it decodes photos
    trained = stage if stage is not None and stage.messages.progress.get("unit") == "iterations" else None
    planned = summary.get("planned_iterations") or (None if trained is None else trained.messages.progress.get("total"))
    reached = summary.get("iterations") or (None if trained is None else trained.reached)
    curves = _curves(inputs, history)
    gaussians = summary.get("gaussians") or _last(curves.get("gaussians", {}))
    facts = [
        ("Blocks", _blocks(inputs)),
        ("Iterations", f"{count(reached)} of {count(planned)} planned" + _why_earlier(summary)),
        ("Gaussians", f"{count(gaussians)}, {count(inputs.summary('initialize').get('gaussians'))} at the start"),
        ("Cleaning", removed_in_words(inputs.summary("clean"))),
        (
            "Training resolution",
            f"{number(summary.get('train_megapixels'), 2)} megapixels",
        ),
        ("Photos", f"{len(split.get('train', []))} trained on, {len(split.get('held_out', []))} held out"),
        ("Final loss", number(summary.get("loss") or _last(curves.get("loss", {})), 4)),
        ("Time", duration(summary.get("train_seconds") or (stage.seconds if stage else None))),
        ("Memory", size(summary.get("peak_memory_bytes") or (stage.memory_bytes if stage else None))),
        ("Device", " ".join(str(summary[name]) for name in ("device", "instruction_set") if summary.get(name))),
        ("Seed", _seed(inputs)),
    ]
    if not split:
        facts = [fact for fact in facts if fact[0] != "Photos"]
    chapter: Chapter = {
        "facts": [fact for fact in facts if fact[1] and not fact[1].startswith("–")],
        "finished": "train" in inputs.artifacts,
        "plan": sorted((str(name), str(value)) for name, value in plan.items()),
        "charts": [],
    }
    if drawn:
        chapter["charts"] = _curve_charts(curves, None if planned is None else float(planned))
    return chapter


def removed_in_words(summary: Mapping[str, Any]) -> str:
    """The number of Gaussians removed after training, with reasons; empty if not cleaned.

    Args:
        summary: The summary of the stage `clean`.
    """
    reasons = summary.get("reasons")
    if reasons is None:
        return ""
    why = ", ".join(f"{count(number)} {reason}" for reason, number in reasons.items() if number)
    return f"{count(sum(reasons.values()))} removed: {why}" if why else "none removed"


def views_chapter(inputs: ReportInputs, *, drawn: bool) -> Chapter | None:
    """The chapter on the held-out photos, worst first; None if evaluate did not finish."""
    if "evaluate" not in inputs.artifacts:
        return None
    metrics = inputs.read("evaluate.metrics")
    views = sorted(metrics["per_view"], key=lambda view: view["psnr"] if view.get("psnr") is not None else -1.0)
    if "whole" in metrics:  # a view that shows nothing inside the boundary has no figures, and goes last
        views = sorted(views, key=lambda view: view.get("psnr") is None)
    measures = [
        (name, *column) for name, column in MEASURES.items() if any(view.get(name) is not None for view in views)
    ]
    chapter: Chapter = {
        "titles": [title for _, title, _ in measures],
        "rows": [_row(view, measures) for view in views[:MAX_ROWS]],
        "rows_more": max(0, len(views) - MAX_ROWS),
        "mean": [number(metrics["mean"].get(name), digits) for name, _, digits in measures],
        "count": len(views),
        "not_judged": max(0, metrics.get("held_out_views", len(views)) - len(views)),
        "bounded": "whole" in metrics,
        "judged": judged_size(metrics),
        "floaters": _floaters(metrics.get("floaters") or {}),
        "shown": [],
        "charts": [],
    }
    if drawn and views:
        chapter |= _view_images(inputs, views, measures)
    return chapter


def _view_images(
    inputs: ReportInputs, views: Sequence[Mapping[str, Any]], measures: Sequence[tuple[str, str, int]]
) -> Chapter:
    from splatpipe.pipeline.app.report.charts.charts import view_bars
    from splatpipe.pipeline.app.report.charts.pictures import chosen_views, view_pictures

    folder = inputs.part("evaluate.views")
    photos = inputs.read_in_part("ingest.photos", "photos.json").get("photos", [])
    turned = {str(photo["name"]): int(photo.get("orientation") or 1) for photo in photos}
    entries = []
    for view in chosen_views(views):
        stem = str(view["file"])
        pictures = None
        if folder is not None and "/" not in stem and stem not in (".", ".."):
            pictures = view_pictures(folder / stem, turned.get(str(view["name"]), 1))
        if pictures is not None:
            row = _row(view, measures)
            figures = list(zip((title for _, title, _ in measures), row["values"], strict=True))
            entries.append({"name": str(view["name"]), "pictures": pictures, "figures": figures})
    bars = [(str(view["name"]), float(view["psnr"])) for view in views if view.get("psnr") is not None]
    charts = [{"svg": view_bars(bars, "dB"), "text": "All judged photos, worst first."}] if len(bars) > 1 else []
    return {"shown": entries, "charts": charts}


def _row(view: Mapping[str, Any], measures: Sequence[tuple[str, str, int]]) -> dict[str, Any]:
    return {
        "name": str(view["name"]),
        "size": f"{count(view.get('width'))} × {count(view.get('height'))}",
        "counted": share(view.get("counted")),
        "values": [number(view.get(name), digits) for name, _, digits in measures],
    }


def _floaters(floaters: Mapping[str, Any]) -> list[tuple[str, str]]:
    depth, veil = floaters.get("depth_disagreement") or {}, floaters.get("veil") or {}
    before = "held-out" if veil.get("held_out", True) else "training"
    return [
        (f"Haze in front of {before} photos", f"{share(veil.get('mean'), 2)} of the light from the points they see"),
        ("Opacity in free space", f"{share(floaters.get('free_space_opacity'), 3)} of all"),
        (
            "Share of the rendered views",
            f"{share(floaters.get('free_space_rendered'), 3)} of what they show is floaters in free space",
        ),
        ("Depths of neighbouring views", f"differ by {share(depth.get('median'), 2)} (median)"),
        ("Depths more than 5 % off", f"in {share(depth.get('share_above_5_percent'), 1)} of the pixels"),
    ]


def _curves(inputs: ReportInputs, history: Mapping[str, Any]) -> dict[str, dict[float, float]]:
    """Loss and number of Gaussians over the iterations, from the finished training or else from its events."""
    points = history.get("curve") or []
    if points:
        names = ("loss", "gaussians")
        return {
            name: {float(p["iteration"]): float(p[name]) for p in points if p.get(name) is not None} for name in names
        }
    stage = inputs.history.stages.get("train")
    return {} if stage is None else {name: dict(curve) for name, curve in stage.messages.metrics.items()}


def _curve_charts(curves: Mapping[str, Mapping[float, float]], planned: float | None) -> list[dict[str, Any]]:
    from splatpipe.pipeline.app.report.charts.charts import training_curve

    labels = {
        "loss": (
            "loss (L1 + D-SSIM)",
            True,
            "Loss on the training photos: it falls, and flattens when training no longer gains.",
        ),
        "gaussians": ("Gaussians", False, "Number of Gaussians, as density control adds and prunes them."),
    }
    charts = []
    for name, (label, log, text) in labels.items():
        curve = {step: value for step, value in curves.get(name, {}).items() if value == value}
        if len(curve) > 1:
            charts.append({"svg": training_curve(label, curve, planned, log), "text": text})
    return charts


def _last(curve: Mapping[float, float]) -> float | None:
    return curve[max(curve)] if curve else None


def _why_earlier(summary: Mapping[str, Any]) -> str:
    if parts := summary.get("flat"):  # this key exists for a training in blocks
        blocks = len(parts.keys() - {"coarse"})
        where = ["in the coarse pass"] * ("coarse" in parts)
        where += [f"in {count(blocks)} of {count(summary.get('blocks'))} blocks"] * bool(blocks)
        return f": the loss was flat {' and '.join(where)}"
    flat, before = summary.get("flat_at"), summary.get("sizes_ended") or []
    where = [f"of smaller photos after {count(iteration)}" for iteration in before] + (
        [f"after {count(flat)}"] if flat else []
    )
    return f": the loss was flat {', '.join(where)}" if where else ""


def _blocks(inputs: ReportInputs) -> str:
    """The number of training blocks, or their progress; empty if the scene is not divided."""
    blocks = inputs.summary("blocks").get("blocks", 1)
    if blocks == 1:
        return ""
    if "train" in inputs.artifacts:
        return f"trained in {count(blocks)}, after a coarse pass over the whole scene"
    stages = inputs.history.stages.items()
    done = [name for name, stage in stages if name.startswith("train.") and stage.state in ("finished", "reused")]
    return f"{count(len(done))} of {count(blocks)} trained"


def _seed(inputs: ReportInputs) -> str:
    return "" if inputs.config is None else str(inputs.config.train.seed)
