"""`web/`: the viewer as a folder of static files for any web host, with the splat in levels of detail (LOD).

What the first image needs is requested at once: page, script, tree and root. Each file's name, or the URL by which the
page requests it, contains a digest of its content, so that copies of an earlier site cached by hosts or browsers are
never used.
"""

from __future__ import annotations

import gzip
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64

from splatpipe.pipeline.engine.files.output_file import write_file
from splatpipe.pipeline.splat.containers.spz_encoder import spz_bytes
from splatpipe.pipeline.splat.levels.levels import LevelNode
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import Axes, Scene, turn_of
from splatpipe.pipeline.web import asset
from splatpipe.pipeline.web.viewer import PageParts, ViewerCamera, ViewerScene, page_points, render_page, scene_facts

INDEX = "index.html"
LEVELS = "levels.json"
PACKED = "viewer.js.gz"
FORMAT = 1
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src blob:; style-src 'self';"
    " img-src 'self' data: blob:; connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'"
)
DIGEST_CHARACTERS = 16  # hexadecimal digits of a digest in names: enough to be unique within a site
CORE_QUANTILES = (0.02, 0.98)  # quantiles of the centres along each axis
SPZ_AXES: Axes = "y up"


def write_site(folder: Path, scene: ViewerScene, splat: Scene, root: LevelNode) -> None:
    """Write the site: `index.html`, its script and style, `levels.json`, `nodes/`, `photos/`, and the sparse points.

    Args:
        folder: The site's folder; created if missing, else it must be empty.
        scene: What the viewer shows besides the splat.
        splat: The splat in the world frame (z up); its facts apply to the levels too.
        root: The root of its levels of detail, finite.

    Raises:
        ValueError: if the splat is not z up, a parameter is not finite, or there is no camera.
        MachineError: if this installation was built without the page's script.
        OSError: if a file cannot be written.
    """
    if splat.facts.axes != "z up":
        raise ValueError(f"a site shows a world that is z up, not {splat.facts.axes}")
    thumbs = [_thumb_address(camera) for camera in scene.cameras]
    facts = scene_facts(scene, thumbs)
    nodes = list(root.nodes())
    for name in ("nodes", "photos"):
        (folder / name).mkdir(parents=True)
    tree = [_write_node(folder, node, splat.facts.antialias) for node in nodes]
    number = {node: k for k, node in enumerate(nodes)}
    for entry, node in zip(tree, nodes, strict=True):
        entry["children"] = [number[child] for child in node.children]
    for camera, address in zip(scene.cameras, thumbs, strict=True):
        if camera.thumb is not None and address is not None:
            write_file(folder / address, camera.thumb)
    points, colours = page_points(scene)
    facts["points"] = {
        "address": _write(folder, "points.bin", points.astype("<f4").tobytes() + colours.tobytes()),
        "count": len(points),
    }
    levels = _write(folder, LEVELS, _json({"format": FORMAT, "nodes": tree}))
    facts["levels"] = {"tree": levels, "root": tree[0]["file"], "bytes": tree[0]["bytes"]}
    page = render_page(scene, facts, _page_parts(folder, levels, tree[0]["file"]))
    write_file(folder / INDEX, page)


def _page_parts(folder: Path, levels: str, first: str) -> PageParts:
    """Write the scripts and styles; the page's head preloads what the first image needs, and `start.js` continues."""
    viewer = asset("viewer.js").encode()
    script, packed = _write(folder, "viewer.js", viewer), _write(folder, PACKED, gzip.compress(viewer, 9, mtime=0))
    style, start = (_write(folder, name, asset(name).encode()) for name in ("viewer.css", "start.js"))
    head = (
        f'<link rel="stylesheet" href="{style}">',
        f'<script src="{start}" defer data-script="{script}" data-packed="{packed}" data-first="{first}"></script>',
        *(f'<link rel="preload" href="{address}" as="fetch" crossorigin>' for address in (packed, levels)),
    )
    return PageParts(POLICY, "\n".join(head), "")


def _write_node(folder: Path, node: LevelNode, antialias: bool) -> dict[str, Any]:
    """Write a node's splat; returns its entry for `levels.json`, without the children."""
    origin = _middle(node.gaussians)
    data = spz_bytes(_relative_to(node.gaussians, origin), antialias, turn=turn_of(SPZ_AXES, "z up"))
    name = f"nodes/{_digest(data)}.spz"
    write_file(folder / name, data)
    return {
        "file": name,
        "bytes": len(data),
        "count": len(node.gaussians),
        "error": node.error,
        "box": node.box.tolist(),
        "core": _core(node.gaussians).tolist(),
        "origin": origin.tolist(),
    }


def _middle(gaussians: Gaussians) -> Float64[np.ndarray, " 3"]:
    """Midpoint of the centres' bounding box: relative to it, 24-bit coordinates have steps of at most a millimetre."""
    means = gaussians.means.detach().numpy().astype(np.float64)
    middle: Float64[np.ndarray, " 3"] = (means.min(axis=0) + means.max(axis=0)) / 2.0
    return middle


def _core(gaussians: Gaussians) -> Float64[np.ndarray, "2 3"]:
    """The box of nearly all centres, with which the viewer decides what is near and within the view.

    A node's bounding box encloses whole Gaussians: a few large, far ones in most nodes make it contain the viewpoint.
    """
    means = gaussians.means.detach().numpy().astype(np.float64)
    core: Float64[np.ndarray, "2 3"] = np.quantile(means, CORE_QUANTILES, axis=0)
    return core


def _relative_to(gaussians: Gaussians, origin: Float64[np.ndarray, " 3"]) -> Gaussians:
    means = (gaussians.means.detach().to(torch.float64) - torch.from_numpy(origin)).to(torch.float32)
    return Gaussians(means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)


def _thumb_address(camera: ViewerCamera) -> str | None:
    return None if camera.thumb is None else f"photos/{_digest(camera.thumb)}.jpg"


def _write(folder: Path, name: str, data: bytes) -> str:
    """Write a file with a fixed name; returns the URL to request it by."""
    write_file(folder / name, data)
    return f"{name}?v={_digest(data)}"


def _json(value: Mapping[str, Any] | Sequence[Any]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGEST_CHARACTERS]
