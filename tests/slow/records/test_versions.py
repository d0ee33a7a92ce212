"""Regressions that CI must notice, found as it finds them: by comparison of runs, by a linter, by tests."""

import shutil
import subprocess
from pathlib import Path

import pytest
import record
from repository import ROOT
from source_copies import append, copy_sources, replace, run
from sources import PACKAGE
from stage_comparison import Comparison


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """A copy of the sources that is imported as ``splatpipe`` where PYTHONPATH names the folder above; recorded."""
    root = copy_sources(tmp_path / PACKAGE, "capture")
    assert record.complaint(root) == ""
    return root


def test_each_stage_is_compared_on_earlier_outputs(tmp_path: Path) -> None:
    """A stage with changed output needs a raised version; one that reads it but behaves as before does not."""
    checkout = copy_sources(tmp_path / "checkout")
    shutil.copy(ROOT / "pyproject.toml", checkout)
    git = ["git", "-c", "user.name=t", "-c", "user.email=t@t", "-C", str(checkout)]
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-qm", "right"]):
        subprocess.run([*git, *arguments], check=True)
    replace(checkout / "pipeline/photos/intake/camera_groups.py", r"^ZOOM_TOLERANCE = \S+", "ZOOM_TOLERANCE = 0.5")
    append(checkout / "stages/features.py", "\nPLANTED = 1\n")
    subprocess.run([*git, "commit", "-qam", "wrong"], check=True)
    comparison = Comparison(checkout, tmp_path / "work", lambda text: None)
    base = comparison.last_right(["ingest", "features"])
    assert base == subprocess.check_output([*git, "rev-parse", "HEAD~1"], text=True).strip()
    verdicts = comparison.verdicts(base)
    assert {name: verdict.accepted for name, verdict in verdicts.items()} == {"ingest": False, "features": True}
    assert verdicts["ingest"].why == "other bits in cameras.json, lenses.json, photos/photos.json"


def test_an_option_without_docs_is_noticed(copy: Path) -> None:
    replace(copy / "pipeline/sfm/options.py", r'(^    min_model_size: .*\n)    """[^"]*"""\n', r"\1")
    test = "test_every_option_has_a_help_text"
    done = run(
        ["-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/unit/engine/test_config.py", "-k", test],
        ROOT,
        {"PYTHONPATH": str(copy.parent), "PYTHONDONTWRITEBYTECODE": "1"},
    )
    assert done.returncode == 1 and "sparse.min_model_size" in done.stdout
