"""`web/`: the viewer as a folder of plain files for any web host, the splat in levels of detail.

What the first picture needs is asked for at once: page, script, tree and root. A file's name, or the address by which
the page asks for it, has its content's digest in it: a host's and a browser's copies of an earlier site are not taken
for this one's.
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

from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.levels import LevelNode
from splatpipe.pipeline.splat.scene import Axes, Scene, turn_of
from splatpipe.pipeline.splat.spz import spz_bytes
from splatpipe.pipeline.web import asset
from splatpipe.pipeline.web.viewer import PageParts, ViewerCamera, ViewerScene, page_of, scene_facts, thinned

INDEX = "index.html"
LEVELS = "levels.json"
PACKED = "viewer.js.gz"
FORMAT = 1
POLICY = (
    "default-src 'none'; script-src 'self' 'wasm-unsafe-eval' blob:; worker-src blob:; style-src 'self';"
    " img-src 'self' data: blob:; connect-src 'self' data: blob:; base-uri 'none'; form-action 'none'"
)
DIGITS = 16  # of a digest, in names: enough for no two files of a site ever to share one
CORE = (0.02, 0.98)  # quantiles of the centres along each axis
SPZ_AXES: Axes = "y up"


def write_site(folder: Path, scene: ViewerScene, splat: Scene, root: LevelNode) -> None:
    """Write the site: `index.html`, its script and style, `levels.json`, `nodes/`, `photos/`, and the sparse points.

    Args:
        folder: Where to; made here, and empty if it is there.
        scene: What it shows besides the splat.
        splat: In the world frame (z up); what its facts say holds for the levels as well.
        root: Of its levels, finite.

    Raises:
        ValueError: if the splat is not z up, a parameter is not finite, or there is no camera.
        MachineError: if this installation was built without the page's script.
        OSError: if a file cannot be written.
    """
    if splat.facts.axes != "z up":
        raise ValueError(f"a site shows a world that is z up, not {splat.facts.axes}")
    thumbs = [_thumb_address(shown) for shown in scene.cameras]
    facts = scene_facts(scene, thumbs)
    nodes = list(root.nodes())
    for name in ("nodes", "photos"):
        (folder / name).mkdir(parents=True)
    tree = [_write_node(folder, node, splat.facts.antialias) for node in nodes]
    number = {id(node): k for k, node in enumerate(nodes)}
    for told, node in zip(tree, nodes, strict=True):
        told["children"] = [number[id(child)] for child in node.children]
    for shown, address in zip(scene.cameras, thumbs, strict=True):
        if shown.thumb is not None and address is not None:
            (folder / address).write_bytes(shown.thumb)
    points, colours = thinned(scene)
    facts["points"] = {
        "address": _write(folder, "points.bin", points.astype("<f4").tobytes() + colours.tobytes()),
        "count": len(points),
    }
    levels = _write(folder, LEVELS, _json({"format": FORMAT, "nodes": tree}))
    facts["levels"] = {"tree": levels, "root": tree[0]["file"], "bytes": tree[0]["bytes"]}
    page = page_of(scene, facts, _page_parts(folder, levels, tree[0]["file"]))
    (folder / INDEX).write_text(page, encoding="utf-8")


def _page_parts(folder: Path, levels: str, first: str) -> PageParts:
    """The page's head asks for what the first picture takes: `start.js` goes on from there."""
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
    """Write a node's splat; what `levels.json` says of it, but for its children."""
    origin = _middle(node.gaussians)
    data = spz_bytes(_about(node.gaussians, origin), antialias, turn=turn_of(SPZ_AXES, "z up"))
    name = f"nodes/{_digest(data)}.spz"
    (folder / name).write_bytes(data)
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
    """Between the outermost centres: from there none is far, and 24 bits hold all in steps of a millimetre and less."""
    means = gaussians.means.detach().numpy().astype(np.float64)
    middle: Float64[np.ndarray, " 3"] = (means.min(axis=0) + means.max(axis=0)) / 2.0
    return middle


def _core(gaussians: Gaussians) -> Float64[np.ndarray, "2 3"]:
    """Where nearly all centres are: by that the viewer finds what is near, and in the window.

    A node's box is around whole Gaussians. A few large and far ones are in most nodes: their boxes are about the eye.
    """
    means = gaussians.means.detach().numpy().astype(np.float64)
    core: Float64[np.ndarray, "2 3"] = np.quantile(means, CORE, axis=0)
    return core


def _about(gaussians: Gaussians, origin: Float64[np.ndarray, " 3"]) -> Gaussians:
    means = (gaussians.means.detach().to(torch.float64) - torch.from_numpy(origin)).to(torch.float32)
    return Gaussians(means, gaussians.log_scales, gaussians.quats, gaussians.opacity_logits, gaussians.sh)


def _thumb_address(shown: ViewerCamera) -> str | None:
    return None if shown.thumb is None else f"photos/{_digest(shown.thumb)}.jpg"


def _write(folder: Path, name: str, data: bytes) -> str:
    """Write a file of a name that people know; the address to ask for it."""
    (folder / name).write_bytes(data)
    return f"{name}?v={_digest(data)}"


def _json(value: Mapping[str, Any] | Sequence[Any]) -> bytes:
    return json.dumps(value, separators=(",", ":"), allow_nan=False).encode()


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGITS]
