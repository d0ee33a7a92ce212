"""A visit to a GPU, both calls from end to end at toy size, as if on the bare machine: see tests/bare.

Parts that only need kernels run on the harness; the others have stand-ins that succeed, fail, refuse and hang.
"""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path

import gpu_libraries
import gpu_parts
import gpu_peer_sources
import gpu_proofs
import gpu_report
import gpu_sanitized
import gpu_speed
import gpu_visit
import pytest
import tiny_scene
from building import NATIVE, build_on_cpu
from gpu_parts import Row
from repository import ROOT

from splatpipe.pipeline.raster.cuda import cuda, cuda_api
from splatpipe.pipeline.splat.containers.ply import write_splat

BARE = ROOT / "tests" / "bare"
CARRIED = ("pydantic", "pydantic_core", "annotated_types", "typing_inspection", "tomli_w")
ENDED_S = 30.0  # within which a broken first kernel ends the visit
PATIENT = {"": 120.0}  # limits, where none is to be reached, however busy this machine is
# What needs a card, or a compiler of its own.
STAND_INS = {
    "the same bits twice": "same_bits",
    "racecheck": "succeeds",
    "kernels": "profiles",
    **{f"{peer} compiled": "compiles" for peer in gpu_visit.BUILT_PEERS},
    **{f"{peer}, ": "peer_speed" for peer in gpu_visit.TIMED_PEERS},
    "training": "trains",
    "training, seed 0": "trains_here",
}
# Faults in a kernel of the loss, active where this variable names them.
VARIABLE = "SPLATPIPE_PLANTED"
SIGN = "v > 0.0f ? 1.0f : (v < 0.0f ? -1.0f : 0.0f)"
PLANTED = '(planted("wrong") ? -v : v) > 0.0f ? 1.0f : ((planted("wrong") ? -v : v) < 0.0f ? -1.0f : 0.0f)'
PLANT = f"""#include <cstdlib>
#include <cstring>
static bool planted(const char* fault) {{
    const char* given = getenv("{VARIABLE}");
    volatile bool spins = given && !strcmp(given, "hang");
    while (spins) {{
    }}
    return given && !strcmp(given, fault);
}}
"""


@dataclass
class Visited:
    """What a call left.

    Attributes:
        lines: Of its file.
        printed: On its output, and in its logs.
    """

    lines: list[Row]
    printed: str
    states: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.states = {line["part"]: line["state"] for line in self.lines if "state" in line}

    def rows(self, part: str) -> list[Row]:
        return [line["row"] for line in self.lines if line.get("part") == part and "row" in line]

    def error(self, part: str) -> str:
        return next(line["error"] for line in self.lines if line.get("part") == part and "error" in line)


@dataclass
class Place:
    """Where visits are made.

    Attributes:
        folder: For packs and files.
        library: The harness's kernels.
    """

    folder: Path
    library: Path

    @property
    def pack(self) -> Path:
        return self.folder / "pack"

    def visit(self, call: str, changes: Row, name: str = "", environment: Sequence[tuple[str, str]] = ()) -> Visited:
        """Make a call in a process of its own, in the environment of the bare machine."""
        out = self.folder / (name or call)
        given = {
            "PATH": os.pathsep.join([str(BARE / "programs"), os.environ["PATH"]]),
            "PYTHONPATH": str(BARE),
            "TMPDIR": str(self.folder),
            "SPLATPIPE_HARNESS": str(self.library),
            "OMP_NUM_THREADS": "1",
            "HOME": str(self.folder),
            **dict(environment),
        }
        words = [sys.executable, str(BARE / "visit.py"), call, str(self.pack), str(out), json.dumps(changes)]
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=given, cwd=self.folder)
        assert done.returncode == 0, done.stderr
        lines = gpu_parts.read_lines(out / f"{call}.jsonl")
        return Visited(lines, done.stdout + "".join(log.read_text() for log in sorted(out.glob("*.log"))))


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder = tmp_path_factory.mktemp("gpu_visit")
    pack = folder / "pack"
    capture = pack / "captures" / "sceaux"
    dataset = tiny_scene.write_dataset(capture / "undistort.dataset")
    shutil.copyfile(tiny_scene.split_part(dataset, every=4)["split.views"], capture / "split.views")
    model = tiny_scene.true_model()
    write_splat(capture / "initialize.splat", model)
    model.sh[:, 0] += 0.3  # or the photos' differences from its renders are of rounding alone, and of either sign
    write_splat(capture / "trained.ply", model)
    (pack / "libraries").mkdir()
    package = find_spec("splatpipe.pipeline.native")
    assert package is not None and package.submodule_search_locations is not None
    for library in Path(package.submodule_search_locations[0]).glob("_native*.so"):
        shutil.copyfile(library, pack / "libraries" / library.name)
    (pack / "wheels").mkdir()
    for name in CARRIED:
        zip_package(name, pack / "wheels" / f"{name}-0-py3-none-any.whl")
    for peer in gpu_visit.BUILT_PEERS:
        (pack / "peers" / peer).mkdir(parents=True)
    (pack / "cpu.json").write_text(json.dumps([{"seed": s, "psnr_cc": 20.0, "train_seconds": 9.0} for s in range(3)]))
    (pack / "pack.json").write_text(json.dumps({"commit": "a commit"}))
    return Place(folder, build_on_cpu())


def zip_package(name: str, wheel: Path) -> None:
    """Write an installed package as a wheel."""
    package = find_spec(name)
    assert package is not None and package.origin is not None
    root = Path(package.origin).parent
    with zipfile.ZipFile(wheel, "w") as archive:
        for path in root.rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                archive.write(path, path.relative_to(root.parent))


@pytest.fixture(scope="module")
def first(place: Place) -> Visited:
    """The first call, all well."""
    return place.visit("first", {"parts": STAND_INS, "limits": PATIENT})


@pytest.fixture(scope="module")
def troubled(place: Place) -> Visited:
    """The first call, with every kind of trouble."""
    parts = {"": "succeeds", "tests": "fails", "the same": "hangs", "memcheck": "refuses", "racecheck": "crashes"}
    parts |= {"compilers ended": "quiet", "faster-gs compiled": "hangs", "gsplat, ": "fails", "few, made": "is_bare"}
    # What one part leaves of its limit is added to the next ones'.
    limits = {"the card": 3.0, "smoke": 3.0, "tests": 0.1, "agreement": 0.1, "the same": 0.1, "faster-gs compiled": 1.0}
    return place.visit("first", {"parts": parts, "limits": limits, "light": True, "seconds": 60.0}, "troubled")


def test_the_first_call_runs_every_part_in_order(first: Visited) -> None:
    planned = [line["part"] for line in first.lines[0]["plan"] if not line.get("beside")]
    ended = [line["part"] for line in first.lines if "state" in line and not line["part"].endswith("compiled")]
    assert ended == ["unpacked", *planned]
    assert {name: state for name, state in first.states.items() if state != "done"} == {}, first.printed
    assert first.lines[-1]["end"] == "green" and first.lines[-1]["red"] == []
    names = list(first.states)
    assert all(names.index(f"{peer} compiled") < names.index("compilers ended") for peer in gpu_visit.BUILT_PEERS)


def test_its_parts_measure_what_they_are_to_measure(first: Visited) -> None:
    assert first.rows("the card")[0]["driver_version"] == "580.159.04"
    assert first.rows("smoke")[0]["psnr_db"] >= gpu_proofs.MIN_DB
    assert len(first.rows("agreement with the CPU")) == 4
    assert [row["same"] for row in first.rows("features")] == [True] * 3
    assert [row["channels"] for row in first.rows("features, middle") if row["features_ms"] > 0.0] == [None, 3, 32]
    assert [(row["of"], row["found"]) for row in first.rows("memcheck")] == [("every_kernel", 0)]
    for name, scene, count in (("few, made", "made", gpu_visit.TOY.few), ("trained scene", "trained", 150)):
        whole, alone = first.rows(name)
        assert (whole["scene"], whole["count"], whole["preset"]) == (scene, count, False)
        assert min(whole["iteration_ms"], whole["host_ms"], alone["raster_ms"], alone["forward_ms"]) > 0.0
    assert first.rows("few, default preset")[0]["preset"]
    (trained,) = first.rows("training, seed 0")
    assert (trained["device"], trained["iterations"]) == ("cpu", gpu_visit.TOY.iterations) and trained["psnr_cc"] > 5.0


def test_the_tests_marked_cuda_are_collected_on_the_bare_machine(first: Visited) -> None:
    (row,) = first.rows("tests marked cuda")
    assert int(row["tests"].split("/")[0].split(" ")[0]) > 20, row
    assert "error" not in row["tests"]
    assert "test_a_training_has_the_same_bits_twice_and_the_cpus_loss" in first.printed


def test_troubles_leave_what_was_measured_and_the_rest_runs(troubled: Visited) -> None:
    states = {name: state for name, state in troubled.states.items() if state != "done"}
    assert states == {
        "tests marked cuda": "failed",
        "the same bits twice": "late",
        "memcheck": "refused",
        "racecheck": "failed",
        "faster-gs compiled": "late",
        **{f"gsplat, {scene}": "failed" for scene in ("trained scene", "middle, made", "many, made")},
    }
    assert troubled.lines[-1]["red"] == ["tests marked cuda", "the same bits twice", "racecheck"]
    assert troubled.error("tests marked cuda").endswith("it broke")
    assert troubled.error("memcheck").endswith("refused: not on this machine")
    assert troubled.rows("tests marked cuda") and troubled.rows("racecheck")
    (hung,) = troubled.rows("the same bits twice")
    assert not is_running(hung["child"])
    imported = troubled.rows("few, made")[0]
    assert {name for name, found in imported.items() if found} == {"pydantic", "tomli_w"}
    assert all("splatpipe-gpu-visit" in found for found in imported.values() if found)


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_the_second_call_repeats_what_was_red(troubled: Visited, first: Visited) -> None:
    peers = gpu_visit.BUILT_PEERS
    again = [part.name for part in gpu_visit.second_call(gpu_visit.TOY, peers, troubled.lines)]
    limits = ["most, memory", "more than 2^31 pairs", "synccheck", "initcheck", "long training"]
    assert again == ["smoke", "tests marked cuda", "the same bits twice", "racecheck", *limits]
    assert [part.name for part in gpu_visit.second_call(gpu_visit.TOY, peers, first.lines)] == limits


def test_the_second_call_after_a_green_one_measures_limits(place: Place, first: Visited) -> None:
    shutil.copyfile(place.folder / "first" / "first.jsonl", place.pack / "first.jsonl")
    second = place.visit("second", {"limits": PATIENT}, environment=[("STAND_IN_SANITIZER", "refuses")])
    states = {name: state for name, state in second.states.items() if state != "done"}
    assert states == {"synccheck": "refused", "initcheck": "refused"}, second.printed
    assert second.lines[-1]["end"] == "green"
    assert second.rows("more than 2^31 pairs")[0]["same"]
    assert [row["iterations"] for row in second.rows("long training")] == [2, 4]
    record = gpu_report.VisitRecord(
        [place.folder / "first" / "first.jsonl", place.folder / "second" / "second.jsonl"], []
    )
    text = "\n".join(gpu_report.tables(record))
    assert "On NVIDIA H100 80GB HBM3, driver 580.159.04" in text and "4 of 4 iterations" in text


def test_parts_without_time_are_not_begun(place: Place) -> None:
    visited = place.visit("first", {"parts": {"": "succeeds"}, "light": True, "seconds": 1.0}, "short")
    assert set(visited.states.values()) == {"done", "not begun"}
    assert visited.states["smoke"] == "not begun" and visited.lines[-1]["end"] == "red"


@pytest.fixture(scope="module")
def planted(place: Place) -> Path:
    source = NATIVE / "cuda" / "loss.cu"
    text = source.read_text()
    assert text.count(SIGN) == 1
    return build_on_cpu(name="splat_cuda_planted", changed={source: PLANT + text.replace(SIGN, PLANTED)})


@pytest.mark.parametrize("fault", ["wrong", "hang"])
def test_a_broken_first_kernel_ends_the_visit_and_is_told(place: Place, planted: Path, fault: str) -> None:
    environment = [("SPLATPIPE_HARNESS", str(planted)), (VARIABLE, fault)]
    if fault == "wrong":
        environment.append(("STAND_IN_SANITIZER", "refuses"))
    limits = {"smoke": 2.0} if fault == "hang" else PATIENT
    parts = {name: "succeeds" for name in STAND_INS if name.endswith("compiled")}
    visited = place.visit("first", {"limits": limits, "parts": parts}, fault, environment)
    states = {name: state for name, state in visited.states.items() if state != "done"}
    assert list(states)[:2] == ["smoke", "smoke under memcheck"]
    outcomes = (states.pop("smoke"), states.pop("smoke under memcheck"))
    assert outcomes == {"wrong": ("failed", "refused"), "hang": ("late", "late")}[fault]
    assert set(states.values()) == {"not begun"}
    assert visited.lines[-1]["red"][0] == "smoke"
    if fault == "wrong":
        assert "differ from the CPU's" in visited.error("smoke")
    print(f"{fault}: ended after {visited.lines[-1]['seconds']} s")


def test_the_limits_fit_the_calls() -> None:
    scale, graces = gpu_visit.VisitScale(), 2 * gpu_parts.GRACE_S
    first = gpu_visit.first_call(scale, gpu_visit.BUILT_PEERS)
    second = gpu_visit.second_call(
        scale, gpu_visit.BUILT_PEERS, [{"part": part.name, "state": "done"} for part in first]
    )
    for parts, seconds in ((first, gpu_visit.FIRST_S), (second, gpu_visit.SECOND_S)):
        print("\n".join(f"{part.limit_s:4g} s  {part.name}{' (beside)' * part.beside}" for part in parts))
        assert sum(part.limit_s for part in parts if not part.beside) <= seconds
    waits = [part.entry for part in first].index(gpu_parts.QUIET)
    assert sum(part.limit_s for part in first[: waits + 1] if not part.beside) <= 150.0
    broken = next(part for part in first if part.on_failure)
    assert broken.on_failure is not None
    assert broken.limit_s + broken.on_failure.limit_s + 2 * graces <= ENDED_S


def test_a_carried_library_that_does_not_fit_is_compiled_there(
    place: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (good,) = (place.pack / "libraries").glob("_native*.so")
    carried, packages = tmp_path / "carried", tmp_path / "packages"
    carried.mkdir()
    (carried / "_native.abi3.so").write_bytes(b"of another machine")
    shutil.copytree(NATIVE.parent, packages / "splatpipe" / "pipeline", ignore=gpu_visit.UNUSED)
    shutil.copy2(NATIVE.parent / "door" / "__init__.py", packages / "splatpipe")
    monkeypatch.setenv("SPLATPIPE_HARNESS", str(place.library))
    monkeypatch.setattr(gpu_libraries, "_compile_here", lambda scratch, target: good)
    said = gpu_libraries.place(carried, packages, tmp_path)
    assert said["_native.abi3.so"].startswith("compiled here, since the carried one does not fit: ImportError")
    assert [path.name for path in (packages / "splatpipe" / "pipeline" / "native").glob("*.so")] == [good.name]
    (carried / "_native.abi3.so").unlink()
    shutil.copy(good, carried)
    assert gpu_libraries.place(carried, packages, tmp_path)["_native.abi3.so"] == "as carried"


def test_peers_are_trimmed_to_what_is_timed(tmp_path: Path) -> None:
    peers, packed = tmp_path / "sources", tmp_path / "pack" / "peers"
    gsplat = peers / "gsplat" / "gsplat"
    files = {"version.py": '__version__ = "1.5.3"', "rendering.py": "", "cuda/ext.cpp": "all of them"}
    files |= {"cuda/include/Ops.h": "", "cuda/csrc/third_party/glm/glm/vec3.hpp": ""}
    files |= {f"cuda/csrc/{name}": "" for name in (*gpu_peer_sources.GSPLAT_SOURCES, "Relocation.cpp", "Common.h")}
    files["cuda/csrc/Rasterization.cpp"] = "a\n        __LAUNCH_KERNEL__(3)\n        __LAUNCH_KERNEL__(33)\nb\n"
    for name, text in files.items():
        (gsplat / name).parent.mkdir(parents=True, exist_ok=True)
        (gsplat / name).write_text(text)
    said = gpu_peer_sources.pack_peers(peers, packed)
    assert said["gsplat"] == "1.5.3" and said["faster-gs"].startswith("left out: there is no faster-gaussian-splatting")
    made = packed / "gsplat" / "gsplat" / "cuda"
    assert (made / "csrc" / "Rasterization.cpp").read_text() == "a\n        __LAUNCH_KERNEL__(3)\nb\n"
    assert not (made / "csrc" / "Relocation.cpp").exists() and (made / "csrc" / "Common.h").exists()
    assert "gsplat::adam" in (made / "ext.cpp").read_text()
    assert gpu_visit.carried_peers(tmp_path / "pack") == ["gsplat"]
    assert gpu_peer_sources.pack_peers(None, packed)["gsplat"] == "as before"
    (gsplat / "version.py").write_text('__version__ = "1.6.0"')
    assert gpu_peer_sources.pack_peers(peers, packed)["gsplat"] == "left out: it is not gsplat 1.5.3"
    assert set(gpu_peer_sources.pack_peers(None, packed)) == set(gpu_visit.BUILT_PEERS)


def test_a_missed_factor_is_a_finding_and_wrong_gradients_are_a_failure(tmp_path: Path) -> None:
    lines: list[Row] = [{"call": "first", "began": "2027-01-02T03:04:05", "carried": {"commit": "1234567"}}]
    view = {"psnr_db": 71.5, "gradients": {"means": 2e-4}}
    ours = {"scene": "made", "count": 1_000_000, "preset": False, "host_ms": 1.0, "slowest_ms": 9.0, "peak_gb": 0.5}
    theirs = {"peer": "gsplat", "scene": "made", "count": 1_000_000, "raster_ms": 8.0, "peak_gb": 1.0, "ssim": "fused"}
    for part, row in (
        ("the card", {"name": "NVIDIA H200", "driver_version": "580.1"}),
        ("agreement with the CPU", view),
        ("middle, made", ours | {"iteration_ms": 6.0}),
        ("gsplat, middle, made", theirs | {"iteration_ms": 9.0, "optimiser": "SelectiveAdam"}),
        *((f"training, seed {seed}", {"seed": seed, "psnr_cc": 20.1 + seed, "train_seconds": 5}) for seed in range(3)),
    ):
        lines += [{"part": part, "row": row}, {"part": part, "state": "done", "seconds": 1.0}]
    lines.append({"part": "memcheck", "state": "refused", "seconds": 2.0, "error": "refused: Device not supported"})
    file = tmp_path / "first.jsonl"
    cpus = [{"seed": seed, "psnr_cc": 20.0 + seed, "train_seconds": 50} for seed in range(3)]

    def states() -> dict[str, tuple[str, str]]:
        file.write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"part": "cut o')
        record = gpu_report.VisitRecord([file], cpus)
        print("\n".join(gpu_report.tables(record)))
        return {each.demand: (each.measured, each.state) for each in gpu_report.verdicts(record)}

    found = states()
    assert found["renders ≥ 60 dB from the CPU's"] == ("71.5 dB", gpu_report.HOLDS)
    assert found["≥ 2 times gsplat's iterations, 1,000,000 (made)"] == ("1.50 times", gpu_report.MISSED)
    assert found["≤ 0.6 of gsplat's memory, 1,000,000 (made)"] == ("0.50", gpu_report.HOLDS)
    assert found["≥ 1 times faster-gs's iterations"][1] == gpu_report.UNKNOWN
    assert found["memcheck finds nothing"] == ("refused by the machine", gpu_report.UNKNOWN)
    assert found["psnr_cc within 0.1 dB + 2 standard errors of the CPU's"][1] == gpu_report.HOLDS
    assert gpu_report.FAILS not in {state for _, state in found.values()}
    view["gradients"] = {"means": float("nan")}
    assert states()["gradients within 0.001 of the CPU's"][1] == gpu_report.FAILS


def test_what_is_carried_is_weighed_and_the_command_printed(
    place: Place, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import gpu_prepare

    gpu_prepare.print_commands(place.pack, again=False)
    said = capsys.readouterr().out
    assert "python3 benchmarks gpu_visit first --pack " in said and "timeout_s 420" in said
    print(next(line for line in said.splitlines() if "MiB, the tree's" in line))
    monkeypatch.setattr(gpu_prepare, "MAX_MEBIBYTES", 1)
    with pytest.raises(SystemExit, match="too much"):
        gpu_prepare.print_commands(place.pack, again=True)


def test_every_kernel_is_run_under_the_sanitizers(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    called: set[str] = set()
    call = cuda.CudaKernels.call

    def noted(kernels: cuda.CudaKernels, name: str, *arguments: object) -> None:
        called.add(name)
        call(kernels, name, *arguments)

    monkeypatch.setattr(cuda.CudaKernels, "call", noted)
    monkeypatch.setenv("SPLATPIPE_HARNESS", str(place.library))
    (row,) = gpu_sanitized.every_kernel(100, (51, 37))
    assert called == {name for name in cuda_api.CALLS if name != "splat_device"}
    assert row["chunks"] > 2 and row["finite"]


@pytest.mark.parametrize(
    ("way", "patience_s", "said"),
    [("refuses", 60.0, "Device not supported"), ("hangs", 0.5, "does not answer"), ("finds", 60.0, "found something")],
)
def test_what_a_sanitizer_says_is_told(way: str, patience_s: float, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(BARE / "programs"), prepend=os.pathsep)
    monkeypatch.setenv("STAND_IN_SANITIZER", way)
    monkeypatch.setattr(gpu_sanitized, "PROBE_S", patience_s)
    monkeypatch.setattr(gpu_sanitized.sys, "executable", "/bin/true")  # in place of the program under it
    with pytest.raises(SystemExit if way == "finds" else gpu_parts.Refusal, match=said):
        list(gpu_sanitized.sanitized("memcheck"))


@pytest.mark.parametrize(("way", "said"), [("fails", "couldn't communicate"), ("works", "")])
def test_the_card_is_named_or_why_it_is_not(way: str, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(BARE / "programs"), prepend=os.pathsep)
    monkeypatch.setenv("STAND_IN_SMI", way)
    if said:
        with pytest.raises(SystemExit, match=said):
            list(gpu_speed.card())
    else:
        assert [row["name"] for row in gpu_speed.card()] == ["NVIDIA H100 80GB HBM3"]
