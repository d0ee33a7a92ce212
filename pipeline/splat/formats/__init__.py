"""Splat files: a module a format, each with ``read(path) -> Scene`` or ``write(path, scene)``, and their names.

Light to import: the modules are loaded when they are asked for.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatpipe.pipeline.splat.scene import Scene


@dataclass(frozen=True)
class SplatFormat:
    """A format of one file or folder that holds a splat, and no more.

    Attributes:
        name: As people ask for it.
        file: What a run's is called, below `OUT/export/`.
        module: In this package.
        reads: Whether there is a reader.
    """

    name: str
    file: str
    module: str
    reads: bool = True

    def write(self, path: Path, scene: Scene) -> None:
        """Write a scene; see the module."""
        importlib.import_module(f"{__name__}.{self.module}").write(path, scene)

    def read(self, path: Path) -> Scene:
        """Read a scene; see the module."""
        scene: Scene = importlib.import_module(f"{__name__}.{self.module}").read(path)
        return scene


SPLAT_FORMATS = (SplatFormat("ply", "splat.ply", "plain_ply"),)
"""All of them."""
