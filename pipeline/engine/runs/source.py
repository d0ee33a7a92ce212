"""The user's input: a folder of photos (with masks), a film, or another program's reconstruction; and survey files."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import BaseModel

from splatpipe.pipeline.engine.digests import MAX_SOURCE_FILES, HashTable, walk_files
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.engine.runs.colmap_folder import SparseModels, find_models
from splatpipe.pipeline.engine.runs.other_input import other_input
from splatpipe.pipeline.engine.stage import NamedFile, Reporter, Stage

MASK_FOLDERS = ("masks", "sky_masks")
FILM_SUFFIXES = (".mp4", ".mov", ".m4v")
SUBTITLE_SUFFIX = ".srt"
AUTO, NONE = "auto", "none"  # values of an option that names a file, other than a path
MAX_NAMED_BYTES = 64 << 20  # the size of a table of a million photos; a larger file was named by mistake
ABSENT = Path(os.devnull)  # path of a part without a file: not a regular file, and empty if read


@dataclass(frozen=True)
class RunSource:
    """The input of a run.

    Attributes:
        folder: The folder, or the film, that the user named.
        models: The COLMAP models in it, if it is a reconstruction and not just photos.
        named: The file of each single-file part, e.g. ``source.control``; None if there is none.
        skipped: Files to skip when collecting photos: those of single-file parts, used or not.
    """

    folder: Path
    models: SparseModels | None
    named: Mapping[str, Path | None] = field(default_factory=dict)
    skipped: frozenset[Path] = frozenset()

    @property
    def model(self) -> Path | None:
        """The COLMAP model that is used; None for just photos."""
        return None if self.models is None else self.models.used

    @property
    def part_files(self) -> dict[str, dict[str, Path]]:
        """The files of each external part: ``source.photos``, ``sparse.model`` if present, and single-file parts.

        Raises:
            SplatpipeError: if the folder has too many files.
        """
        roots = [self.folder]
        films = film_files(self.folder)
        if self.model is not None:
            roots = [self.folder / name for name in ("images", *MASK_FOLDERS)]
        beside = [self.folder.parent / name for name in MASK_FOLDERS]
        roots += [root for root in beside if root.is_dir() and root != self.folder]
        photos = {
            os.path.relpath(path, self.folder): path
            for root in roots
            for path in walk_files(root)
            if path not in self.skipped
        }
        photos |= {os.path.relpath(path, self.folder.parent): path for path in films}
        if len(photos) > MAX_SOURCE_FILES:
            raise SplatpipeError(
                f"{self.folder} contains {len(photos):,} files.",
                hint="Give a folder with the photos of one capture.",
            )
        parts = {"source.photos": photos}
        if self.model is not None:
            parts["sparse.model"] = {path.name: path for path in walk_files(self.model)}
        # The name is not part of the digest: the same points in another file are the same points.
        parts |= {part: {} if path is None else {"": path} for part, path in self.named.items()}
        return parts

    def part_path(self, part: str) -> Path:
        """The path of a part; ``ABSENT`` for a part without a file."""
        if part in self.named:
            return self.named[part] or ABSENT
        return self.model if part == "sparse.model" and self.model is not None else self.folder

    def digests(self, table: HashTable, threads: int, report: Reporter) -> dict[str, str]:
        """Content digest of every external part."""
        return {
            part: table.digest_of(
                files, threads, lambda done, total: report.progress(done, total, "reading photos", "files")
            )
            for part, files in self.part_files.items()
        }


def open_source(photos: Path, out: Path, stages: Sequence[Stage] = (), config: BaseModel | None = None) -> RunSource:
    """Examine the folder or film that the user named as PHOTOS.

    Args:
        photos: A folder of photos, or one with ``images/`` and ``sparse/``, or a film.
        out: Where the run writes; must not lie inside the photos.
        stages: The pipeline, whose stages may read files that lie with the photos.
        config: The pipeline's configuration, which may name these files.

    Raises:
        SplatpipeError: if there is no such folder or file, or it cannot be read.
        UsageError: if ``out`` lies inside the folder, or the folder has two files for one part.
    """
    folder = photos.expanduser().resolve()
    if not folder.exists():
        raise SplatpipeError(f"There is no folder {photos}.", hint="Check the path of the photos.")
    film = is_film(folder)
    if not folder.is_dir() and not film:
        other = other_input(photos)
        if other is not None:
            raise SplatpipeError(f"{photos} {other.what}.", hint=other.hint)
        raise SplatpipeError(f"{photos} is a file.", hint="Give the folder with the photos, or a film (MP4, MOV).")
    if not os.access(folder, os.R_OK if film else os.R_OK | os.X_OK):
        what = "film" if film else "folder"
        raise SplatpipeError(f"The {what} {photos} cannot be read: permission denied.", hint="Check its permissions.")
    destination = out.expanduser().resolve()
    if destination == folder or folder in destination.parents:
        raise UsageError(
            f"{out} lies inside the photo folder {photos}.",
            hint="Choose an OUT beside the photos, not among them.",
        )
    listed = list(_named_files(stages))
    known = {name for _, _, file in listed for name in file.names}
    beside = {root: _files_called(root, known) for root in (folder, folder.parent)}
    named = {}
    for section, option, file in listed:
        setting = str(getattr(getattr(config, section), option))
        named[file.part] = _choose(file, f"{section}.{option}", setting, beside)
    skipped = {path for paths in beside.values() for path in paths.values()}
    skipped |= {path for path in named.values() if path is not None}
    return RunSource(folder, find_models(folder), named, frozenset(skipped))


def with_absolute_files(config: BaseModel, stages: Sequence[Stage]) -> BaseModel:
    """The configuration with the paths of named files made absolute, independent of the current folder."""
    for section, option, _ in _named_files(stages):
        part = getattr(config, section)
        setting = getattr(part, option)
        if setting not in (AUTO, NONE):
            path = str(Path(setting).expanduser().resolve())
            config = config.model_copy(update={section: part.model_copy(update={option: path})})
    return config


def _named_files(stages: Iterable[Stage]) -> Iterable[tuple[str, str, NamedFile]]:
    return ((stage.name, option, file) for stage in stages for option, file in stage.files.items())


def _files_called(root: Path, names: set[str]) -> dict[str, Path]:
    """The files with these names directly in a folder, by lower-case name."""
    try:
        found = sorted(path for path in root.iterdir() if path.name.casefold() in names)
    except OSError:
        return {}
    return {path.name.casefold(): path for path in found if path.is_file()}


def _choose(file: NamedFile, option: str, setting: str, beside: Mapping[Path, Mapping[str, Path]]) -> Path | None:
    """The file of a part: the one the option names, else the one found with the photos, else None."""
    if setting == NONE:
        return None
    if setting != AUTO:
        return _check_file(Path(setting), option)
    for files in beside.values():
        found = [files[name] for name in file.names if name in files]
        if len(found) > 1:
            raise UsageError(
                f"{found[0].parent} has both {found[0].name} and {found[1].name}.",
                hint=f"Choose one: --set {option}=PATH, or {option}=none.",
            )
        if found:
            return _check_file(found[0], option)
    return None


def _check_file(path: Path, option: str) -> Path:
    if not path.is_file():
        what = "is a folder" if path.is_dir() else "is not a regular file" if path.exists() else "does not exist"
        raise SplatpipeError(f"The file {path} of {option} {what}.", hint=f"Check the path, or set {option}=none.")
    if not os.access(path, os.R_OK):
        raise SplatpipeError(
            f"The file {path} of {option} cannot be read: permission denied.", hint="Check its permissions."
        )
    if path.stat().st_size > MAX_NAMED_BYTES:
        raise SplatpipeError(
            f"The file {path} of {option} is {path.stat().st_size / 1e6:,.0f} MB, too large for a table of positions.",
            hint=f"Check the path, or set {option}=none.",
        )
    return path


def is_film(path: Path) -> bool:
    """Whether what the user named is a film, by its name: a file of its own, not a folder."""
    return path.suffix.casefold() in FILM_SUFFIXES and path.is_file()


def subtitles_beside(film: Path) -> Path | None:
    """The subtitle file (SRT) beside a film: of the same name, whatever its letters' case."""
    wanted = (film.stem + SUBTITLE_SUFFIX).casefold()
    try:
        found = sorted(path for path in film.parent.iterdir() if path.name.casefold() == wanted and path.is_file())
    except OSError:
        return None
    return found[0] if found else None


def film_files(path: Path) -> list[Path]:
    """The files that a film consists of: itself, and its subtitles; none if the path is not a film's."""
    if not is_film(path):
        return []
    subtitles = subtitles_beside(path)
    return [path] if subtitles is None else [path, subtitles]
