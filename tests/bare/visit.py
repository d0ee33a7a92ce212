"""Run a call of a visit to a GPU at toy size, with stand-ins for some of its parts.

The arguments: the call, the pack, the folder of its file, and as JSON an object with ``parts``: the stand-in by the
beginning of a part's name, ``limits``: seconds by the same, and ``seconds``: for everything. With stand-ins for all
parts, ``light`` spares the imports of the others.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "gpu"))
import gpu_visit
from gpu_parts import QUIET, GpuPart


def main(call: str, pack: str, out: str, changes: str) -> None:
    given = json.loads(changes)

    def changed(part: GpuPart) -> GpuPart:
        for begin, function in given.get("parts", {}).items():
            if part.name.startswith(begin):
                part = replace(part, entry=QUIET if function == QUIET else f"standins:{function}")
        for begin, limit_s in given.get("limits", {}).items():
            if part.name.startswith(begin):
                part = replace(part, limit_s=limit_s)
        return part if part.on_failure is None else replace(part, on_failure=changed(part.on_failure))

    if given.get("light"):
        gpu_visit.IMPORTED = ()
    parts = [changed(part) for part in gpu_visit.listed(call, gpu_visit.TOY, Path(pack))]
    gpu_visit.visit(call, parts, Path(out), Path(pack), given.get("seconds", 300.0))


if __name__ == "__main__":
    main(*sys.argv[1:])
