"""Measure how far a format moves Gaussians, relative to its quantization step."""

from __future__ import annotations

import gzip
import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.spatial import KDTree
from tables import Row

from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene

SITE_M = 3000.0
MAX_POINTS = 30_000  # number that are matched
BESIDE = 20.0  # steps: a larger distance means another Gaussian, or an error of the format
MAX_ERROR_STEPS = 0.5 + 1e-3  # largest error in steps of the format: rounding to nearest, plus float32 along the way

Points = Float64[np.ndarray, "n 3"]


def site_of(scene: Scene) -> Scene:
    """Spread the Gaussians that are matched over a site of 3 km, with unchanged sizes."""
    found = scene.gaussians
    index = torch.linspace(0, len(found) - 1, min(len(found), MAX_POINTS)).long()
    part = found.select(index)
    means = part.means.double()
    low, high = (torch.quantile(means, q, dim=0) for q in (0.01, 0.99))
    spread = ((means - low) / (high - low).clamp(min=1e-9) - 0.5).clamp(-0.5, 0.5)
    spread[:, 2] *= 0.05  # sites are flat: 150 m
    return replace(scene, gaussians=replace(part, means=(SITE_M * spread).float()))


def position_row(original: Scene, read: Scene, path: Path, name: str) -> Row:
    """Return a format's position errors in millimetres and in steps, per coordinate.

    Args:
        original: What was written.
        read: What was read.
        path: The file, whose header states its steps.
        name: Name of the format.
    """
    truth, found = original.turned("z up").gaussians, read.turned("z up").gaussians
    index, partner = _partners(truth, found)
    in_file = original.turned(read.facts.axes).gaussians.means.double().numpy()[index]
    steps = steps_m(name, path, in_file)
    errors = np.abs(read.gaussians.means.double().numpy()[partner] - in_file)
    beside = (errors <= BESIDE * steps).all(axis=1)
    steps, errors = steps[beside], errors[beside]
    return {
        "step_mm": 1e3 * float(np.median(steps)),
        "largest_step_mm": 1e3 * float(steps.max()),
        "median_mm": 1e3 * float(np.median(errors)),
        "largest_mm": 1e3 * float(errors.max()),
        "in_steps": float((errors / steps).max()),
        "brought_in": int((~beside).sum()),
        "within": bool((errors <= MAX_ERROR_STEPS * steps + _float_steps(in_file[beside])).all()),
    }


def _partners(truth: Gaussians, found: Gaussians) -> tuple[Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
    """Match the sampled Gaussians with those read: formats change the order.

    Matching uses colour, opacity and scales as well as position; these are kept precisely enough to tell neighbours
    apart.
    """
    index = np.linspace(0, len(truth) - 1, min(len(truth), MAX_POINTS)).astype(np.int64)

    def features(gaussians: Gaussians) -> Float64[np.ndarray, "n 10"]:
        columns = (
            20.0 * gaussians.means.double(),
            10.0 * gaussians.sh[:, 0].double().clamp(-2.0, 2.0),
            10.0 * torch.sigmoid(gaussians.opacity_logits.double())[:, None],
            10.0 * gaussians.log_scales.double().sort(dim=1).values.clamp(-8.0, 4.0),
        )
        return np.asarray(torch.cat(columns, dim=1).numpy())

    tree = KDTree(features(found), balanced_tree=False, compact_nodes=False)
    return index, np.asarray(tree.query(features(truth)[index])[1], np.int64)


def steps_m(name: str, path: Path, in_file: Points) -> Points:
    """Return a format's quantization step of each coordinate, metres; float32's if it stores that.

    Args:
        name: Name of the format.
        path: The file.
        in_file: Coordinates in its axes.
    """
    if name.startswith("spz"):
        return np.full(in_file.shape, 2.0 ** -gzip.decompress(path.read_bytes())[13])
    if name == "compressed-ply":
        return _compressed_steps(path, in_file)
    if "sog" in name and path.suffix == ".sog":
        with zipfile.ZipFile(path) as archive:
            means = json.loads(archive.read("meta.json"))["means"]
        span = (np.array(means["maxs"]) - np.array(means["mins"])) / 65535.0
        return np.asarray(span * (1.0 + np.abs(in_file)) * np.exp(0.5 * span))  # sign(x) ln(1 + |x|) is stored
    return _float_steps(in_file)


def _float_steps(points: Points) -> Points:
    return np.spacing(np.abs(points).astype(np.float32)).astype(np.float64)


def _compressed_steps(path: Path, in_file: Points) -> Points:
    """Return the steps of the smallest chunk that contains a point: 11, 10 and 11 bits per axis."""
    boxes = _chunks(path)
    steps = (boxes[:, 3:] - boxes[:, :3]) / np.array([2047.0, 1023.0, 2047.0])
    found = np.full(in_file.shape, np.inf)
    margin = 1e-5 + 1e-6 * np.abs(boxes).max()
    for box, step in zip(boxes, steps, strict=True):
        inside = ((in_file >= box[:3] - margin) & (in_file <= box[3:] + margin)).all(axis=1)
        found[inside] = np.where(np.isinf(found[inside]), step, np.maximum(found[inside], step))
    return np.maximum(np.where(np.isinf(found), steps.max(axis=0), found), _float_steps(in_file))


def _chunks(path: Path) -> Float64[np.ndarray, "chunks 6"]:
    """Return the chunks' lowest and highest corners, from the file's first element."""
    data = path.read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    lines = data[:end].decode("ascii", "replace").split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("element chunk "))
    count, names = int(lines[at].split()[2]), []
    for line in lines[at + 1 :]:
        if not line.startswith("property"):
            break
        names.append(line.split()[2])
    rows = np.frombuffer(data, "<f4", count * len(names), end).reshape(count, len(names))
    wanted = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
    return rows[:, [names.index(name) for name in wanted]].astype(np.float64)
