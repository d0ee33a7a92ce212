"""Regressions that CI must notice: changed results under one version, forbidden imports, undocumented options."""

import ast
import re
import shutil
import subprocess
import sys
from collections.abc import Mapping
from os import environ
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "versions"))
import record
from sources import PACKAGE, data_digests
from stage_comparison import Comparison

ROOT = Path(__file__).resolve().parents[1]
MADE = ("*.so", "__pycache__", "dist", "node_modules", record.RECORD)


def copy_sources(target: Path, *besides: str) -> Path:
    """Copy the sources except build products and ``besides``; record them."""
    for folder in ("pipeline", "stages", "configs", "demo"):
        shutil.copytree(ROOT / folder, target / folder, ignore=shutil.ignore_patterns(*MADE, *besides))
    record.write(target, record.present(target))
    return target


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the sources that is imported as ``splatpipe`` where PYTHONPATH names the folder above; recorded."""
    root = copy_sources(tmp_path / PACKAGE, "capture")
    assert record.complaint(root) == ""
    return root


def replace(file: Path, pattern: str, text: str) -> None:
    """Replace the single match of a pattern."""
    changed, count = re.subn(pattern, text, file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert count == 1, f"{pattern} is in {file.name} {count} times"
    file.write_text(changed, encoding="utf-8")


def append(file: Path, text: str) -> None:
    file.write_text(file.read_text(encoding="utf-8") + text, encoding="utf-8")


def complained_of(root: Path) -> set[str]:
    """The stages that a complaint names."""
    named = re.search(r"changed of: (.*?)\. ", record.complaint(root))
    return set(named.group(1).split(", ")) if named else set()


def run(arguments: list[str], folder: Path, extra: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, cwd=folder, env={**environ, **extra}, capture_output=True, text=True, check=False)


def test_every_version_matches_the_present_sources() -> None:
    complaint = record.complaint(ROOT)
    assert not complaint, complaint


def test_a_changed_result_without_a_raised_version_is_noticed(copy: Path) -> None:
    replace(copy / "pipeline/splat/free_space.py", r"^CELLS = \d+", "CELLS = 99")
    noticed = complained_of(copy)
    assert "train" in noticed and not noticed & {"ingest", "features", "matches", "sparse", "georef"}
    assert "make versions" in record.complaint(copy)


def test_the_body_of_a_stages_shards_belongs_to_it(copy: Path) -> None:
    entry = '    entry="splatpipe.stages.split:run",'
    shards = '    shards=Shards("undistort.dataset", {}, entry="splatpipe.stages.train:run"),'
    replace(copy / "stages/line.py", f"^{entry}", f"{entry}\n{shards}")
    record.write(copy, record.present(copy))
    replace(copy / "pipeline/splat/free_space.py", r"^CELLS = \d+", "CELLS = 99")
    assert {"split", "train"} <= complained_of(copy)


def test_kernels_belong_to_the_stages_that_reach_them(copy: Path) -> None:
    kernel = copy / "pipeline/raster/native/adam_cpu.cpp"
    append(kernel, "\n// A comment,\n/* and\nanother */\n\n")
    assert record.complaint(copy) == ""
    append(kernel, "int planted;\n")
    noticed = complained_of(copy)
    assert "train" in noticed and not noticed & {"ingest", "features", "matches", "sparse", "georef"}


def test_comments_docstrings_and_formatting_do_not_count(copy: Path) -> None:
    for file in copy.glob("stages/*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        file.write_text(f'"""Another docstring."""\n# A comment.\n{ast.unparse(tree)}\n', encoding="utf-8")
    assert record.complaint(copy) == ""


@pytest.mark.parametrize(
    ("code", "is_counted"),
    [
        ("int floats = 116'000;  // a {}\nchar c = 'x';", False),
        ("int bits = 0xff'ffu;  /* a {} */ char c = u8'\\'';  // another {}", False),
        ("char c = L'\"';  // a {}", False),
        ('int floats = 1\'000; char text[] = "// a {}";', True),
        ("int floats = 1'000, {} = 2;", True),
    ],
)
def test_apostrophes_between_digits_are_not_quotes(tmp_path: Path, code: str, is_counted: bool) -> None:
    digests = []
    for word in ("tile", "block"):
        (tmp_path / "loss.h").write_text(code.format(word, word), encoding="utf-8")
        digests.append(data_digests(tmp_path)["loss.h"])
    assert (digests[0] != digests[1]) == is_counted


def test_a_version_is_recorded_with_its_sources(copy: Path) -> None:
    replace(copy / record.LINE_FILE, r'("matches",\n\s+version=)\d+', r"\g<1>99")
    assert complained_of(copy) == {"matches"}
    record.write(copy, record.present(copy))
    assert record.complaint(copy) == "" and record.recorded(copy)["matches"].version == 99


def test_each_stage_is_compared_on_earlier_outputs(tmp_path: Path) -> None:
    """A stage with changed output needs a raised version; one that reads it but behaves as before does not."""
    checkout = copy_sources(tmp_path / "checkout")
    shutil.copy(ROOT / "pyproject.toml", checkout)
    git = ["git", "-c", "user.name=t", "-c", "user.email=t@t", "-C", str(checkout)]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "right"]):
        subprocess.run([*git, *arguments], check=True)
    replace(checkout / "pipeline/photos/camera_groups.py", r"^ZOOM_TOLERANCE = \S+", "ZOOM_TOLERANCE = 0.5")
    append(checkout / "stages/features.py", "\nPLANTED = 1\n")
    subprocess.run([*git, "commit", "-qam", "wrong"], check=True)
    comparison = Comparison(checkout, tmp_path / "work", lambda text: None)
    base = comparison.last_right(["ingest", "features"])
    assert base == subprocess.check_output([*git, "rev-parse", "HEAD~1"], text=True).strip()
    verdicts = comparison.verdicts(base)
    assert {name: verdict.accepted for name, verdict in verdicts.items()} == {"ingest": False, "features": True}
    assert verdicts["ingest"].why == "other bits in cameras.json, lenses.json, photos/photos.json"


def test_an_upward_import_and_a_stage_that_imports_a_stage_are_noticed(copy: Path) -> None:
    append(copy / "pipeline/geometry/camera.py", "\nfrom splatpipe.pipeline.splat import ply\n")
    append(copy / "stages/undistort.py", "\nfrom splatpipe.stages import sparse\n")
    (copy / "__init__.py").touch()  # so that no other splatpipe joins it
    linter = str(Path(sys.executable).parent / "lint-imports")
    done = run(
        [linter, "--no-cache", "--config", str(ROOT / "pyproject.toml")], copy.parent, {"PYTHONPATH": str(copy.parent)}
    )
    assert done.returncode == 1
    assert "2 broken" in done.stdout
    assert "splatpipe.pipeline.geometry.camera -> splatpipe.pipeline.splat.ply" in done.stdout
    assert "splatpipe.stages.undistort -> splatpipe.stages.sparse" in done.stdout


def test_an_option_without_docs_is_noticed(copy: Path) -> None:
    replace(copy / "pipeline/sfm/options.py", r'(^    min_model_size: .*\n)    """[^"]*"""\n', r"\1")
    test = "test_every_option_has_a_help_text"
    done = run(
        ["-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/test_config.py", "-k", test],
        ROOT,
        {"PYTHONPATH": str(copy.parent), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == 1 and "sparse.min_model_size" in done.stdout
