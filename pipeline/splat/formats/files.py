"""Splat files of any format: recognised by content for reading, and by name for writing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError, SplatpipeError, UsageError
from splatpipe.pipeline.engine.files.durable import beside
from splatpipe.pipeline.engine.files.output_file import require_replaceable
from splatpipe.pipeline.engine.files.small_file import open_regular
from splatpipe.pipeline.splat.containers.bounded import CheckValues, check_values
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS, SplatFormat, format_named
from splatpipe.pipeline.splat.model.position_cost import PositionCost, two_digits
from splatpipe.pipeline.splat.model.scene import Scene

_ROWS_AT_ONCE = 1 << 16
_MAX_HEADER_BYTES = 65_536  # bytes of a PLY read for its header, which says whether it is compressed
_MAGIC = ((b"\x1f\x8b", "spz"), (b"NGSP", "spz"), (b"PK", "sog"), (b"glTF", "glb"))
_OTHERS = (".splat", ".ksplat", ".rad", ".lcc", ".ckpt", ".pth", ".pt")
_OTHERS_HINT = "Save it as PLY: with SuperSplat or splat-transform; of a trainer's checkpoint, with the trainer."
_HINT = "Give a splat as PLY, compressed PLY, SPZ, SOG or GLB, or the folder of a 3DGS model."


def read_scene(path: Path, check: CheckValues = check_values) -> Scene:
    """Read a splat of any format that can be read.

    Args:
        path: A file, or the folder of a 3DGS model.
        check: What to do about unusable values; ``keep_unusable`` returns them.

    Returns:
        The splat, in the file's axes, with unchanged quaternions.

    Raises:
        SplatpipeError: if it is missing, of an unknown format, or broken.
    """
    found = format_of_content(path)
    try:
        return found.read(path, check)
    except OSError as error:
        raise SplatpipeError(f"Cannot read {path}: {error.strerror or error}.", hint="Check the path.") from error
    except MemoryError as error:
        raise MachineError(f"{path} does not fit in memory.", hint="Use a machine with more memory.") from error


def format_of_content(path: Path) -> SplatFormat:
    """Detect the format of a file or folder.

    Raises:
        SplatpipeError: if it is missing, or of no readable format.
    """
    if path.is_dir():
        name = "model" if (path / "point_cloud").is_dir() else "sog" if (path / "meta.json").is_file() else ""
    else:
        name = _name_of_file(path)
    found = next((each for each in SPLAT_FORMATS if each.name == name and each.reads), None)
    if found is None and path.suffix.lower() in _OTHERS:
        raise SplatpipeError(f"{path}: {path.suffix} files are not read.", hint=_OTHERS_HINT)
    if found is None:
        raise SplatpipeError(f"{path} is not a readable splat.", hint=_HINT)
    return found


def _name_of_file(path: Path) -> str:
    try:
        with open_regular(path) as file:
            start = file.read(_MAX_HEADER_BYTES)
    except OSError as error:
        raise SplatpipeError(f"Cannot read {path}: {error.strerror}.", hint="Check the path.") from error
    if start.startswith(b"ply"):
        return "compressed-ply" if b"packed_position" in start.partition(b"end_header")[0] else "ply"
    if start.lstrip()[:1] == b"{" and path.suffix == ".json":
        return "sog"
    return next((name for magic, name in _MAGIC if start.startswith(magic)), "")


def format_of_name(path: Path, asked: str | None = None) -> SplatFormat:
    """The format in which to write a file.

    Args:
        path: Output path; the longest matching suffix counts, and a name without one is a folder.
        asked: Name of the format, if given explicitly.

    Raises:
        UsageError: if no format has this name or suffix.
    """
    if asked is not None:
        return format_named(asked)
    if not path.suffix:
        return format_named("model")
    fits = [each for each in SPLAT_FORMATS if each.ending and path.name.lower().endswith(each.ending)]
    if not fits:
        endings = ", ".join(dict.fromkeys(each.ending for each in SPLAT_FORMATS if each.ending))
        raise UsageError(
            f"No format has the extension {path.suffix}.", hint=f"Choose from {endings}, or name the format."
        )
    return max(fits, key=lambda each: len(each.ending))


def write_scene(path: Path, scene: Scene, kind: SplatFormat | None = None) -> PositionCost:
    """Write a splat in the axes that the format's readers expect, with unit quaternions unless the format is exact.

    Args:
        path: Output path, replaced atomically. A folder must be new or empty.
        scene: The scene; finite.
        kind: The format; None to choose it by suffix.

    Returns:
        What the file's positions have lost.

    Raises:
        UsageError: if the name has no known suffix, a folder is not empty, or the path is a device, pipe or socket.
        SplatpipeError: if the format cannot store the scene, or only so coarsely that it would be destroyed.
        MachineError: if it cannot be written.
    """
    kind = format_of_name(path) if kind is None else kind
    require_replaceable(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir() and (kind.ending or any(path.iterdir())):
            raise UsageError(f"{path} is an existing folder.", hint="Name a new file or folder.")
        with beside(path) as aside:
            cost = kind.write(aside, scene if kind.exact else in_unit_quats(scene))
            _refuse_position_loss(path, scene, cost)
            return cost
    except OSError as error:
        raise MachineError(f"Cannot write {path}: {error.strerror or error}.", hint="Check the free space.") from error


def _refuse_position_loss(path: Path, scene: Scene, cost: PositionCost) -> None:
    """Refuse a file that would not show the splat.

    Raises:
        SplatpipeError: if its positions have too coarse steps.
    """
    would = f"{path.name} would destroy the splat: its positions would have steps of {two_digits(cost.step)}, and"
    if cost.collapses(scene.gaussians):
        raise SplatpipeError(
            f"{would} it extends less along two axes.",
            hint="Its coordinates appear to be in another unit than its scales, such as degrees and metres: export it "
            "in projected coordinates.",
        )
    if cost.destroys:
        raise SplatpipeError(
            f"{would} half of its Gaussians are smaller than {two_digits(cost.size)}.",
            hint="Write a PLY or GLB, which keep positions, or remove what lies far away first: splatpipe edit IN OUT "
            "--crop-box X1,Y1,X2,Y2.",
        )


def in_unit_quats(scene: Scene) -> Scene:
    """The scene with unit quaternions, sharing other parameters; a zero quaternion becomes the identity."""
    quats = scene.gaussians.quats.detach().clone()
    for start in range(0, len(quats), _ROWS_AT_ONCE):
        rows = quats[start : start + _ROWS_AT_ONCE]
        length = rows.double().norm(dim=1, keepdim=True)
        rows.copy_(rows.double() / length.clamp(min=1e-30))
        rows[length[:, 0] == 0.0] = rows.new_tensor([1.0, 0.0, 0.0, 0.0])
    return replace(scene, gaussians=replace(scene.gaussians, quats=quats))
