"""PlayCanvas' streamed SOG: `lod-meta.json`, and folders of SOG images that it indexes.

The format is that of splat-transform's writer and PlayCanvas' engine (splat-transform 2.7, playcanvas 2.23, both MIT):
a tree of boxes whose leaves name, for each level of detail, a file and the range of its Gaussians in the leaf. Level 0
is the finest; the next finer level replaces one that is missing in a leaf. Boxes and images are in the frame of a 3DGS
PLY, y down.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from jaxtyping import Float64, Int64

from splatpipe.pipeline.engine.files.output_file import own_folder, write_file
from splatpipe.pipeline.splat.formats.sog import AXES, encode_sog
from splatpipe.pipeline.splat.formats.sog_images import META, RECORD
from splatpipe.pipeline.splat.levels.levels import LevelNode
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.moments import moments_of
from splatpipe.pipeline.splat.model.morton import morton_keys
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts

LOD_META = "lod-meta.json"
VERSION = 1
FULL_FILE = 100_000
"""Gaussians after which a level's next leaf starts a new file: keeps downloads to a few megabytes."""
_DIGITS = 7  # significant digits of a number in the tree: a float32's
_LEVEL = re.compile(r"[0-9]+_[0-9]+", re.ASCII)  # level and number, as folders are called


@dataclass(frozen=True, eq=False)
class _Share:
    """The Gaussians of a node that lie in one of its descendants."""

    level: int
    node: LevelNode
    rows: Int64[np.ndarray, " n"]

    def gaussians(self) -> Gaussians:
        return self.node.gaussians.select(torch.from_numpy(self.rows))


@dataclass(eq=False)
class _Files:
    """Files being written: for each level the parts of the current file, and the entries for the tree."""

    folder: Path
    facts: SceneFacts
    names: list[str] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    open: dict[int, tuple[int, list[Gaussians]]] = field(default_factory=dict)  # number in names, parts
    begun: dict[int, int] = field(default_factory=dict)  # files of a level

    def add(self, level: int, part: Gaussians) -> dict[str, int]:
        """Add a leaf's Gaussians of a level to its file; returns their location for the tree."""
        if level not in self.open:
            number = self.begun.get(level, 0)
            self.begun[level] = number + 1
            self.open[level] = (len(self.names), [])
            self.names.append(f"{level}_{number}/{META}")
        file, parts = self.open[level]
        offset = sum(len(each) for each in parts)
        parts.append(part)
        self.counts[level] = self.counts.get(level, 0) + len(part)
        if offset + len(part) >= FULL_FILE:
            self.close(level)
        return {"file": file, "offset": offset, "count": len(part)}

    def close(self, level: int) -> None:
        """Write a level's file."""
        file, parts = self.open.pop(level)
        folder = own_folder(self.folder, PurePosixPath(self.names[file]).parent)
        turned = Scene(Gaussians.concat(parts), self.facts).turned(AXES).gaussians
        for name, data in encode_sog(turned, self.facts.antialias, in_order=True).files().items():
            write_file(folder / name, data)

    def close_all(self) -> None:
        """Write the remaining files."""
        for level in sorted(self.open):
            self.close(level)


def write_streamed_sog(folder: Path, scene: Scene, root: LevelNode) -> None:
    """Write `lod-meta.json` and its SOG folders; deterministic.

    Args:
        folder: Created if missing; files of an earlier export are replaced or deleted, others stay.
        scene: The scene of the levels; its metadata goes into `lod-meta.json` under ``splatpipe``.
        root: Root of its levels of detail, in its frame, with finite parameters.

    Raises:
        ValueError: if a parameter is not finite.
        OSError: if a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    levels = _height(root) + 1
    files = _Files(folder, scene.facts)
    tree = _tree(root, [], levels - 1, files)
    files.close_all()
    counts = [files.counts.get(level, 0) for level in range(levels)]
    meta = {
        "version": VERSION,
        "asset": {"generator": "splatpipe"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": levels,
        RECORD: json.loads(scene.facts.record()),
        "filenames": files.names,
        "tree": tree,
    }
    text = json.dumps(meta, separators=(",", ":"), allow_nan=False)
    write_file(folder / LOD_META, text)
    _drop_earlier(folder, {name.partition("/")[0] for name in files.names})


def _drop_earlier(folder: Path, named: Set[str]) -> None:
    """Delete folders of levels that the index no longer references."""
    for path in sorted(folder.iterdir()):
        earlier = _LEVEL.fullmatch(path.name) and path.name not in named
        if earlier and not path.is_symlink() and (path / META).is_file():
            shutil.rmtree(path)


def _height(node: LevelNode) -> int:
    return 1 + max(_height(child) for child in node.children) if node.children else 0


def _tree(node: LevelNode, above: Sequence[_Share], level: int, files: _Files) -> dict[str, Any]:
    """The tree's entry for a node, with the shares of its ancestors in it, coarsest first.

    Levels are counted from the root down, except that the full model is always level 0: a leaf nearer the root than
    others lacks levels in between, and not the coarsest, without which a reader would show nothing there.
    """
    if not node.children:
        return _leaf([*above, _whole(node, 0)], files)
    divided = [_divided(share, node.children) for share in [*above, _whole(node, level)]]
    children = [
        _tree(child, [parts[k] for parts in divided], level - 1, files) for k, child in enumerate(node.children)
    ]
    low = np.min([child["bound"]["min"] for child in children], axis=0)
    high = np.max([child["bound"]["max"] for child in children], axis=0)
    return {"bound": _bound(low, high), "children": children}


def _whole(node: LevelNode, level: int) -> _Share:
    return _Share(level, node, np.arange(len(node.gaussians)))


def _divided(share: _Share, children: Sequence[LevelNode]) -> list[_Share]:
    """Assign a node's Gaussians to children: to the one whose box of centres contains it, or to the nearest."""
    means = share.node.gaussians.means.detach().to(torch.float64).numpy()[share.rows]
    outside, off = np.empty((2, len(children), len(means)))
    for k, child in enumerate(children):
        centres = child.gaussians.means.detach().to(torch.float64).numpy()
        low, high = centres.min(0), centres.max(0)
        outside[k] = np.linalg.norm(np.maximum(np.maximum(low - means, means - high), 0.0), axis=1)
        off[k] = np.abs((means - 0.5 * (low + high)) / np.maximum(high - low, np.finfo(np.float32).tiny)).max(1)
    nearest = np.lexsort((off, outside), axis=0)[0]
    return [_Share(share.level, share.node, share.rows[nearest == k]) for k in range(len(children))]


def _leaf(shares: Sequence[_Share], files: _Files) -> dict[str, Any]:
    lods: dict[str, dict[str, int]] = {}
    corners: list[Float64[np.ndarray, "2 3"]] = []
    for share in reversed(shares):
        if len(share.rows):
            part = _sorted(share.gaussians())
            lods[str(share.level)] = files.add(share.level, part)
            corners.append(_box(Scene(part, files.facts).turned(AXES).gaussians))
    boxes = np.stack(corners)
    return {"bound": _bound(boxes[:, 0].min(0), boxes[:, 1].max(0)), "lods": lods}


def _sorted(gaussians: Gaussians) -> Gaussians:
    """Sort along a Morton curve: images of neighbours compress better."""
    lowest = gaussians.means.amin(0)
    keys = morton_keys(gaussians.means, lowest, gaussians.means.amax(0) - lowest)
    return gaussians.select(torch.argsort(keys, stable=True))


def _box(gaussians: Gaussians) -> Float64[np.ndarray, "2 3"]:
    """The box around centres ± one standard deviation, as in PlayCanvas."""
    moments = moments_of(gaussians)
    reach = np.sqrt(moments.covariances[:, [0, 3, 5]])
    return np.stack([(moments.means - reach).min(0), (moments.means + reach).max(0)])


def _bound(low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> dict[str, list[float]]:
    return {name: [float(f"{x:.{_DIGITS}g}") for x in corner] for name, corner in (("min", low), ("max", high))}
