"""The artifacts of a run: keys, manifests, and an atomic commit, so that they appear whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath
from stat import S_ISREG

from splatpipe.pipeline.engine.digests import FileEntry, canonical, digest, part_digest, tree_entries
from splatpipe.pipeline.engine.errors import MachineError, StageError, UsageError
from splatpipe.pipeline.engine.files.durable import (
    copy_durably,
    remove_unfinished,
    sync_folder,
    sync_tree,
    write_durably,
)
from splatpipe.pipeline.engine.files.json_file import read_json
from splatpipe.pipeline.engine.files.output_file import is_inside, own_folder, require_own_files
from splatpipe.pipeline.engine.stage import JSON, Stage, Summary

FORMAT = 1  # version of the layout of OUT; raised when older versions could no longer read it
KEY_CHARACTERS = 16  # in a folder's name: 64 bits are enough for the few artifacts of one OUT
MIN_FREE_BYTES = 16 << 20
MANIFEST = "manifest.json"


@dataclass(frozen=True)
class Part:
    """A named part of an artifact: its path and the digest of its content."""

    path: Path
    digest: str


@dataclass(frozen=True)
class Artifact:
    """The output of a finished stage: its folder and its manifest."""

    folder: Path
    manifest: Mapping[str, JSON]

    @property
    def key(self) -> str:
        return str(self.manifest["key"])

    @property
    def summary(self) -> Summary:
        summary: Summary = self.manifest["summary"]
        return summary

    @property
    def parts(self) -> dict[str, Part]:
        """The artifact's parts by full name, e.g. ``georef.frame``."""
        return {
            f"{self.manifest['stage']}.{name}": Part(self.folder / part["path"], part["digest"])
            for name, part in self.manifest["parts"].items()
        }

    def deliverables(self, stage: Stage) -> dict[Path, Path]:
        """The files of the stage's deliverables by path relative to OUT, as its manifest lists them."""
        files: dict[Path, Path] = {}
        for name in stage.deliverables:
            if name not in self.manifest["parts"]:  # an artifact of an older version, which had no such part
                continue
            part = self.manifest["parts"][name]
            root = PurePosixPath(part["path"])
            for path in sorted(PurePosixPath(entry["path"]) for entry in part["files"]):
                files[Path(path.relative_to(root.parent if path == root else root))] = self.folder / path
        return files


@dataclass(frozen=True)
class StageInputs:
    """Everything a stage's result depends on; its digest is the key."""

    stage: str
    version: int
    config: Mapping[str, JSON]
    borrowed: Mapping[str, JSON]
    reads: Mapping[str, str]

    @property
    def key(self) -> str:
        return digest(asdict(self))


def unchecked() -> None:
    """The check of a commit that nothing keeps from being made."""


class Store:
    """The ``stages/`` folder of an OUT.

    Args:
        out: The run's folder; made by ``open_store``.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.stages = out / "stages"
        self.partials = self.stages / ".partial"
        self.shards = self.stages / ".shards"  # logs and events of processes that ran a single shard

    def find(self, stage: Stage, key: str) -> Artifact | None:
        """The finished artifact with that key if all of its files exist with the recorded sizes, else None."""
        artifact = _read_artifact(self.stages / _folder_name(stage.name, key))
        if artifact is None or artifact.key != key or set(artifact.manifest["parts"]) != set(stage.parts):
            return None
        return artifact

    def artifacts(self, stage: str) -> list[Artifact]:
        """All finished artifacts of a stage, newest first."""
        found = [_read_artifact(folder) for folder in self.stages.glob(f"{stage}-*")]
        whole = [artifact for artifact in found if artifact is not None]
        return sorted(whole, key=lambda artifact: float(artifact.manifest["finished_s"]), reverse=True)

    def working_folder(self, stage: Stage, key: str) -> Path:
        """The folder in which a stage with that key works until it is done; it may not exist."""
        return self.partials / _folder_name(stage.name, key)

    def begin(self, stage: Stage, key: str) -> Path:
        """Make a stage's empty working folder; a resumable stage gets back the one that a killed run left."""
        folder = self.working_folder(stage, key)
        if folder.exists() and not stage.resumable:
            shutil.rmtree(folder)
        folder.mkdir(parents=True, exist_ok=True)
        remove_unfinished(folder)
        return folder

    def commit(
        self,
        stage: Stage,
        inputs: StageInputs,
        partial: Path,
        summary: Summary,
        run: Mapping[str, JSON],
        check: Callable[[], None] = unchecked,
    ) -> Artifact:
        """Turn ``partial`` into the stage's artifact: manifest last, everything synced, then one rename.

        Args:
            stage: The stage that ran.
            inputs: What its result depended on.
            partial: Its working folder; files that belong to no part are deleted.
            summary: What the body returned.
            run: Versions, machine, timings: what is not part of the key.
            check: Called after each of the steps that may take long, the last time just before the rename; what it
                raises leaves ``partial`` as it is.

        Raises:
            StageError: if the body did not write one of its parts.
        """
        parts: dict[str, dict[str, JSON]] = {}
        for name, relative in stage.parts.items():
            if not (partial / relative).exists():
                raise StageError(
                    f"The stage {stage.name} did not write {relative}.",
                    hint="This is a bug in splatpipe; please report it.",
                )
            entries = tree_entries(partial / relative, partial)
            check()
            parts[name] = {
                "path": relative,
                "digest": part_digest(entries, relative),
                "files": [asdict(entry) for entry in entries],
            }
        manifest = {
            "format": FORMAT,
            "stage": stage.name,
            "key": inputs.key,
            "inputs": asdict(inputs),
            "parts": parts,
            "summary": summary,
            "finished_s": time.time(),
            **run,
        }
        sync_tree(partial)
        check()
        write_durably(partial / MANIFEST, json.dumps(manifest, indent=1))
        _drop_strays(partial, {MANIFEST, *(entry["path"] for part in parts.values() for entry in part["files"])})
        check()
        return self._publish(partial)

    def _publish(self, partial: Path) -> Artifact:
        final = self.stages / partial.name
        if final.exists():
            replaced = self.partials / f"replaced-{partial.name}"
            shutil.rmtree(replaced, ignore_errors=True)
            final.rename(replaced)
            partial.rename(final)
            shutil.rmtree(replaced)
        else:
            partial.rename(final)
        sync_folder(self.stages)
        artifact = _read_artifact(final)
        if artifact is None:
            raise StageError(
                f"{final.name} changed while it was being written.",
                hint="Is something else writing into OUT?",
            )
        return artifact

    def recover(self, shard: str = "") -> None:
        """Finish the rename that a killed run had begun, and delete what it had replaced.

        Args:
            shard: The shard whose lock is held; empty if the whole OUT is locked.
        """
        for partial in sorted(self.partials.glob("*")):
            if shard and not partial.name.removeprefix("replaced-").startswith(f"{shard}-"):
                continue
            if partial.name.startswith("replaced-"):
                shutil.rmtree(partial, ignore_errors=True)
            elif (partial / MANIFEST).is_file():
                if _read_artifact(partial) is not None:
                    self._publish(partial)
                else:
                    shutil.rmtree(partial, ignore_errors=True)

    def remove_stale(self, keep: Iterable[tuple[str, str]]) -> tuple[int, int]:
        """Remove artifacts and unfinished work that are no longer needed.

        Args:
            keep: Stage name and key of what is wanted.

        Returns:
            How many folders were removed, and how many bytes that freed.
        """
        names = {_folder_name(stage, key) for stage, key in keep}
        folders = [
            path
            for path in [*self.stages.glob("*-*"), *self.partials.glob("*-*")]
            if path.is_dir() and not path.is_symlink()
        ]
        stale = [folder for folder in folders if folder.name not in names]
        freed = sum(file.stat().st_size for folder in stale for file in folder.rglob("*") if file.is_file())
        for folder in stale:
            shutil.rmtree(folder)
        return len(stale), freed

    def deliver(self, artifact: Artifact, stage: Stage) -> None:
        """Copy an artifact's deliverables into OUT, each replaced atomically; unchanged ones are left alone.

        Unmodified copies of an earlier artifact's deliverables that this one does not have are removed.

        Raises:
            UsageError: if a folder of theirs in OUT is a link.
        """
        wanted = artifact.deliverables(stage)
        for name, file in wanted.items():
            if not is_copy(file, self.out / name) or not is_inside(self.out, name):
                folder = own_folder(self.out, name.parent)
                remove_unfinished(folder, name.name)  # left by a killed run: only the lock's holder delivers
                copy_durably(file, self.out / name)
        for earlier in self.artifacts(stage.name):
            for name, file in earlier.deliverables(stage).items():
                if name not in wanted and is_copy(file, self.out / name) and is_inside(self.out, name):
                    (self.out / name).unlink()


def is_copy(source: Path, target: Path) -> bool:
    """Whether ``target`` is a copy made by ``deliver`` that nobody has changed since.

    It may be larger than its source: code that adds something to a delivered file keeps the file's mtime.
    """
    try:
        before, now = source.stat(), target.lstat()
    except FileNotFoundError:
        return False
    same = now.st_mtime_ns == before.st_mtime_ns and now.st_size >= before.st_size
    return same and S_ISREG(now.st_mode)


def _folder_name(stage: str, key: str) -> str:
    return f"{stage}-{key[:KEY_CHARACTERS]}"


def _read_artifact(folder: Path) -> Artifact | None:
    """The artifact in a folder; None unless it has all that its manifest lists, as files of its own."""
    try:
        manifest = read_json(folder / MANIFEST)
        if manifest["format"] != FORMAT or not _is_complete(manifest):
            return None
        folders = {""}
        for part in manifest["parts"].values():
            folders |= _folders_of(os.fspath(folder), part["path"], part["files"])
        if any(os.path.islink(f"{folder}/{name}".rstrip("/")) for name in folders):  # noqa: PTH114 (there are many)
            return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return Artifact(folder, manifest)


def _is_complete(manifest: Mapping[str, JSON]) -> bool:
    """Whether a manifest has what we read of it; somebody else's may not.

    Raises:
        KeyError, TypeError, AttributeError: if it lacks something.
    """
    inputs = manifest["inputs"]
    texts = [manifest["stage"], manifest["key"], *(part["digest"] for part in manifest["parts"].values())]
    tables = [manifest["summary"], inputs["config"], inputs["borrowed"], inputs["reads"]]
    texts += inputs["reads"].values()
    numbers = [manifest["finished_s"], inputs["version"]]
    kinds = ((str, texts), (dict, tables), (int | float, numbers))
    return all(isinstance(value, kind) for kind, values in kinds for value in values)


def _folders_of(folder: str, part: str, files: Iterable[Mapping[str, JSON]]) -> set[str]:
    """Check the files of a part, and return the folders that they lie in, relative to the artifact's folder.

    Raises:
        OSError: if a file is missing.
        ValueError: if the part or a file lies elsewhere, is not a regular file, or has another size than recorded.
        TypeError, AttributeError: if an entry is not one of a manifest.
    """
    found = {part}
    for each in files:
        entry = FileEntry(**each)
        if entry.path != part:
            if not entry.path.startswith(f"{part}/"):
                raise ValueError(entry.path)
            found.add(entry.path.rpartition("/")[0])
        status = os.lstat(f"{folder}/{entry.path}")
        if status.st_size != entry.size or not S_ISREG(status.st_mode):
            raise ValueError(entry.path)
    for name in sorted(found):
        if name.startswith("/") or ".." in name.split("/"):
            raise ValueError(name)
        while (name := name.rpartition("/")[0]) not in found:
            found.add(name)
    return found


def _drop_strays(folder: Path, keep: set[str]) -> None:
    for path in sorted(folder.rglob("*"), reverse=True):
        if path.is_dir() and not path.is_symlink():
            if not any(path.iterdir()):
                path.rmdir()
        elif path.relative_to(folder).as_posix() not in keep:
            path.unlink()


def open_store(out: Path, *, create: bool) -> Store:
    """Check an OUT, create its folders if asked, and return its store.

    Args:
        out: The run's folder.
        create: Create it if it is missing; otherwise a missing one is an error.

    Raises:
        UsageError: if it is a file, is not a run's folder, was made by a version with a different layout, or has links
            or the like among the command's own files.
        MachineError: if it cannot be written.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out} is a file.", hint="Name a folder for the results; it is created if missing.")
    above = next((parent for parent in out.parents if parent.exists() and not parent.is_dir()), None)
    if above is not None:
        raise UsageError(
            f"{above} is a file.", hint=f"{out} cannot be inside it; choose another folder for the results."
        )
    if not create and not (out / "stages").is_dir():
        raise UsageError(f"{out} does not contain a run.", hint=f"Begin with: splatpipe run PHOTOS {out}")
    _check_format(out)
    store = Store(out)
    if create and not store.stages.exists():
        foreign = [
            name for name in ("splat.ply", "config.toml", "metrics.json", "cameras.json") if (out / name).exists()
        ]
        if foreign:
            raise UsageError(
                f"{out} contains files that are not a run's ({', '.join(foreign)}).",
                hint="Choose an empty or a new folder.",
            )
    if not create:
        return store
    try:
        _require_own(store)
        for folder in (store.partials, store.shards):
            own_folder(out, folder.relative_to(out))
        with tempfile.TemporaryFile(dir=store.partials) as probe:
            probe.write(canonical(FORMAT))
        format_file = store.stages / "format.json"
        if not format_file.exists():
            write_durably(format_file, json.dumps({"format": FORMAT}))
    except OSError as error:
        raise write_error(out, error) from error
    return store


def _require_own(store: Store) -> None:
    """Check that no link or the like lies where a run writes; files of artifacts are checked where they are read.

    Raises:
        UsageError: naming what is not a file or a folder, or nested too deeply.
    """
    require_own_files([store.stages])
    if store.stages.exists():
        require_own_files(store.stages.iterdir())
        for folder in (store.partials, store.shards):
            try:
                require_own_files(folder.rglob("*"))
            except RecursionError as error:
                raise UsageError(
                    f"{folder} has folders a thousand deep.", hint="Remove it: no run made that."
                ) from error


def write_error(out: Path, error: OSError) -> MachineError:
    """The error for an OUT that cannot be written: full, read-only, another user's, or gone."""
    return MachineError(
        f"Cannot write to {out}: {error.strerror or error}.",
        hint="Check its permissions and the free space, or choose another OUT.",
    )


def _check_format(out: Path) -> None:
    try:
        found = read_json(out / "stages" / "format.json")["format"]
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            f"{out / 'stages' / 'format.json'} is damaged.",
            hint="If this version made it, delete that file and run again: intact results are reused.",
        ) from error
    if found != FORMAT:
        raise UsageError(
            f"{out} was made by a version of splatpipe with a different layout ({found}; this one has {FORMAT}).",
            hint="Choose another OUT, or use the version that made it. Nothing in it was changed.",
        )
