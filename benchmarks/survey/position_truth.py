"""Compare the adjustment to camera positions with the truth, by geometry: ``position_truth [--seeds 20]``.

Each scene is drawn anew for each seed and adjusted with everything unknown (``found``), with the noise's true
parameters (``told``), with one and with three control points, and as without this adjustment: a simple lens, and a
similarity to the positions (``today``). Ground points are compared with the truth. With ``--out`` each seed becomes a
line of JSON, and one that is there is not run again.

Tables: root mean square errors over all points and seeds (E, N, U in GSD); over those of ``told``; over the propagated
standard deviations; heights about the plane that fits their errors best, with control, and the share of seeds in which
the 95 % interval holds the ground's mean position. With faults: errors over those of the same seeds without the fault,
and the positions left out.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float64
from position_scenes import COMMON_M, DRIFT, DRIFT_M, FAULTS, LARGE, SCENES, STATED_M, WHITE_M, Scene, draw_scene
from tables import Row, print_table

from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity
from splatpipe.pipeline.survey.adjustment.block import Block
from splatpipe.pipeline.survey.adjustment.block_accuracy import BlockAccuracy, accuracy_of
from splatpipe.pipeline.survey.adjustment.block_adjustment import PositionObservations, adjust_block
from splatpipe.pipeline.survey.adjustment.position_adjustment import SIMPLE, LensKnowledge, converge, prior_lens
from splatpipe.pipeline.survey.adjustment.position_noise import PositionNoise, as_stated
from splatpipe.pipeline.survey.placing.uncertainty import NORMAL_95

CONTROL_M = np.array([0.02, 0.02, 0.03])
MARK_PX = 0.5
ONE_POINT, THREE_POINTS = ((0.0, 0.0),), ((-0.6, -0.6), (0.6, -0.4), (0.0, 0.6))  # half extents of the ground
WEAK_SIGMA_M = 100.0  # standard deviation of positions that only hold the frame
FAULTY = ("flat", "alternating")
AXES = "ENU"


def _axes(heading: str, key: str, how: str = ".2f") -> dict[str, str]:
    """A column of each axis."""
    return {f"{heading} {axis}": f"{key}_{axis}:{how}" for axis in AXES}


COLUMNS = {
    "scene": "scene:",
    "seeds": "seeds:",
    **_axes("GSD", "found"),
    **_axes("/told", "told"),
    **_axes("/sigma", "sigma"),
    "off plane": "plane:.2f",
    "one point": "one:.2f",
    "three": "three:.2f",
    "rim U": "rim:.2f",
    **_axes("held", "held"),
    **_axes("today", "today", ".0f"),
    "CPU s": "cpu:.1f",
}
FAULT_COLUMNS = {
    "scene": "scene:",
    "fault": "fault:",
    "seeds": "seeds:",
    **_axes("GSD", "found"),
    **_axes("/none", "none"),
    **_axes("/sigma", "sigma"),
    **_axes("held", "held"),
    "wrong": "wrong:",
    "left out": "recall:",
    "sound left out": "false:",
    "CPU s": "cpu:.1f",
}


def compared(accuracy: BlockAccuracy, scene: Scene, whole: Block | None = None) -> dict[str, list[float]]:
    """Compare ground points with the truth; mean squares in metres squared, means in metres.

    The ground's mean is that of all points; squares are of those below the flight, ``rim`` of the others.

    Args:
        accuracy: Of the block, or of a part of it.
        scene: The truth.
        whole: The adjusted block, where the accuracy may be of a part.
    """
    rows = accuracy.points
    if whole is not None:
        number = {place.tobytes(): row for row, place in enumerate(whole.points)}
        rows = np.array([number[place.tobytes()] for place in accuracy.adjusted.block.points[rows]])
    true = scene.points[rows]
    errors = accuracy.places - true
    low, high = scene.centres[:, :2].min(axis=0), scene.centres[:, :2].max(axis=0)
    below = ((true[:, :2] > low) & (true[:, :2] < high)).all(axis=1)
    design = np.column_stack([np.ones(len(errors)), true[:, :2]])[below]
    bent = errors[below, 2] - design @ np.linalg.lstsq(design, errors[below, 2], rcond=None)[0]
    return {
        "squares": (errors[below] ** 2).mean(axis=0).tolist(),
        "expected": (accuracy.ground_sigmas()[below] ** 2).mean(axis=0).tolist(),
        "own": np.diagonal(accuracy.own[below], axis1=1, axis2=2).mean(axis=0).tolist(),
        "rim": (errors[~below] ** 2).mean(axis=0).tolist() if not below.all() else [0.0] * 3,
        "bent": [float((bent**2).mean())],
        "mean": errors.mean(axis=0).tolist(),
        "mean_sigmas": accuracy.mean_sigmas().tolist(),
    }


def told_noise(scene: Scene) -> PositionObservations:
    """The positions with their true noise."""
    positions = scene.positions
    size = np.sqrt(WHITE_M**2 + DRIFT_M**2)
    factors = (size / STATED_M)[[0, 2]][None]
    share = (DRIFT_M**2 / size**2)[[0, 2]]
    noise = as_stated(positions)
    drifts = np.tile(share, (len(noise.classes), 1)), np.full_like(factors, DRIFT)
    stated_noise = PositionNoise(noise.classes, noise.of, factors, factors, *drifts)
    return replace(stated_noise.observations(positions), offset_sigmas=COMMON_M[None])


def with_control(block: Block, scene: Scene, places: tuple[tuple[float, float], ...], seed: int) -> Block:
    """The block with some tie points surveyed and marked."""
    rng = np.random.default_rng([len(places), seed])
    views = np.bincount(block.point, minlength=len(block.points))
    plan = scene.points[:, :2]
    middle, half = plan.mean(axis=0), 0.5 * np.ptp(plan, axis=0)
    stated, weights = block.stated.copy(), block.weights.copy()
    pixels, sigmas = block.pixels.copy(), block.sigmas.copy()
    for place in places:
        away = np.linalg.norm(plan - middle - half * place, axis=1)
        chosen = int(np.argmin(np.where((views >= 4) & (weights[:, 0] == 0.0), away, np.inf)))
        stated[chosen] = scene.points[chosen] + CONTROL_M * rng.normal(size=3)
        weights[chosen] = 1.0 / CONTROL_M**2
        rows = block.point == chosen
        pixels[rows] = true_pixels(scene, block.photo[rows], chosen) + MARK_PX * rng.normal(size=(rows.sum(), 2))
        sigmas[rows] = MARK_PX
    return replace(block, stated=stated, weights=weights, pixels=pixels, sigmas=sigmas)


def true_pixels(scene: Scene, photos: np.ndarray, point: int) -> Float64[np.ndarray, "k 2"]:
    """Where some photos show a point."""
    away = scene.points[point] - scene.centres[photos]
    rays = np.einsum("kij,kj->ki", scene.rotations[photos], away)
    return np.asarray(scene.camera.img_from_cam(rays), np.float64)


def todays_errors(scene: Scene) -> list[float]:
    """Mean squares of the ground's errors by a free adjustment with a simple lens and a similarity to the positions."""
    camera: pycolmap.Camera = scene.stated
    lens = prior_lens(camera, LensKnowledge(float(camera.params[0]), 0.1), SIMPLE)
    positions = scene.positions
    weak = as_stated(replace(positions, sigmas=np.full_like(positions.sigmas, WEAK_SIGMA_M))).observations(positions)
    free = adjust_block(replace(scene.block, lenses=(lens,)), weak).block
    similarity = Similarity(*fit_similarity(free.centres, positions.stated, np.ones(len(positions))))
    return ((similarity.apply(free.points) - scene.points) ** 2).mean(axis=0).tolist()


def measure(name: str, fault: str, seed: int) -> Row:
    """Adjust one scene."""
    scene = draw_scene(name, fault, seed)
    n = len(scene.positions)
    start = time.process_time()
    fit = converge(scene.block, scene.positions, np.ones(n, dtype=bool))
    accuracy = accuracy_of(fit.adjusted, fit.observed)
    seconds = time.process_time() - start
    row: dict[str, Any] = {"scene": name, "fault": fault, "seed": seed, "gsd_m": scene.gsd_m, "cpu": seconds}
    row |= {"found": compared(accuracy, scene, fit.adjusted.block), "settled": fit.adjusted.converged}
    row |= {"focal": [float(fit.adjusted.block.lenses[0].values[0]), float(scene.camera.params[0])]}
    row["focal"].append(float(accuracy.lens_sigmas()[0][0, 0] ** 0.5))
    noise = fit.noise
    row["noise"] = [noise.classes, noise.factors.tolist(), noise.shares.tolist(), noise.correlations.tolist()]
    row["wrong"] = [int(scene.wrong.sum()), int((scene.wrong & ~fit.kept).sum()), int((~scene.wrong & ~fit.kept).sum())]
    if fault != "none" or name == LARGE:
        return row
    observed = told_noise(scene)
    row["told"] = compared(accuracy_of(adjust_block(fit.adjusted.block, observed), observed), scene)
    for key, places in (("one", ONE_POINT), ("three", THREE_POINTS)):
        block = with_control(fit.adjusted.block, scene, places, seed)
        controlled = converge(block, scene.positions, fit.kept)
        row[key] = compared(accuracy_of(controlled.adjusted, controlled.observed), scene)
    row["today"] = {"squares": todays_errors(scene)}
    return row


def summarised(rows: list[Row], sound: list[Row]) -> Row:
    """The table's row of some seeds.

    Args:
        rows: Of one scene and fault.
        sound: Of the same seeds without the fault.
    """

    def root(key: str, of: str = "squares", among: list[Row] = rows) -> Float64[np.ndarray, " k"]:
        return np.sqrt(np.mean([row[key][of] for row in among], axis=0))

    gsd = rows[0]["gsd_m"]
    found = root("found")
    inside = [np.abs(row["found"]["mean"]) <= NORMAL_95 * np.array(row["found"]["mean_sigmas"]) for row in rows]
    values = {"found": found / gsd, "sigma": found / root("found", "expected"), "held": np.mean(inside, axis=0)}
    result: Row = {"scene": rows[0]["scene"], "fault": rows[0]["fault"], "seeds": len(rows)}
    result |= {"plane": float(root("found", "bent")[0]) / gsd, "rim": float(root("found", "rim")[2]) / gsd}
    if "told" in rows[0]:
        values |= {"told": found / root("told"), "today": root("today") / gsd}
        result |= {key: float(root(key)[2]) / gsd for key in ("one", "three")}
    if sound:
        values["none"] = found / root("found", among=sound)
    result |= {
        f"{key}_{axis}": float(value) for key, each in values.items() for axis, value in zip(AXES, each, strict=True)
    }
    counts = np.sum([row["wrong"] for row in rows], axis=0).tolist()
    result |= dict(zip(("wrong", "recall", "false"), counts, strict=True))
    result["cpu"] = float(np.mean([row["cpu"] for row in rows]))
    return result


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--scene", choices=(*SCENES, LARGE), action="append")
    options.add_argument("--fault", choices=FAULTS, action="append")
    options.add_argument("--out", type=Path, help="file of JSON lines")
    arguments = options.parse_args()
    rows: dict[tuple[str, str, int], Row] = {}
    if arguments.out is not None and arguments.out.exists():
        for line in arguments.out.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            rows[row["scene"], row["fault"], row["seed"]] = row
    cases = [(scene, "none") for scene in arguments.scene or SCENES]
    cases += [(scene, fault) for scene in arguments.scene or SCENES for fault in FAULTS[1:] if scene in FAULTY]
    cases = [case for case in cases if arguments.fault is None or case[1] in arguments.fault]
    for seed in range(arguments.seeds):
        for case in cases:
            if (*case, seed) in rows:
                continue
            rows[(*case, seed)] = row = measure(*case, seed)
            if arguments.out is not None:
                with arguments.out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(row) + "\n")
    plain, faulty = [], []
    for scene, fault in cases:
        mine = {seed: rows[scene, fault, seed] for seed in range(arguments.seeds)}
        sound = [rows[scene, "none", seed] for seed in mine if (scene, "none", seed) in rows]
        summary = summarised(list(mine.values()), sound if len(sound) == len(mine) else [])
        (plain if fault == "none" else faulty).append(summary)
    if plain:
        print_table("ground points, no faults (GSD, and ratios)", plain, COLUMNS)
    if faulty:
        print_table("ground points, faults (GSD, and ratios)", faulty, FAULT_COLUMNS)


if __name__ == "__main__":
    main()
