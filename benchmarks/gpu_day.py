"""Prove and measure everything on an NVIDIA GPU in two calls of under ten minutes on a bare machine; see docs/cuda.md.

Where the line runs:     ``gpu_day.py prepare --data ../shared/data``    packs captures and wheels into .gpu_day
Where the GPU is:        ``gpu_day.py prove --out FOLDER``               builds, tests, agreement, sanitizer, trainings
                         ``gpu_day.py measure --out FOLDER``             speed, memory, peers

The machine with the GPU needs torch, nvcc, CMake, ninja and nanobind, but no network. The work is split into parts:
failures are reported, and the remaining parts still run. All figures go to FOLDER/prove.json and FOLDER/measure.json; a
table is printed at the end.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

from gpu_parts import GpuPart, PartOutcome, Row, run_parts

ROOT = Path(__file__).resolve().parents[1]
NATIVE = ROOT / "pipeline" / "raster" / "native"
ROOM = ROOT / "pipeline" / "raster"
SCRATCH = Path(tempfile.gettempdir()) / "splatpipe-gpu-day"
SECONDS = 540.0  # of the 600 of a call: startup, transfers and the table take the rest
SEEDS = (0, 1, 2)
TRAININGS = ("sceaux", "ochota")
TOOLS = ("memcheck", "racecheck", "synccheck")
COUNTS = (100_000, 1_000_000, 5_000_000)


LINES = ("demo-standard", "ochota-standard")  # with `high` the pack is too large to transfer


def proofs(iterations: int) -> list[GpuPart]:
    """Return the correctness checks; trainings on the CPU run alongside, two threads each."""
    trainings = [{"capture": name, "seed": seed, "iterations": iterations} for name in TRAININGS for seed in SEEDS]
    return [
        *(
            GpuPart(
                f"train {job['capture']} {job['seed']} on the CPU",
                "gpu_proofs:training",
                job | {"on": "cpu"},
                900,
                True,
            )
            for job in trainings
        ),
        GpuPart("tests marked cuda", "gpu_proofs:marked_tests", {}, 150),
        GpuPart("agreement with the CPU", "gpu_proofs:agreement", {}, 90),
        GpuPart("the same bits twice", "gpu_proofs:same_bits_twice", {}, 60),
        *(
            GpuPart(f"train {job['capture']} {job['seed']} on cuda", "gpu_proofs:training", job | {"on": "cuda"}, 120)
            for job in trainings
        ),
        *(GpuPart(f"compute-sanitizer {tool}", "gpu_proofs:sanitized", {"tool": tool}, 75) for tool in TOOLS),
    ]


def measures() -> list[GpuPart]:
    """Return the measurements of speed and memory, the most informative first; the peer is compiled alongside."""
    return [
        GpuPart("peers compiled", "gpu_peers:compiled", {}, 400, beside=True),
        GpuPart("the card", "gpu_speed:card", {}, 30),
        *(GpuPart(f"{count:,} Gaussians", "gpu_speed:speed", {"count": count}, 60) for count in COUNTS),
        GpuPart("10 M Gaussians, memory", "gpu_speed:memory", {"count": 10_000_000}, 60),
        GpuPart("more than 2^31 pairs", "gpu_speed:many_pairs", {}, 60),
        GpuPart("30,000 iterations", "gpu_speed:whole_training", {}, 200),
        *(GpuPart(f"gsplat, {count:,} Gaussians", "gpu_peers:speed", {"count": count}, 60) for count in COUNTS),
        *(
            GpuPart(f"{name}, as the line trains", "gpu_speed:line", {"capture": name}, 120)
            for name in ("demo-standard", "ochota-standard", "demo-high", "ochota-high")  # those that were packed
        ),
    ]


def environment(pack: Path) -> dict[str, str]:
    """Return the parts' environment: splatpipe by links to its sources, the carried wheels, the compiled peers."""
    links = SCRATCH / "links"
    (links / "splatpipe").mkdir(parents=True, exist_ok=True)
    for room in ("pipeline", "stages", "configs", "demo"):
        link = links / "splatpipe" / room
        link.unlink(missing_ok=True)
        link.symlink_to(ROOT / room)
    site = SCRATCH / "site"
    wheels = sorted((pack / "wheels").glob("*.whl"))
    if wheels and sys.version_info[:2] == (3, 12) and not site.exists():
        words = ["install", "-q", "--no-index", "--no-deps", "--no-compile", "--no-cache-dir", "--target", str(site)]
        subprocess.run([sys.executable, "-m", "pip", *words, *map(str, wheels)], check=False)
    paths = [str(links), str(SCRATCH / "peers"), str(Path(__file__).parent), *([str(site)] if site.exists() else [])]
    mine = {
        "PYTHONPATH": os.pathsep.join([*paths, *filter(None, [os.environ.get("PYTHONPATH")])]),
        "SPLATPIPE_PACK": str(pack.resolve()),
        "TORCH_EXTENSIONS_DIR": str(SCRATCH / "extensions"),
        "CUBLAS_WORKSPACE_CONFIG": ":4096:8",
    }
    return {**os.environ, **mine}


def build() -> PartOutcome:
    """Build both libraries beside their Python modules: the CPU's, and CUDA's for the device present."""
    began, said = time.monotonic(), []
    folder = SCRATCH / "build"
    ask = [sys.executable, "-m", "nanobind", "--cmake_dir"]
    cmake_dir = subprocess.run(ask, capture_output=True, text=True, check=False)
    configure = ["cmake", "-S", str(NATIVE), "-B", str(folder), "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release"]
    configure += [f"-DCMAKE_PREFIX_PATH={cmake_dir.stdout.strip()}", f"-DPython_EXECUTABLE={sys.executable}"]
    targets = [["_native"], ["splat_cuda"]]
    for words in [configure, *(["cmake", "--build", str(folder), "--target", *target] for target in targets)]:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode:
            said.append((done.stdout + done.stderr)[-2000:])
    made = [*folder.glob("_native*.so"), *folder.glob("cuda/libsplat_cuda.so")]
    for library in made:
        target = ROOM / library.name
        target.unlink(missing_ok=True)  # not overwritten: a running program may have it mapped
        shutil.copy2(library, target)
    text = (folder / "cuda.txt").read_text().strip() if (folder / "cuda.txt").exists() else "cmake failed"
    rows: list[Row] = [{"built": text, "libraries": [path.name for path in made]}]
    state = "done" if len(made) == len(targets) else "failed"
    return PartOutcome("build", state, round(time.monotonic() - began, 1), rows, "\n".join(said))


def machine() -> Row:
    """Describe the machine that the figures were measured on."""
    ask = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.sm,clocks.mem", "--format=csv,noheader"]
    output = subprocess.run(ask, capture_output=True, text=True, check=False).stdout if shutil.which(ask[0]) else ""
    commit = ""
    if shutil.which("git"):
        ask = ["git", "rev-parse", "HEAD"]
        commit = subprocess.run(ask, capture_output=True, text=True, check=False, cwd=ROOT).stdout.strip()
    return {
        "gpu": output.strip() or "none",
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "commit": commit or "unknown",
    }


def day(name: str, parts: list[GpuPart], out: Path, pack: Path, seconds: float) -> None:
    """Build, run the parts, write the JSON after each of them, print the table at the end."""
    deadline = time.monotonic() + seconds
    out.mkdir(parents=True, exist_ok=True)
    facts, built = machine(), build()
    print(f"-- build: {built.state}, {built.seconds:.0f} s: {built.rows[0]['built']}", flush=True)

    def write(outcomes: list[PartOutcome]) -> None:
        parts = [asdict(one) for one in [built, *outcomes]]
        record = {"benchmark": f"gpu_day {name}", "machine": facts, "parts": parts}
        (out / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")

    outcomes: list[PartOutcome] = []
    write(outcomes)
    for outcomes in run_parts(parts, SCRATCH / name, environment(pack), deadline):
        write(outcomes)
    print(f"\n{name} on {facts['gpu']}")
    for outcome in [built, *outcomes]:
        print(f"{outcome.state:>9} {outcome.seconds:7.1f} s  {outcome.name}")


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("what", choices=("prepare", "prove", "measure"))
    options.add_argument("--pack", type=Path, default=Path(".gpu_day"), help="what is carried (default: .gpu_day)")
    options.add_argument("--out", type=Path, default=Path("out/gpu_day"), help="where the JSON goes")
    options.add_argument("--data", type=Path, default=Path("../shared/data"), help="prepare: the real captures")
    options.add_argument(
        "--lines", nargs="*", default=["demo-standard", "ochota-standard"], help="prepare: runs to pack"
    )
    options.add_argument("--peers", type=Path, nargs="*", default=[], help="prepare: folders with sources of peers")
    options.add_argument("--iterations", type=int, default=1500, help="prove: of each training")
    options.add_argument("--only", nargs="*", help="prove, measure: parts whose name has one of these in it")
    options.add_argument("--seconds", type=float, default=SECONDS, help="prove, measure: for everything")
    arguments = options.parse_args()
    if arguments.what == "prepare":
        import gpu_prepare

        gpu_prepare.main(arguments.data, arguments.pack, arguments.lines, arguments.peers)
        return
    parts = proofs(arguments.iterations) if arguments.what == "prove" else measures()
    if arguments.only:
        parts = [part for part in parts if any(text in part.name for text in arguments.only)]
    day(arguments.what, parts, arguments.out, arguments.pack, arguments.seconds)


if __name__ == "__main__":
    main()
