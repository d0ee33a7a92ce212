"""The list of splat formats: what each is called, and the module that reads and writes it.

Light to import: the modules are loaded on demand.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatpipe.pipeline.engine.errors import UsageError

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.containers.bounded import CheckValues
    from splatpipe.pipeline.splat.model.position_cost import PositionCost
    from splatpipe.pipeline.splat.model.scene import Scene


@dataclass(frozen=True)
class SplatFormat:
    """A format of one file or folder that only contains a splat.

    Attributes:
        name: Name for users.
        file: File name in a run's `OUT/export/`.
        module: Module in this package.
        writer: Name of the module's function that writes it.
        reads: Whether the module's ``read`` is used for this format: formats may share one.
        exact: Whether a round trip preserves every number, including the lengths of quaternions.
    """

    name: str
    file: str
    module: str
    writer: str = "write"
    reads: bool = True
    exact: bool = False

    @property
    def ending(self) -> str:
        """File name suffix, from the first dot; empty for a folder."""
        return "".join(self.file.partition(".")[1:])

    def write(self, path: Path, scene: Scene) -> PositionCost:
        """Write a scene, and return what its positions have lost; see the module."""
        cost: PositionCost = getattr(importlib.import_module(f"{__package__}.{self.module}"), self.writer)(path, scene)
        return cost

    def read(self, path: Path, check: CheckValues | None = None) -> Scene:
        """Read a scene, refusing unusable values unless ``check`` accepts them; see the module."""
        reader = importlib.import_module(f"{__package__}.{self.module}").read
        scene: Scene = reader(path) if check is None else reader(path, check)
        return scene


SPLAT_FORMATS = (
    SplatFormat("ply", "splat.ply", "plain_ply", exact=True),
    SplatFormat("viewer-ply", "splat.viewer.ply", "plain_ply", "write_for_viewers", reads=False),
    SplatFormat("compressed-ply", "splat.compressed.ply", "compressed_ply"),
    SplatFormat("spz", "splat.spz", "spz"),
    SplatFormat("spz2", "splat.spz2.spz", "spz", "write_version_2", reads=False),
    SplatFormat("model", "model", "model_folder", exact=True),
    SplatFormat("sog", "splat.sog", "sog"),
    SplatFormat("glb", "splat.glb", "glb"),
)
"""All of them."""


def format_named(name: str) -> SplatFormat:
    """The format with a given name.

    Raises:
        UsageError: if there is none.
    """
    found = next((each for each in SPLAT_FORMATS if each.name == name), None)
    if found is None:
        names = ", ".join(each.name for each in SPLAT_FORMATS)
        raise UsageError(f'There is no format "{name[:40]}".', hint=f"Choose from: {names}.")
    return found
