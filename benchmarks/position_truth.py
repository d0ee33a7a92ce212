"""Compare the adjustment to camera positions with the truth, by geometry: ``position_truth.py [--seeds 20]``.

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
from position_scenes import COMMON_M, DRIFT, DRIFT_M, FAULTS, SCENES, STATED_M, WHITE_M, Scene, draw_scene
from tables import Row, print_table

from splatpipe.pipeline.geometry.similarity import Similarity, fit_similarity
from splatpipe.pipeline.survey.block import Block
from splatpipe.pipeline.survey.block_accuracy import BlockAccuracy, accuracy_of
from splatpipe.pipeline.survey.block_adjustment import PositionObservations, adjust_block
from splatpipe.pipeline.survey.position_adjustment import SIMPLE, LensKnowledge, converge, prior_lens
from splatpipe.pipeline.survey.position_noise import PositionNoise, as_stated

CONTROL_M = np.array([0.02, 0.02, 0.03])
MARK_PX = 0.5
CONTROL_AT = ((0.0, 0.0), (-0.6, -0.6), (0.6, -0.4))  # of half the ground's extent; one point alone is the first
THREE_AT = ((-0.6, -0.6), (0.6, -0.4), (0.0, 0.6))
WEAK_M = 100.0  # of positions that only hold the frame
FAULTY = ("flat", "alternating")
COLUMNS = {
    "scene": "scene:",
    "seeds": "seeds:",
    "E": "found_e:.2f",
    "N": "found_n:.2f",
    "U": "found_u:.2f",
    "/told E": "told_e:.2f",
    "N ": "told_n:.2f",
    "U ": "told_u:.2f",
    "/sigma E": "sigma_e:.2f",
    "N  ": "sigma_n:.2f",
    "U  ": "sigma_u:.2f",
    "off plane": "plane:.2f",
    "one point": "one:.2f",
    "three": "three:.2f",
    "held E": "held_e:.2f",
    "N   ": "held_n:.2f",
    "U   ": "held_u:.2f",
    "today E": "today_e:.1f",
    "N    ": "today_n:.1f",
    "U    ": "today_u:.1f",
    "CPU s": "cpu:.1f",
}
FAULT_COLUMNS = {
    "scene": "scene:",
    "fault": "fault:",
    "seeds": "seeds:",
    "E": "found_e:.2f",
    "N": "found_n:.2f",
    "U": "found_u:.2f",
    "/none E": "none_e:.2f",
    "N ": "none_n:.2f",
    "U ": "none_u:.2f",
    "/sigma E": "sigma_e:.2f",
    "N  ": "sigma_n:.2f",
    "U  ": "sigma_u:.2f",
    "wrong": "wrong:",
    "left out": "recall:",
    "sound left out": "false:",
    "CPU s": "cpu:.1f",
}


def compared(accuracy: BlockAccuracy, scene: Scene) -> dict[str, list[float]]:
    """Compare ground points with the truth; mean squares in metres squared, means in metres."""
    errors = accuracy.places - scene.points[accuracy.points]
    design = np.column_stack([np.ones(len(errors)), scene.points[accuracy.points][:, :2]])
    bent = errors[:, 2] - design @ np.linalg.lstsq(design, errors[:, 2], rcond=None)[0]
    return {
        "squares": (errors**2).mean(axis=0).tolist(),
        "expected": (accuracy.ground_sigmas() ** 2).mean(axis=0).tolist(),
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
    told = PositionNoise(noise.classes, noise.of, factors, factors, share, np.full(2, DRIFT))
    return replace(told.observations(positions), offset_sigmas=COMMON_M[None])


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
    away = scene.points[point] - scene.flight.centres[photos]
    rays = np.einsum("kij,kj->ki", scene.flight.rotations[photos], away)
    return np.asarray(scene.camera.img_from_cam(rays), np.float64)


def todays_errors(scene: Scene) -> list[float]:
    """Mean squares of the ground's errors by a free adjustment with a simple lens and a similarity to the positions."""
    camera: pycolmap.Camera = scene.stated
    lens = prior_lens(camera, LensKnowledge(float(camera.params[0]), 0.1), SIMPLE)
    positions = scene.positions
    weak = as_stated(replace(positions, sigmas=np.full_like(positions.sigmas, WEAK_M))).observations(positions)
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
    row |= {"found": compared(accuracy, scene), "settled": fit.adjusted.settled}
    row |= {"focal": [float(fit.adjusted.block.lenses[0].values[0]), float(scene.camera.params[0])]}
    row["focal"].append(float(accuracy.lens_sigmas()[0][0, 0] ** 0.5))
    noise = fit.noise
    row["noise"] = [noise.factors.tolist(), noise.shares.tolist(), noise.correlations.tolist()]
    row["wrong"] = [int(scene.wrong.sum()), int((scene.wrong & ~fit.kept).sum()), int((~scene.wrong & ~fit.kept).sum())]
    if fault != "none":
        return row
    observed = told_noise(scene)
    row["told"] = compared(accuracy_of(adjust_block(fit.adjusted.block, observed), observed), scene)
    for key, places in (("one", CONTROL_AT[:1]), ("three", THREE_AT)):
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
    result: Row = {"scene": rows[0]["scene"], "fault": rows[0]["fault"], "seeds": len(rows)}
    quotients = {"found": np.full(3, gsd), "sigma": root("found", "expected")}
    if "told" in rows[0]:
        quotients["told"] = root("told")
        result |= {key: float(root(key)[2]) / gsd for key in ("one", "three")}
        result |= {f"today_{axis}": value for axis, value in zip("enu", (root("today") / gsd).tolist(), strict=True)}
    if sound:
        quotients["none"] = root("found", among=sound)
    for key, scale in quotients.items():
        result |= {f"{key}_{axis}": value for axis, value in zip("enu", (found / scale).tolist(), strict=True)}
    inside = [np.abs(row["found"]["mean"]) <= 1.96 * np.array(row["found"]["mean_sigmas"]) for row in rows]
    result |= {f"held_{axis}": value for axis, value in zip("enu", np.mean(inside, axis=0).tolist(), strict=True)}
    result["plane"] = float(root("found", "bent")[0]) / gsd
    counts = np.sum([row["wrong"] for row in rows], axis=0).tolist()
    result |= dict(zip(("wrong", "recall", "false"), counts, strict=True))
    result["cpu"] = float(np.mean([row["cpu"] for row in rows]))
    return result


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--seeds", type=int, default=20)
    options.add_argument("--scene", choices=SCENES, action="append")
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
