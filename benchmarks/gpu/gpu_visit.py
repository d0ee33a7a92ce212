"""Prove and measure everything on an NVIDIA GPU within a quarter of an hour on a bare machine; see docs/gpu_visit.md.

Where the line runs:   ``make gpu-visit``                             packs everything, and prints the commands
Where the GPU is:      ``gpu_visit first --out FOLDER``            420 s: proofs, speed, peers, trainings
                       ``gpu_visit second --out FOLDER``           200 s: what was red again, then the limits

The machine with the GPU needs torch, nvcc, CMake, ninja and nanobind, but no network. All figures go to
FOLDER/first.jsonl and FOLDER/second.jsonl, one line a row, written at once; the log lies beside. ``gpu_report``
makes tables of them.
"""

from __future__ import annotations

import argparse
import datetime
import importlib
import json
import os
import platform
import shutil
import sys
import tempfile
import time
import traceback
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import gpu_libraries
from gpu_parts import QUIET, GpuPart, PartOutcome, Row, VisitFile, read_lines, run_parts

ROOT = Path(__file__).resolve().parents[2]
SCRATCH = Path(tempfile.gettempdir()) / "splatpipe-gpu-visit"
# Time for the parts of a call of 420 and of 200 s: the last part's end and the table take the rest.
FIRST_S, SECOND_S = 414.0, 194.0
IMPORTED = (
    "gpu_proofs",
    "gpu_speed",
    "gpu_features",
    "gpu_sanitized",
    "gpu_peers",
)  # once, before the parts are forked
SEEDS = (0, 1, 2)
TIMED_PEERS = ("gsplat", "faster-gs")
SMALL_SMOKE = {"count": 3000, "size": [161, 117]}  # under memcheck, which slows kernels down a hundredfold
BUILT_PEERS = (*TIMED_PEERS, "fused-ssim")
RED = ("failed", "late", "not begun")
ROOMS = ("pipeline", "stages", "configs")
UNUSED = shutil.ignore_patterns("node_modules", "src", "dist", "__pycache__", "*.so")


@dataclass(frozen=True)
class VisitScale:
    """How large everything is.

    Attributes:
        middle, few, many: Gaussians of the measurements.
        most: Gaussians of the measurement of memory.
        megapixels: Of the photos.
        agreed: Megapixels of the views compared with the CPU's.
        repeats: Measured iterations.
        iterations: Of the trainings compared with the CPU's; ``make gpu-visit`` runs them with as many.
        twice: Of the two trainings with one seed.
        long: Of the long training, and how many there are between rows.
        pairs: Gaussians that each cover an image, and its size, for more pairs than 31 bits count.
        pytest: Options of the tests on the device.
        smoke: Arguments of the smoke part.
        kernels: Arguments of the sanitizers' part.
    """

    middle: int = 1_000_000
    few: int = 100_000
    many: int = 5_000_000
    most: int = 10_000_000
    megapixels: float = 1.6
    agreed: float = 0.4
    repeats: int = 100
    iterations: int = 1500
    twice: int = 200
    long: tuple[int, int] = (30_000, 1000)
    pairs: tuple[int, tuple[int, int]] = (70_000, (3840, 2160))
    pytest: tuple[str, ...] = ()
    smoke: Row | None = None
    kernels: Row | None = None


TOY = VisitScale(
    *(150, 100, 200, 250, 0.001, 0.002, 1, 20, 10, (4, 2), (60, (48, 32)), ("--collect-only", "-q")),
    smoke={"count": 300, "size": [51, 37]},
    kernels={"count": 100, "size": [35, 21]},
)
"""To try the parts without a GPU, on the tests' harness."""


def first_call(scale: VisitScale, peers: Sequence[str]) -> list[GpuPart]:
    """Return the first call's parts, the most telling first; limits add up to less than ``FIRST_S``."""
    plain = {"megapixels": scale.megapixels, "repeats": scale.repeats}

    def speed(name: str, limit_s: float, **arguments: object) -> GpuPart:
        return GpuPart(name, "gpu_speed:speed", plain | arguments, limit_s)

    return [
        *compilations(peers),
        GpuPart("the card", "gpu_speed:card", {}, 3),
        smoke(scale),
        GpuPart("tests marked cuda", "gpu_proofs:marked_tests", {"options": scale.pytest}, 56),
        GpuPart("agreement with the CPU", "gpu_proofs:agreement", {"megapixels": scale.agreed}, 26),
        GpuPart("the same bits twice", "gpu_proofs:same_bits_twice", {"iterations": scale.twice}, 16),
        sanitizer("memcheck", 15, scale),
        sanitizer("racecheck", 15, scale),
        GpuPart("compilers ended", QUIET, {}, 2),
        GpuPart("features", "gpu_features:agreement", scale.smoke or {}, 8),
        speed("middle, made", 18, count=scale.middle),
        speed("few, made", 11, count=scale.few),
        speed("many, made", 18, count=scale.many),
        GpuPart("kernels, middle", "gpu_speed:kernels", {"count": scale.middle, "megapixels": scale.megapixels}, 11),
        speed("few, default preset", 11, count=scale.few, preset=True),
        speed("middle, default preset", 12, count=scale.middle, preset=True),
        speed("trained scene", 10, count=None),
        GpuPart(
            "features, middle",
            "gpu_features:speed",
            {"count": scale.middle, "megapixels": scale.megapixels, "repeats": (scale.repeats + 1) // 2},
            8,
        ),
        *(
            GpuPart(f"{peer}, {name}", "gpu_peers:speed", plain | {"peer": peer, "count": count}, limit_s, ours=False)
            for name, count, limit_s in (
                ("trained scene", None, 10),
                ("middle, made", scale.middle, 11),
                ("many, made", scale.many, 13),
            )
            for peer in TIMED_PEERS
            if peer in peers
        ),
        *(
            GpuPart(f"training, seed {seed}", "gpu_proofs:training", {"seed": seed, "iterations": scale.iterations}, 31)
            for seed in SEEDS
        ),
    ]


def second_call(scale: VisitScale, peers: Sequence[str], first: Sequence[Row]) -> list[GpuPart]:
    """Return the second call's parts: what was red in the first, if anything was, then the limits."""
    states = {line["part"]: line["state"] for line in first if "state" in line and "part" in line}
    before = [part for part in first_call(scale, peers) if part.ours and part.entry != QUIET]
    red = [part for part in before if states.get(part.name, "not begun") in RED]
    shown_again = [smoke(scale), *(part for part in red if part.on_failure is None)] if red else []
    count, size = scale.pairs
    iterations, every = scale.long
    plain = {"count": scale.middle, "megapixels": scale.megapixels}
    return [
        *shown_again,
        GpuPart("most, memory", "gpu_speed:memory", {"count": scale.most, "megapixels": scale.megapixels}, 25),
        GpuPart("more than 2^31 pairs", "gpu_speed:many_pairs", {"count": count, "size": size}, 22),
        sanitizer("synccheck", 20, scale),
        sanitizer("initcheck", 20, scale),
        GpuPart("long training", "gpu_speed:long_training", plain | {"iterations": iterations, "every": every}, 105),
    ]


def smoke(scale: VisitScale) -> GpuPart:
    """Return the part that decides whether anything else makes sense."""
    arguments = scale.smoke or {}
    again = GpuPart(
        "smoke under memcheck",
        "gpu_sanitized:sanitized",
        {"tool": "memcheck", "entry": "gpu_proofs:smoke", **SMALL_SMOKE, **arguments},
        9,
    )
    return GpuPart("smoke", "gpu_proofs:smoke", arguments, 11, on_failure=again)


def sanitizer(tool: str, limit_s: float, scale: VisitScale) -> GpuPart:
    """Return the part that runs every kernel under one of compute-sanitizer's tools."""
    return GpuPart(tool, "gpu_sanitized:sanitized", {"tool": tool} | (scale.kernels or {}), limit_s)


def compilations(peers: Sequence[str]) -> list[GpuPart]:
    """Return the peers' compilations, alongside the proofs; until the host has to be quiet."""
    return [
        GpuPart(f"{peer} compiled", "gpu_peers:compiled", {"peer": peer}, 150, beside=True, ours=False)
        for peer in BUILT_PEERS
        if peer in peers
    ]


def carried_peers(pack: Path) -> list[str]:
    """Return the peers that were carried."""
    return [peer for peer in BUILT_PEERS if (pack / "peers" / peer).is_dir()]


def unpack(pack: Path) -> Row:
    """Make splatpipe, the carried packages and the libraries importable, here and in the parts' processes.

    Returns:
        Where the libraries came from.

    Raises:
        SystemExit: if a library can neither be loaded nor compiled.
    """
    packages, site = SCRATCH / "packages", SCRATCH / "site"
    for folder in (packages, site):
        shutil.rmtree(folder, ignore_errors=True)
    for room in ROOMS:
        shutil.copytree(ROOT / room, packages / "splatpipe" / room, ignore=UNUSED)
    shutil.copy2(ROOT / "pipeline/door/__init__.py", packages / "splatpipe")
    for wheel in sorted((pack / "wheels").glob("*.whl")):
        with zipfile.ZipFile(wheel) as archive:
            archive.extractall(site)
    paths = [str(packages), str(Path(__file__).parent), str(site)]
    sys.path[:0] = paths
    os.environ["PYTHONPATH"] = os.pathsep.join([*paths, *filter(None, [os.environ.get("PYTHONPATH")])])
    os.environ["SPLATPIPE_PACK"] = str(pack.resolve())
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    os.environ.setdefault("TORCH_CUDA_ARCH_LIST", "9.0")
    # Processes that compile a peer's extension.
    os.environ.setdefault("MAX_JOBS", str(max(1, (os.cpu_count() or 1) // 3)))
    importlib.invalidate_caches()
    return gpu_libraries.place(pack / "libraries", packages, SCRATCH)


def import_for_parts() -> None:
    """Import what the parts need; if that fails, theirs fail, too, and say so."""
    for name in IMPORTED:
        try:
            importlib.import_module(name)
        except Exception:
            traceback.print_exc()


def machine() -> Row:
    """Describe the machine that the figures are measured on, besides its card."""
    return {
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def visit(call: str, parts: Sequence[GpuPart], out: Path, pack: Path, seconds: float) -> list[PartOutcome]:
    """Unpack, run the parts, and write the file.

    Args:
        call: ``first`` or ``second``, the file's name.
        parts: What to run.
        out: Folder of the file.
        pack: What was carried.
        seconds: For everything.

    Returns:
        The parts' outcomes.
    """
    began = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    file = VisitFile(out / f"{call}.jsonl")
    for path in out.glob(f"{call}.*"):
        path.unlink()
    carried = json.loads((pack / "pack.json").read_text()) if (pack / "pack.json").exists() else {}
    now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    plan = [{"part": part.name, "limit_s": part.limit_s} | ({"beside": True} if part.beside else {}) for part in parts]
    file.write({"call": call, "began": now, "machine": machine(), "carried": carried, "plan": plan})
    try:
        file.write({"part": "unpacked", "row": unpack(pack)})
        file.ended(PartOutcome("unpacked", "done", time.monotonic() - began))
        outcomes = run_parts(parts, file, began + seconds, import_for_parts)
    except (Exception, SystemExit) as error:
        traceback.print_exc()
        outcomes = [PartOutcome("unpacked", "failed", time.monotonic() - began, str(error))]
        file.ended(outcomes[0])
    ours = {part.name for part in parts if part.ours} | {"unpacked"}
    red = [outcome.name for outcome in outcomes if outcome.name in ours and outcome.state in RED]
    file.write({"end": "red" if red else "green", "red": red, "seconds": round(time.monotonic() - began, 1)})
    print(f"\n{call} call: {'red: ' + ', '.join(red) if red else 'green'}, {time.monotonic() - began:.0f} s")
    for outcome in outcomes:
        print(f"{outcome.state:>9} {outcome.seconds:7.1f} s  {outcome.name}")
    return outcomes


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("what", choices=("prepare", "first", "second"))
    options.add_argument("--pack", type=Path, default=Path(".gpu_visit"), help="what is carried (default: .gpu_visit)")
    options.add_argument("--out", type=Path, default=Path("out/gpu_visit"), help="where the file goes")
    options.add_argument("--data", type=Path, default=Path("../shared/data"), help="prepare: the real captures")
    options.add_argument("--peers", type=Path, help="prepare: folder with the peers' sources")
    options.add_argument("--first", type=Path, help="prepare: the first call's file, for the second")
    options.add_argument("--only", nargs="*", help="first, second: parts whose name has one of these in it")
    options.add_argument("--toy", action="store_true", help="first, second: at toy size, for the harness")
    arguments = options.parse_args()
    if arguments.what == "prepare":
        os.environ["SPLATPIPE_PACK"] = str(arguments.pack.resolve())
        import gpu_prepare

        gpu_prepare.main(arguments.data, arguments.pack, arguments.peers, arguments.first)
        return
    parts = listed(arguments.what, TOY if arguments.toy else VisitScale(), arguments.pack)
    if arguments.only:
        parts = [part for part in parts if any(text in part.name for text in arguments.only)]
    visit(arguments.what, parts, arguments.out, arguments.pack, FIRST_S if arguments.what == "first" else SECOND_S)


def listed(call: str, scale: VisitScale, pack: Path) -> list[GpuPart]:
    """Return a call's parts.

    Raises:
        SystemExit: if it is the second, and the first one's file was not carried.
    """
    if call == "first":
        return first_call(scale, carried_peers(pack))
    if not (pack / "first.jsonl").exists():
        raise SystemExit("the second call wants the first one's file: `make gpu-visit FIRST=FILE` packs it")
    return second_call(scale, carried_peers(pack), read_lines(pack / "first.jsonl"))


if __name__ == "__main__":
    main()
