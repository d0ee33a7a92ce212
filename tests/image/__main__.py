"""``make test-image``: builds the CPU image without a container engine's daemon, and runs the demo in it.

It runs as an arbitrary user with a read-only root, no network, 64 MB of /dev/shm, photos mounted read-only and no HOME;
it is stopped during matching and during training as by ``docker stop``, and must resume to a result bit-identical to an
undisturbed run.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import shutil
import sys
from pathlib import Path

from building import Image, ImageTools, Problem, build_image
from container import MEMORY, Container, Mounts
from contents import foreign_tools, pulled_bytes, sizes

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "image"
GOAL_PULLED = 700e6  # bytes
STOP_S = 5.0  # promised; docker stop kills after 10
SAME = ("splat.ply", "cameras.json", "sparse.glb")  # in OUT; files with times in them differ
STOPS = (("matches", 0.0), ("train", 300.0))  # where it is stopped: the stage and its progress, in its own unit


def main() -> int:
    """Run the test; return the exit code: 0 if everything holds."""
    parser = argparse.ArgumentParser(prog="make test-image", description=__doc__)
    parser.add_argument("--torch-index", default="", help="index of torch alone; empty for that of the rest")
    parser.add_argument("--no-build", action="store_true", help="take the image that the last call left")
    options = parser.parse_args()
    try:
        tools = ImageTools(WORK / "storage")
        if not options.no_build:
            build_image(tools, ROOT, options.torch_index, say)
        with tools.open_image() as image:
            show_sizes(tools, image)
            check_contents(image)
            run_demo(image)
    except Problem as problem:
        say(f"FAILED: {problem}")
        return 1
    say("The image holds what is promised.")
    return 0


def show_sizes(tools: ImageTools, image: Image) -> None:
    """Print the image's size, by package."""
    pulled = pulled_bytes(tools, WORK / "pushed")
    groups = sizes(image.root)
    unpacked = sum(group.unpacked for group in groups)
    say(f"{'':34}unpacked  compressed (MB)")
    for group in groups:
        say(f"  {group.name:32}{group.unpacked / 1e6:8.1f}{group.compressed / 1e6:12.1f}")
    say(f"The image: {pulled / 1e6:.0f} MB as pulled (goal {GOAL_PULLED / 1e6:.0f}), {unpacked / 1e6:.0f} MB unpacked.")
    if pulled > GOAL_PULLED:
        raise Problem("It is larger than its goal.")


def check_contents(image: Image) -> None:
    """Check what must be in the image, and what must not."""
    if image.entrypoint != ["splatpipe"]:
        raise Problem(f"Its ENTRYPOINT is {image.entrypoint}.")
    if image.user.partition(":")[0] in ("", "0", "root"):
        raise Problem("It runs as root.")
    missing = {"title", "description", "licenses", "version", "revision"} - {
        label.removeprefix("org.opencontainers.image.") for label in image.labels
    }
    if missing:
        raise Problem(f"OCI labels are missing: {', '.join(sorted(missing))}.")
    if found := foreign_tools(image.root):
        raise Problem(f"What builds and tests is in it: {', '.join(found)}.")
    say(f"User {image.user}, ENTRYPOINT {image.entrypoint}, {len(image.labels)} labels, no compiler, no test tools.")


def run_demo(image: Image) -> None:
    """Run the demo at preview, undisturbed and stopped twice; the results must be bit-identical."""
    photos = ROOT / "demo" / "capture"
    outs = {name: WORK / name for name in ("undisturbed", "stopped")}
    for out in outs.values():
        shutil.rmtree(out, ignore_errors=True)
        out.mkdir(parents=True)
    command = ["run", "/photos", "/out", "--preset", "preview"]
    whole = Container(image, WORK / "bundle", Mounts(photos / "photos", outs["undisturbed"]))
    report = json.loads(whole.must_end(0, ["doctor", "--json"], say, cores=1))
    limits = f"{report['cores']}; {report['memory']}"
    if not limits.startswith("1 ") or f"{MEMORY / 1e9:.1f} GB for this process" not in limits:
        raise Problem(f"It does not keep to its control group's limits: {limits}.")
    say(f"Limited to one processor and {MEMORY / 1e9:.1f} GB it finds: {limits}.")
    whole.must_end(0, command, say)
    say("The demo ran undisturbed.")
    stopped = Container(image, WORK / "bundle", Mounts(photos / "photos", outs["stopped"]))
    for stage, done in STOPS:
        end = stopped.stop_inside(command, stage, done)
        say(f"SIGTERM inside {stage} (at {end.progress}): exit code {end.code} after {end.seconds:.1f} s.")
        if end.code != 143 or end.seconds > STOP_S:
            raise Problem(f"It has to end with 143 in {STOP_S:.0f} s.\n{end.output}")
    stopped.must_end(0, command, say)
    first, second = (digests(out) for out in outs.values())
    if first != second:
        names = sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))
        raise Problem(f"These differ from the undisturbed run: {', '.join(names)}.")
    say(f"It went on to the same bits: {len(first)} artifacts and files.")


def digests(out: Path) -> dict[str, str]:
    """Return SHA-256 of the files without times in them; an artifact's name is the key of all its inputs."""
    files = [out / name for name in SAME] + sorted((out / "stages").glob("evaluate-*/views/*.png"))
    found = {file.relative_to(out).as_posix(): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}
    return found | {folder.name: "" for folder in (out / "stages").iterdir() if (folder / "manifest.json").is_file()}


def say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
