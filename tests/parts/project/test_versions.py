"""Regressions that CI must notice: changed results under one version, forbidden imports, undocumented options."""

import ast
import re
import sys
from pathlib import Path

import pytest
import record
from repository import ROOT
from source_copies import append, copy_sources, replace, run
from sources import PACKAGE, data_digests

# One import that runs up from each inner room, and one between rooms.
UPWARD = {
    "geometry.camera": "splat.containers.ply",
    "sfm.model.structure": "sfm.mapping.mapping",
    "sfm.matching.reduction": "sfm.judging.judging",
    "survey.crs.geodesy": "survey.control.control",
    "survey.placing.level": "survey.adjustment.block",
    "surface.rasters.grid": "surface.heights.dsm",
    "surface.depths.sources": "surface.ortho.ortho",
    "train.plan.rates": "train.state.state",
    "train.blocks.cells.needs": "train.blocks.coarse",
    "splat.model.sh": "splat.levels.levels",
    "photos.metadata.exif": "photos.intake.check",
    "edit.floaters.isolation": "edit.workpiece",
    "engine.files.small_file": "engine.runs.store",
    "raster.cuda.cuda_api": "raster.optim",
    "app.report.facts.wording": "app.report.page",
}


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the sources that is imported as ``splatpipe`` where PYTHONPATH names the folder above; recorded."""
    root = copy_sources(tmp_path / PACKAGE, "capture")
    assert record.complaint(root) == ""
    return root


def complained_of(root: Path) -> set[str]:
    """The stages that a complaint names."""
    named = re.search(r"changed of: (.*?)\. ", record.complaint(root))
    return set(named.group(1).split(", ")) if named else set()


def test_every_version_matches_the_present_sources() -> None:
    complaint = record.complaint(ROOT)
    assert not complaint, complaint


def test_a_changed_result_without_a_raised_version_is_noticed(copy: Path) -> None:
    replace(copy / "pipeline/splat/quality/free_space.py", r"^CELLS = \d+", "CELLS = 99")
    noticed = complained_of(copy)
    assert "train" in noticed and not noticed & {"ingest", "features", "matches", "sparse", "georef"}
    assert "make versions" in record.complaint(copy)


def test_the_body_of_a_stages_shards_belongs_to_it(copy: Path) -> None:
    entry = '    entry="splatpipe.stages.split:run",'
    shards = '    shards=Shards("undistort.dataset", {}, entry="splatpipe.stages.train:run"),'
    replace(copy / "stages/line.py", f"^{entry}", f"{entry}\n{shards}")
    record.write(copy, record.present(copy))
    replace(copy / "pipeline/splat/quality/free_space.py", r"^CELLS = \d+", "CELLS = 99")
    assert {"split", "train"} <= complained_of(copy)


def test_kernels_belong_to_the_stages_that_reach_them(copy: Path) -> None:
    kernel = copy / "pipeline/native/adam/adam_cpu.cpp"
    append(kernel, "\n// A comment,\n/* and\nanother */\n\n")
    assert record.complaint(copy) == ""
    append(kernel, "int planted;\n")
    noticed = complained_of(copy)
    assert {"train", "matches"} <= noticed and not noticed & {"ingest", "control", "targets", "undistort", "split"}


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


def test_imports_that_run_up_are_noticed_between_rooms_inner_rooms_and_stages(copy: Path) -> None:
    append(copy / "stages/undistort.py", "\nfrom splatpipe.stages import sparse\n")
    for below, above in UPWARD.items():
        package, _, module = above.rpartition(".")
        path = copy / "pipeline" / f"{below.replace('.', '/')}.py"
        append(path, f"\nfrom splatpipe.pipeline.{package} import {module}\n")
    (copy / "__init__.py").touch()  # so that no other splatpipe joins it
    linter = str(Path(sys.executable).parent / "lint-imports")
    done = run(
        [linter, "--no-cache", "--config", str(ROOT / "pyproject.toml")], copy.parent, {"PYTHONPATH": str(copy.parent)}
    )
    assert done.returncode == 1
    report = " ".join(done.stdout.split())
    assert "splatpipe.stages.undistort -> splatpipe.stages.sparse" in report
    missed = [
        f"{below} -> {above}"
        for below, above in UPWARD.items()
        if f"splatpipe.pipeline.{below} -> splatpipe.pipeline.{above}" not in report
    ]
    assert missed == []
