"""Run `splatpipe batch` on seven small captures, four of them bad, and check the result; about ten minutes of CPU time.

    python benchmarks batch_trial ../shared/data /tmp/night

The captures are links to photos of the demo and of the folder of real captures, created in the second folder. One is
broken, one cannot be reconstructed, one has a wrong control file, and the training of one is killed with -9. The
command is then repeated at once, and once more with one capture added and one changed. Finally Snakemake reports what
it would submit to Slurm and Kubernetes, which requires its plugins: `pip install snakemake-executor-plugin-slurm
snakemake-executor-plugin-kubernetes snakemake-storage-plugin-fs`. The script exits with 1 at the first unexpected
result.
"""

import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from splatpipe.demo import capture_path

PROFILES = Path(__file__).resolve().parents[2] / "configs" / "batch"
SETS = (
    *("features.extractor=opencv-sift", "features.max_image_size=1000", "undistort.max_megapixels=0.03"),
    *("train.iterations=100", "split.every=4", "flythrough.seconds=0.2"),
    *("depths.max_megapixels=0.01", "dsm.cell_m=0.3", "ortho.gsd_m=0.3"),
)
KILLED_ITERATIONS = 600  # long enough to be caught during training
EXPECTED = {
    "orbit": "done",
    "surveyed": "done",
    "nadir": "done",
    "killed": "done",
    "broken": "failed",
    "scattered": "failed",
    "wrong control": "failed",
}
PLUGINS = {"slurm": "snakemake_executor_plugin_slurm", "kubernetes": "snakemake_executor_plugin_kubernetes"}


def main() -> None:
    """Create the captures, run the batch, repeat it, change it."""
    data, folder = Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve()
    if folder.exists():
        sys.exit(f"{folder} is there already; name a folder that is not.")
    captures = make_captures(data, folder / "captures")
    night = BatchTrial(folder / "captures.toml", folder / "out")
    night.write_list(captures)
    first(night)
    repeated(night)
    changed(night, captures | {"added": link(folder / "captures" / "added", demo()[:12])})
    for name, plugin in PLUGINS.items():
        dry_run(night, name, plugin)
    print("All as it should be.")


class BatchTrial:
    """A list of captures and the batch's folder."""

    def __init__(self, listed: Path, out: Path) -> None:
        self.listed, self.out = listed, out

    def write_list(self, captures: Mapping[str, Path], sets: Mapping[str, Iterable[str]] | None = None) -> None:
        """Write the list, with options for individual captures."""
        own = {"killed": [f"train.iterations={KILLED_ITERATIONS}"], **(sets or {})}
        text = f"preset = 'preview'\nset = {json.dumps(SETS)}\n"
        for name, photos in captures.items():
            text += f"\n[[capture]]\nname = {json.dumps(name)}\nphotos = {json.dumps(str(photos))}\n"
            text += f"set = {json.dumps(list(own.get(name, [])))}\n"
        self.listed.write_text(text, encoding="utf-8")

    def command(self, *more: str) -> list[str]:
        program = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main"]
        return [*program, "batch", str(self.listed), str(self.out), *more]

    def start(self) -> subprocess.Popen[str]:
        """Start the batch."""
        return subprocess.Popen(self.command("--json"), stdout=subprocess.PIPE, text=True)

    def result_of(self, process: subprocess.Popen[str]) -> dict[str, Any]:
        """Return the batch's final report, which must match the one in its folder."""
        printed, _ = process.communicate()
        summary: dict[str, Any] = json.loads(printed)
        filed = json.loads((self.out / "batch.json").read_text(encoding="utf-8"))
        check(filed["captures"] == summary["captures"], "batch.json says what the command says")
        check(
            process.returncode == summary["exit_code"] == filed["exit_code"],
            f"exit code {process.returncode} everywhere",
        )
        rows = (self.out / "batch.csv").read_text(encoding="utf-8")
        for capture in summary["captures"]:
            check(
                f"{capture['name']},{capture['state']}," in rows, f"batch.csv: {capture['name']} is {capture['state']}"
            )
            print(f"    {capture['name']}: {capture['state']} {capture['stage']} | {capture['verdict']} | "
                  f"{capture['reason'][:160]!r} | tries {capture['tries']} {list(capture['earlier'])}")  # fmt: skip
        return summary

    def events(self) -> dict[str, bytes]:
        """Return the event log of every capture: it shows which stages ran."""
        return {path.parent.name: path.read_bytes() for path in self.out.glob("*/events.jsonl")}


def first(night: BatchTrial) -> None:
    """Run the batch for the first time."""
    print("The night:")
    process = night.start()
    killed = kill_in_training(night.out / "killed", process)
    result = night.result_of(process)
    states = {capture["name"]: capture for capture in result["captures"]}
    check({name: capture["state"] for name, capture in states.items()} == EXPECTED, "each in its right state")
    check(result["exit_code"] == 1, "exit code 1, since not all succeeded")
    check(
        all(states[name]["reason"] and states[name]["hint"] for name in EXPECTED if EXPECTED[name] == "failed"),
        "each failure has a reason and a hint",
    )
    check("cut off" in states["broken"]["reason"], "the broken photos are reported as cut off")
    check(
        "control" in states["wrong control"]["reason"] or "gcp_list" in states["wrong control"]["reason"],
        "the control file is named",
    )
    check(
        killed and any("train" in each and "SIGKILL" in each for each in states["killed"]["earlier"]),
        "the killed training's reason is kept",
    )


def repeated(night: BatchTrial) -> None:
    """Repeat the batch at once: nothing may start but the command itself."""
    print("The same at once:")
    before, seen = night.events(), set()
    process = night.start()
    while process.poll() is None:
        seen |= set(descendants(process.pid))
        time.sleep(0.01)
    result = night.result_of(process)
    check(night.events() == before, "no capture has a new event")
    check(not seen, f"no process was started ({seen or 'none'})")
    check({capture["state"] for capture in result["captures"]} == {"reused", "failed"}, "all as they were")
    check(result["exit_code"] == 1, "exit code 1, since not all succeeded")


def changed(night: BatchTrial, captures: Mapping[str, Path]) -> None:
    """Add a capture and change an option of another: only these two run, the latter from the first affected stage."""
    print("One added, one changed:")
    night.write_list(captures, {"orbit": ["train.iterations=120"]})
    before = night.events()
    result = night.result_of(night.start())
    after = night.events()
    check({name for name in after if after[name] != before.get(name)} == {"added", "orbit"}, "just these two ran")
    new = [json.loads(line) for line in after["orbit"][len(before["orbit"]) :].splitlines()]
    started = [event["stage"] for event in new if event["kind"] == "stage_started"]
    check(
        started == ["blocks", "train", "clean", "evaluate", "export", "splat_depths", "flythrough"],
        f"of the changed one {', '.join(started)}",
    )
    states = {capture["name"]: capture["state"] for capture in result["captures"]}
    check(states["added"] == states["orbit"] == "done" and states["nadir"] == "reused", "both are done, others reused")


def dry_run(night: BatchTrial, name: str, plugin: str) -> None:
    """Check what Snakemake would submit to a cluster."""
    if importlib.util.find_spec(plugin) is None:
        sys.exit(f"{plugin} is not installed: pip install {plugin.replace('_', '-')}")
    with_profile = BatchTrial(night.listed, night.out.with_name(name))
    command = with_profile.command("--profile", str(PROFILES / name), "--dry-run")
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False)
    jobs = [line for line in done.stderr.splitlines() if line.strip().startswith("resources:") and "runtime" in line]
    check(
        done.returncode == 0 and len(jobs) > 0,
        f"{name}: {len(jobs)} jobs in the dry run, such as\n    {(jobs or [''])[-1].strip()}",
    )


def make_captures(data: Path, folder: Path) -> dict[str, Path]:
    """Create seven captures made of links."""
    house = demo()
    brighton = sorted((data / "brighton" / "photos").glob("*.JPG"))
    real = [sorted((data / name / "photos").iterdir())[0] for name in ("brighton", "ochota", "sceaux", "seneca")]
    captures = {
        "orbit": link(folder / "orbit", house[-12:]),
        "surveyed": link(folder / "surveyed", house[-12:]),
        "nadir": link(folder / "nadir", brighton[:8]),
        "killed": link(folder / "killed", house[-12:]),
        "broken": link(folder / "broken", []),
        "scattered": link(folder / "scattered", real),
        "wrong control": link(folder / "wrong control", house[-12:]),
    }
    control = capture_path().parent / "gcp_list.txt"
    (captures["surveyed"] / "gcp_list.txt").symlink_to(control)
    wrong = control.read_text(encoding="utf-8").replace("\t", " ").splitlines()
    (captures["wrong control"] / "gcp_list.txt").write_text("\n".join([wrong[0], *(f"x{line}" for line in wrong[1:])]))
    for photo in house[:3]:
        (captures["broken"] / photo.name).write_bytes(photo.read_bytes()[:20_000])
    return captures


def demo() -> list[Path]:
    """Return the demo's photos."""
    return sorted(capture_path().glob("*.JPG"))


def link(folder: Path, photos: Iterable[Path]) -> Path:
    """Create a folder of links to photos."""
    folder.mkdir(parents=True)
    for photo in photos:
        (folder / photo.name).symlink_to(photo)
    return folder


def kill_in_training(out: Path, batch: subprocess.Popen[str]) -> bool:
    """Wait until the capture is in training, then kill the training process."""
    events = out / "events.jsonl"
    while batch.poll() is None:
        if events.is_file() and b'"stage_started", "stage": "train"' in events.read_bytes():
            for process, words in descendants(batch.pid).items():
                if "splatpipe.pipeline.engine.runs.worker" in words and str(out) in parent_words(process):
                    os.kill(process, signal.SIGKILL)
                    print(f"    killed process {process}, which trained {out.name}")
                    return True
        time.sleep(0.05)
    return False


def descendants(process: int) -> dict[int, str]:
    """Return the command lines of all descendants of a process, by process ID."""
    parents = {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            parents[int(folder.name)] = int(fields[1])
        except (OSError, IndexError):
            continue
    found, front = {}, [process]
    while front:
        front = [child for child, parent in parents.items() if parent in front]
        found.update({child: words_of(child) for child in front})
    return found


def words_of(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text().replace("\0", " ").strip()
    except OSError:
        return ""


def parent_words(process: int) -> str:
    try:
        return words_of(int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1]))
    except (OSError, IndexError):
        return ""


def check(right: bool, what: str) -> None:
    """Report a passed check, or exit."""
    print(f"  {'yes' if right else 'NO '} {what}", flush=True)
    if not right:
        sys.exit(1)


if __name__ == "__main__":
    shutil.which("bash") or sys.exit("Snakemake needs bash.")
    main()
