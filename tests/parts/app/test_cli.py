"""The command line: exit codes, messages without tracebacks, one JSON object, quick help."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command import splatpipe

from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.raster.isa import choose_isa, isa_names


def in_a_process(*arguments: object, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ, **variables})


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def test_help_names_every_command_and_imports_nothing_heavy() -> None:
    done = in_a_process("--help")
    assert done.returncode == 0
    for command in ("run", "stage", "demo", "georef", "render", "status", "tidy", "doctor", "options"):
        assert command in done.stdout
    code = (
        "import sys; from splatpipe.pipeline.app.cli import main; from splatpipe.stages import line\n"
        "print([name for name in ('torch', 'numpy', 'scipy', 'pycolmap', 'cv2', 'kornia') if name in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
    code = "import sys; from splatpipe.pipeline.app.cli import main; print('pydantic' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "False"


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["run", "{tmp}/none", "{tmp}/out"], 1, "There is no folder"),
        (["run", "{tmp}/file", "{tmp}/out"], 1, "is a file"),
        (["run", "{photos}", "{tmp}/file"], 2, "is a file"),
        (["run", "{photos}", "{photos}/out"], 2, "inside the photo folder"),
        (["run", "{photos}", "/proc/out"], 4, "Cannot write"),
        (["run", "{photos}"], 2, "Missing argument"),
        (["run", "{photos}", "{tmp}/out", "--fast"], 2, "No such option"),
        (["run", "{photos}", "{tmp}/out", "--preset", "fast"], 2, "no preset"),
        (["run", "{photos}", "{tmp}/out", "--device", "tpu"], 2, "no device"),
        (["run", "{photos}", "{tmp}/out", "--device", "cuda", "--set", "train.loss=kornia"], 2, "on a CUDA device"),
        (["run", "{photos}", "{tmp}/out", "--threads", "-1"], 2, "--threads"),
        (["run", "{photos}", "{tmp}/out", "--set", "train.iterations=0"], 2, "train.iterations = 0"),
        (["run", "{photos}", "{tmp}/out", "--set", "train.iteration=9"], 2, "Did you mean train.iterations?"),
        (["run", "{photos}", "{tmp}/out", "--config", "{tmp}/broken.toml"], 2, "not valid TOML"),
        (["run", "{photos}", "{tmp}/out", "--until", "finish"], 2, "no stage"),
        (["run", "{photos}", "{tmp}/out", "--rerun", "finish"], 2, "no stage"),
        (["run", "{photos}", "{tmp}/out", "--time-budget", "10"], 2, 'Cannot understand --time-budget "10"'),
        (["run", "{photos}", "{tmp}/out", "--time-budget", "-5m"], 2, "--time-budget"),
        (["run", "{photos}", "{tmp}/out", "--time-budget", "99999h"], 2, "train.time_budget_s"),
        (["run", "{photos}", "{tmp}/out", "--max-memory", "8"], 2, 'Cannot understand --max-memory "8"'),
        (["run", "{photos}", "{tmp}/out", "--max-memory", "99999999T"], 2, "train.max_memory_bytes"),
        (["run", "{photos}", "{tmp}/out", "--set", "train.time_budget_s=-1"], 2, "train.time_budget_s"),
        (["demo", "{tmp}/out", "--time-budget", "soon"], 2, 'Cannot understand --time-budget "soon"'),
        (["run", "{photos}", "{tmp}/out", "--set", "georef.crs=EPSG:1"], 2, "There is no EPSG:1"),
        (["run", "{photos}", "{tmp}/out", "--set", "georef.vertical=sea"], 2, '"sea" is not a vertical datum'),
        (["render", "{tmp}/out", "-o", "{tmp}/film.webm"], 2, "does not contain a run"),
        (["georef", "{tmp}/out", "--gcp", "{tmp}/none.txt"], 2, "does not contain a run"),
        (["stage", "train", "{tmp}/out"], 2, "does not contain a run"),
        (["stage", "trains", "{tmp}/out"], 2, "no stage"),
        (["status", "{tmp}/out"], 2, "does not contain a run"),
        (["tidy", "{photos}"], 2, "does not contain a run"),
        (["clean", "{photos}"], 2, "is now called splatpipe tidy"),
        (["fly"], 2, "No such command"),
    ],
)
def test_an_invalid_call_gets_one_message_and_its_exit_code(
    tmp_path: Path, photos: Path, arguments: list[str], code: int, message: str
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "broken.toml").write_text("[train\n")
    done = splatpipe(*(text.format(tmp=tmp_path, photos=photos) for text in arguments), cwd=tmp_path)
    assert done.returncode == code, done.stderr
    assert message in " ".join(done.stderr.replace("│", " ").split())
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out" / "splat.ply").exists()


@pytest.mark.usefixtures("plain_reports")
def test_json_is_one_object_on_stdout_even_on_failure(tmp_path: Path, photos: Path) -> None:
    done = splatpipe("run", photos, tmp_path / "out", "--json")
    assert done.returncode == 1
    output = json.loads(done.stdout)
    assert output["exit_code"] == 1
    assert output["error"]["message"]
    assert output["error"]["hint"]


def test_doctor_names_the_instruction_set_in_use_and_those_available() -> None:
    done = splatpipe("doctor", "--json")
    assert done.returncode == 0, done.stderr
    chosen = os.environ.get("SPLATPIPE_ISA") or isa_names()[0]
    assert json.loads(done.stdout)["rasterizer"] == f"native, {chosen} (of {', '.join(isa_names())})"
    done = in_a_process("doctor", "--json", SPLATPIPE_ISA="baseline")
    assert json.loads(done.stdout)["rasterizer"].startswith("native, baseline ")


def unwrapped(panel: str) -> str:
    """The text of a panel, without its frame and line breaks."""
    return " ".join(panel.replace("│", " ").split())


def test_cuda_is_refused_at_once_with_the_same_reason_as_in_doctor(tmp_path: Path, photos: Path) -> None:
    hidden = {"CUDA_VISIBLE_DEVICES": ""}  # with a GPU or without
    output = json.loads(in_a_process("doctor", "--json", **hidden).stdout)["CUDA"]
    assert output.startswith("not used. ")
    done = in_a_process("run", photos, tmp_path / "out", "--device", "cuda", **hidden)
    assert done.returncode == 4, done.stderr
    assert "CUDA does not work here. " + output.removeprefix("not used. ").split(". ")[0] in unwrapped(done.stderr)
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_unknown_instruction_set_is_reported_before_anything_runs(tmp_path: Path, photos: Path) -> None:
    done = in_a_process("run", photos, tmp_path / "out", SPLATPIPE_ISA="sse9")
    assert done.returncode == 2, done.stderr
    assert 'SPLATPIPE_ISA asks for "sse9"' in unwrapped(done.stderr)
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "out").exists()


def test_an_instruction_set_that_the_machine_lacks_is_a_machine_error() -> None:
    assert choose_isa("", ["avx2", "baseline"]) == choose_isa("auto", ["avx2", "baseline"]) == "avx2"
    assert choose_isa("baseline", ["avx2", "baseline"]) == "baseline"
    with pytest.raises(MachineError, match="avx512, which this CPU does not have") as caught:
        choose_isa("avx512", ["avx2", "baseline"])
    assert caught.value.exit_code == 4
    assert "avx2, baseline" in caught.value.hint


def test_options_lists_every_option(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    done = splatpipe("options", "--preset", "preview")
    assert done.returncode == 0, done.stderr
    assert "train.iterations" in done.stdout


def test_the_library_is_imported_without_anything_heavy() -> None:
    code = (
        "import sys; before = set(sys.modules); import splatpipe; splatpipe.SplatpipeError; splatpipe.__version__\n"
        "print(sorted({name.split('.')[0] for name in set(sys.modules) - before} - set(sys.stdlib_module_names)))"
    )
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "['splatpipe']"


def test_the_package_is_a_namespace_of_its_own() -> None:
    code = (
        "import splatpipe.pipeline, splatpipe.stages, splatpipe.demo\n"
        "import importlib.util; print(importlib.util.find_spec('pipeline'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd="/")
    assert done.stdout.strip() == "None"
