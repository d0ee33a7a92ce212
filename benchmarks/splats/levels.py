"""Compare levels of detail with the full model: counts, screen-space errors, a camera path.

    python benchmarks levels OUT [--splat-transform 'node …/bin/cli.mjs']

Prints PSNR against renders of the full model from the photos' positions, for reductions to several shares and for
splat-transform's `--decimate`; PSNR of nodes at the distance where their error is 16 pixels, as drawn and for means of
4 by 4 finer pixels, without the rasterizer's treatment of Gaussians far smaller than a pixel; along a path from afar to
the photos, how much more the image changes between frames than the full model's, and whether it is ever less opaque;
with `--large`, seconds and peak memory of reduction and of levels for that many Gaussians, in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster.rasterizer import Render, RenderOptions, render
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.levels.levels import MAX_PER_NODE, LevelNode, box_distance, build_levels, select_nodes
from splatpipe.pipeline.splat.levels.reduction import reduce_to
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Scene

SHARES = (50, 25, 10, 5)  # percent
ERROR_PX = 16.0
GREY = (0.5, 0.5, 0.5)
SIDE, FOCAL = 384, 800.0  # image side and focal length of a node's view, pixels
FINER = 4  # times as many pixels along each side: nearly the true scene
MIN_COVERED = 60  # pixels: fewer say nothing
FRAMES = 48
FARTHEST = 60.0  # times the photos' distance: the start of the path


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="OUT of a finished run")
    parser.add_argument("--splat-transform", default="", help="command that runs it")
    sizes = f"{MAX_PER_NODE},15000,6000"
    parser.add_argument("--most-per-node", default=sizes, help="small ones, so that a small model has levels")
    parser.add_argument("--every", type=int, default=8, help="of the photos, one in so many is looked from")
    parser.add_argument("--large", type=int, default=0, help="Gaussians to measure time and memory with")
    options = parser.parse_args()
    scene = plain_ply.read(options.out / "splat.ply")
    if options.large:
        measure_large(scene.gaussians, options.large)
        return
    cameras = photo_cameras(options.out)
    equal_counts(scene, cameras[:: options.every], options.out / "splat.ply", shlex.split(options.splat_transform))
    for most in map(int, options.most_per_node.split(",")):
        start = time.perf_counter()
        root = build_levels(scene.gaussians, most)
        seconds = time.perf_counter() - start
        held = sum(len(node.gaussians) for node in root.nodes()) / len(scene.gaussians)
        count = sum(1 for _ in root.nodes())
        print(f"levels of {most:,}: {count} nodes, {held:.2f} times the model, in {seconds:.0f} s", flush=True)
        if root.children:
            node_errors(scene, root, cameras)
            way_through(scene, root, cameras)


def photo_cameras(out: Path) -> list[Camera]:
    """Return the run's cameras at half size."""
    found = []
    for entry in json.loads((out / "cameras.json").read_text(encoding="utf-8")):
        pose, turn = np.eye(4), np.array(entry["rotation"]).T
        pose[:3, :3], pose[:3, 3] = turn, -turn @ np.array(entry["position"])
        width, height = entry["width"], entry["height"]
        camera = Camera(entry["img_name"], width, height, entry["fx"], entry["fy"], width / 2, height / 2, pose)
        found.append(camera.scaled(width // 2, height // 2))
    return found


def drawn(gaussians: Gaussians, camera: Camera, antialias: bool) -> Render:
    """Render on grey."""
    with torch.no_grad():
        options = RenderOptions(gaussians.sh_degree, background=GREY, antialias=antialias, depth=False)
        return render(gaussians, camera, options)


def decibels(one: Tensor, other: Tensor) -> float:
    """PSNR of colours in 0..1."""
    return -10.0 * math.log10(max(float(((one.clamp(0, 1) - other.clamp(0, 1)) ** 2).mean()), 1e-12))


def equal_counts(scene: Scene, cameras: Sequence[Camera], source: Path, command: list[str]) -> None:
    """Print the PSNR of reductions, ours and splat-transform's."""
    full = [drawn(scene.gaussians, camera, scene.facts.antialias).colour for camera in cameras]

    def likeness(gaussians: Gaussians) -> float:
        seen = (drawn(gaussians, camera, scene.facts.antialias).colour for camera in cameras)
        return float(np.mean([decibels(one, other) for one, other in zip(full, seen, strict=True)]))

    for share in SHARES:
        theirs, count = "", round(len(scene.gaussians) * share / 100)
        if command:
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "peer.ply"
                asked = [*command, "-q", "-w", "-g", "cpu", str(source), "--decimate", f"{share}%", str(path)]
                subprocess.run(asked, check=True, capture_output=True)
                peer = plain_ply.read(path).gaussians
            theirs, count = f", splat-transform {likeness(peer):.2f}", len(peer)
        start = time.perf_counter()
        reduced = reduce_to(scene.gaussians, count)
        seconds = time.perf_counter() - start
        print(f"{share} %, {count:,}: {likeness(reduced):.2f} dB in {seconds:.0f} s{theirs}", flush=True)


def aimed_camera(place: np.ndarray, target: np.ndarray, focal: float, width: int, height: int) -> Camera:
    """Return an upright camera at a place, looking at a target."""
    ahead = (target - place) / np.linalg.norm(target - place)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= max(float(np.linalg.norm(right)), 1e-9)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ place
    return Camera("", width, height, focal, focal, width / 2, height / 2, pose)


def place_at(node: LevelNode, target: np.ndarray, towards: np.ndarray, distance: float) -> np.ndarray:
    """Return a place on a ray from a point, at a distance from a node's box."""
    near, far = 0.0, distance + float(np.linalg.norm(node.box[1] - node.box[0])) * 2.0
    for _ in range(60):
        middle = 0.5 * (near + far)
        near, far = (middle, far) if box_distance(node.box, target + towards * middle) < distance else (near, middle)
    return np.asarray(target + towards * far)


def full_of(node: LevelNode) -> Gaussians:
    """Return the full model below a node."""
    return Gaussians.concat([each.gaussians for each in node.nodes() if not each.children])


def finer(gaussians: Gaussians, camera: Camera, antialias: bool) -> Tensor:
    """Return the colours of a render whose pixels are means of a finer one's."""
    colour = drawn(gaussians, camera.scaled(FINER * camera.width, FINER * camera.height), antialias).colour
    return colour.reshape(camera.height, FINER, camera.width, FINER, 3).mean(dim=(1, 3))


def node_errors(scene: Scene, root: LevelNode, cameras: Sequence[Camera]) -> None:
    """Print the lowest PSNR over what nodes cover, from where their error is 16 pixels, in the photos' directions."""
    found, antialias = [], scene.facts.antialias
    for node in (each for each in root.nodes() if each.children):
        full = full_of(node)
        middle = full.means.median(dim=0).values.double().numpy()
        for camera in cameras[:: max(1, len(cameras) // 3)]:
            towards = camera.centre() - middle
            towards /= np.linalg.norm(towards)
            place = place_at(node, middle, towards, node.error * FOCAL / ERROR_PX)
            view = aimed_camera(place, middle, FOCAL, SIDE, SIDE)
            picture, ours = (drawn(gaussians, view, antialias) for gaussians in (full, node.gaussians))
            covered = picture.alpha > 0.5
            if int(covered.sum()) >= MIN_COVERED:
                as_drawn = decibels(picture.colour[covered], ours.colour[covered])
                finely = decibels(
                    finer(full, view, antialias)[covered], finer(node.gaussians, view, antialias)[covered]
                )
                found.append((as_drawn, finely))
    least, middle_dB = np.min(found, axis=0), np.median(found, axis=0)
    print(
        f"  where a node's error is {ERROR_PX:.0f} px: least {least[0]:.1f} dB, median {middle_dB[0]:.1f}, "
        f"of {len(found)} views; of finer pixels {least[1]:.1f}, {middle_dB[1]:.1f}",
        flush=True,
    )


def way_through(scene: Scene, root: LevelNode, cameras: Sequence[Camera]) -> None:
    """Print what frames on a path from afar to a photo's position show, with levels chosen as in a viewer."""
    target = scene.gaussians.means.median(dim=0).values.double().numpy()
    photo = cameras[len(cameras) // 2]
    ray = photo.centre() - target
    before: tuple[Tensor, Tensor] | None = None
    worst_dB, worst_jump, holes, chosen_counts = math.inf, 0.0, 0, []
    for step in range(FRAMES):
        times = FARTHEST ** (1.0 - step / (FRAMES - 1))
        view = aimed_camera(target + ray * times, target, photo.fx, photo.width, photo.height)
        chosen = Gaussians.concat([n.gaussians for n in select_nodes(root, view.centre(), view.fx, ERROR_PX)])
        chosen_counts.append(len(chosen))
        one, other = drawn(scene.gaussians, view, scene.facts.antialias), drawn(chosen, view, scene.facts.antialias)
        worst_dB = min(worst_dB, decibels(one.colour, other.colour))
        holes = max(holes, int(((one.alpha > 0.98) & (other.alpha < 0.9)).sum()))
        if before is not None:
            full_change = float((one.colour - before[0]).abs().mean())
            worst_jump = max(worst_jump, float((other.colour - before[1]).abs().mean()) / full_change)
        before = (one.colour, other.colour)
    print(
        f"  way of {FRAMES} frames, {min(chosen_counts):,} to {max(chosen_counts):,} Gaussians: least {worst_dB:.1f} "
        f"dB, largest change of a frame {worst_jump:.2f} times the full model's, most pixels less opaque {holes}",
        flush=True,
    )


def measure_large(gaussians: Gaussians, count: int) -> None:
    """Print seconds and peak memory for ``count`` Gaussians: copies of a model side by side."""
    side = float((gaussians.means.quantile(0.95, dim=0) - gaussians.means.quantile(0.05, dim=0)).max())
    copies = math.ceil(count / len(gaussians))
    row = math.ceil(math.sqrt(copies))
    large = Gaussians.concat([gaussians] * copies)
    for copy in range(copies):
        rows = slice(copy * len(gaussians), (copy + 1) * len(gaussians))
        large.means[rows] += side * torch.tensor([float(copy % row), float(copy // row), 0.0])
    large = large.first(count).clone()
    own = sum(tensor.numel() * tensor.element_size() for tensor in large.tensors().values())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    print(f"{count:,} Gaussians, {own / 1e9:.2f} GB; the process had {before / 1e9:.2f} GB at most before", flush=True)
    for name, made in (("half", lambda: reduce_to(large, count // 2)), ("levels", lambda: build_levels(large))):
        start = time.perf_counter()
        made()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        print(f"{name}: {time.perf_counter() - start:.0f} s, peak {peak / own:.2f} times their size", flush=True)


if __name__ == "__main__":
    sys.exit(main())
