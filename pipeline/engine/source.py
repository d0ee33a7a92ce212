"""The user's folder: photos (with masks), or a reconstruction of another program with its images."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.digests import MAX_SOURCE_FILES, HashTable, walk_files
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.stage import Reporter

MODEL_FILES = ("cameras.bin", "cameras.txt")
MASK_FOLDERS = ("masks", "sky_masks")


@dataclass(frozen=True)
class Source:
    """Where a run starts from.

    Attributes:
        folder: The folder the user named.
        model: The COLMAP model in it, where it is a reconstruction and not just photos.
    """

    folder: Path
    model: Path | None

    @property
    def part_files(self) -> dict[str, dict[str, Path]]:
        """The external parts and their files by name: ``source.photos``, and ``sparse.model`` where there is one."""
        roots = [self.folder]
        if self.model is not None:
            roots = [self.folder / name for name in ("images", *MASK_FOLDERS)]
        beside = [self.folder.parent / name for name in MASK_FOLDERS]
        roots += [root for root in beside if root.is_dir() and root != self.folder]
        photos = {os.path.relpath(path, self.folder): path for root in roots for path in walk_files(root)}
        if len(photos) > MAX_SOURCE_FILES:
            raise SplatpipeError(
                f"{self.folder} holds {len(photos):,} files.",
                hint="Name the folder that has the photos of one capture.",
            )
        parts = {"source.photos": photos}
        if self.model is not None:
            parts["sparse.model"] = {path.name: path for path in walk_files(self.model)}
        return parts

    def part_path(self, part: str) -> Path:
        """Where a part lies."""
        return self.model if part == "sparse.model" and self.model is not None else self.folder

    def digests(self, table: HashTable, threads: int, report: Reporter) -> dict[str, str]:
        """Content digest of every external part."""
        return {
            part: table.digest_of(
                files, threads, lambda done, total: report.progress(done, total, "reading photos", "files")
            )
            for part, files in self.part_files.items()
        }


def open_source(photos: Path, out: Path) -> Source:
    """Look at what the user named as PHOTOS.

    Args:
        photos: The folder of photos, or with ``images/`` and ``sparse/0``.
        out: Where the run writes; must not lie inside the photos.

    Raises:
        SplatpipeError: if there is no such folder.
        UsageError: if ``out`` lies inside it.
    """
    folder = photos.expanduser().resolve()
    if not folder.exists():
        raise SplatpipeError(f"There is no folder {photos}.", hint="Check the path of the photos.")
    if not folder.is_dir():
        raise SplatpipeError(f"{photos} is a file.", hint="Name the folder that has the photos.")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise SplatpipeError(f"The folder {photos} may not be read.", hint="Check its permissions.")
    destination = out.expanduser().resolve()
    if destination == folder or folder in destination.parents:
        raise UsageError(
            f"{out} lies inside the photo folder {photos}.",
            hint="Choose an OUT beside the photos, not among them.",
        )
    return Source(folder, _find_model(folder))


def _find_model(folder: Path) -> Path | None:
    if not (folder / "images").is_dir():
        return None
    for model in (folder / "sparse" / "0", folder / "sparse"):
        if any((model / name).is_file() for name in MODEL_FILES):
            return model
    return None
