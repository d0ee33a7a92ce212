"""SOG, PlayCanvas' compressed splat: a ZIP of meta.json and lossless WebP pictures, or the same as a folder.

Specification: "The SOG Format" (developer.playcanvas.com), version 2. Where it and PlayCanvas' own programs differ,
the programs hold: the frame is the PLY's (viewers take −y for up), the omitted component of a quaternion is counted
w, x, y, z.

For who builds files of several of them, without a file of its own::

    encode_sog(gaussians: Gaussians, antialias=False, record="", in_order=False) -> SogImages
    SogImages.meta: dict, .images: dict[str, bytes], .files() -> dict[str, bytes]  # with meta.json
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from splatpipe.pipeline.splat.formats.sog_images import SogImages, encode_sog
from splatpipe.pipeline.splat.scene import Axes, Scene

__all__ = ["AXES", "SogImages", "encode_sog", "write"]

AXES: Axes = "y down"
_FIRST_DAY = (1980, 1, 1, 0, 0, 0)  # of a ZIP's calendar: the same bytes on any day


def write(path: Path, scene: Scene) -> None:
    """Write it, bundled, turned to y down.

    Args:
        path: The file; replaced if it is there.
        scene: What to write.

    Raises:
        ValueError: if a value is not finite.
        OSError: if the file cannot be written.
    """
    scene = scene.turned(AXES)
    files = encode_sog(scene.gaussians, scene.facts.antialias, scene.facts.record()).files()
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(zipfile.ZipInfo(name, _FIRST_DAY), data)
