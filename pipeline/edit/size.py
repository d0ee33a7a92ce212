"""Reductions: to so many Gaussians, or to so many bytes of the file that is written."""

from __future__ import annotations

import math
import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from splatpipe.pipeline.edit.workpiece import Workpiece
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.splat.formats import SplatFormat
from splatpipe.pipeline.splat.formats.files import write_scene
from splatpipe.pipeline.splat.gaussians import Gaussians
from splatpipe.pipeline.splat.reduction import Reduction, reduce_further, reduce_to
from splatpipe.pipeline.splat.scene import Scene

MOST = 10**10  # Gaussians: more than any machine holds
UNITS = {"KB": 10**3, "MB": 10**6, "GB": 10**9}
SAMPLE = 50_000  # Gaussians whose file tells what one takes, about
ROUNDS = 5  # of writing it and looking: what one takes depends on how many there are
FULL = 0.93  # share of the bytes from which on it is full enough
MARGIN = 0.985  # of what would just fit, for the next round
FORM = "500000, 100MB or 1.5GB"

_COUNT = re.compile(r"[0-9]{1,11}", re.ASCII)
_BYTES = re.compile(r"([0-9]{1,9}(?:\.[0-9]{1,6})?) ?([KMG]B)", re.ASCII | re.IGNORECASE)


@dataclass(frozen=True)
class OutputFile:
    """What is going to be written.

    Attributes:
        path: Where.
        kind: In which format.
    """

    path: Path
    kind: SplatFormat


@dataclass(frozen=True)
class Reduce:
    """Neighbours are merged until the splat is small enough; one that is stays as it is.

    Attributes:
        output: Whose bytes count.
        count: Gaussians; 0 where bytes are asked for.
        size_bytes: Of the output; 0 where Gaussians are asked for.
    """

    output: OutputFile
    count: int = 0
    size_bytes: int = 0

    @staticmethod
    def parse(text: str, option: str, output: OutputFile) -> Reduce:
        """A number of Gaussians, or bytes with their unit.

        Raises:
            UsageError: if it is anything else, or nothing.
        """
        text = text.strip()
        if _COUNT.fullmatch(text) and 0 < int(text) <= MOST:
            return Reduce(output, count=int(text))
        match = _BYTES.fullmatch(text)
        size = int(float(match[1]) * UNITS[match[2].upper()]) if match else 0
        if size <= 0:
            raise UsageError(f'Cannot understand {option} "{text[:60]}".', hint=f"Write it as {option} {FORM}.")
        return Reduce(output, size_bytes=size)

    def apply(self, piece: Workpiece) -> dict[str, Any]:
        """Reduce; what is recorded of it.

        Raises:
            SplatpipeError: if not even one Gaussian is so small a file.
            MachineError: if the file cannot be tried.
        """
        if self.count:
            if len(piece) > self.count:
                piece.take(reduce_further(Reduction.none_yet(piece.settled()), self.count).gaussians)
            return {"step": "reduce", "to": self.count}
        piece.take(self._fitting(piece.scene()))
        return {"step": "reduce", "bytes": self.size_bytes, "format": self.output.kind.name}

    def _fitting(self, scene: Scene) -> Gaussians:
        """As many as fit, found by writing them."""
        whole = scene.gaussians
        sample = whole.select(torch.arange(0, len(whole), max(1, -(-len(whole) // SAMPLE))))
        each = self._bytes(replace(scene, gaussians=sample)) / max(1, len(sample))
        count, too_many = min(len(whole), max(1, int(self.size_bytes / each))), len(whole) + 1
        best = 0  # the most that are known to fit: they are merged anew rather than kept beside the next
        for _ in range(ROUNDS):
            tried = reduce_to(whole, count)
            size = self._bytes(replace(scene, gaussians=tried))
            if size <= self.size_bytes:
                best = count
                if count >= len(whole) or size >= FULL * self.size_bytes:
                    return tried
            else:
                too_many = count
            del tried
            wanted = math.floor(MARGIN * count * self.size_bytes / size)
            wanted = max(1, min(wanted, too_many - 1, len(whole)))
            if best and wanted <= best:
                break
            count = wanted
        if not best:
            raise SplatpipeError(
                f"{self.size_bytes / 1e6:g} MB is too small for a {self.output.kind.name} of this splat.",
                hint="Ask for more, or choose a format that compresses better.",
            )
        return reduce_to(whole, best)

    def _bytes(self, scene: Scene) -> int:
        """What it takes when it is written, beside where it is going to be: that has the room."""
        self.output.path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".splatpipe-", dir=self.output.path.parent) as folder:
            path = Path(folder) / self.output.path.name
            write_scene(path, scene, self.output.kind)
            files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
            return sum(file.stat().st_size for file in files)
