"""Splats as folders of files with levels of detail."""

from __future__ import annotations

from pathlib import Path

from splatpipe.pipeline.delivery.ecef_tiles import write_tiles_on_globe
from splatpipe.pipeline.splat.levels.levels import build_levels
from splatpipe.pipeline.splat.levels.streamed_sog import write_streamed_sog
from splatpipe.pipeline.splat.levels.tiles import require_georeference
from splatpipe.pipeline.splat.model.scene import Scene


def write_tiles_folder(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write 3D Tiles; returns how well their place is known, if not exactly."""
    require_georeference(scene.facts)
    placement = write_tiles_on_globe(path, scene, build_levels(scene.gaussians))
    return (placement.note,) if placement.approximate else ()


def write_streamed_folder(path: Path, scene: Scene) -> tuple[str, ...]:
    """Write PlayCanvas' streamed SOG."""
    write_streamed_sog(path, scene, build_levels(scene.gaussians))
    return ()


FOLDERS = {"tiles": write_tiles_folder, "streamed-sog": write_streamed_folder}
"""Writers by the names of their formats."""
