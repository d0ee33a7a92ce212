"""Groups of slow tests: which sources they stand for, and when they have to run again."""

import datetime
from pathlib import Path

import groups
import pytest
import suite
from repository import ROOT

DAY = datetime.date(2026, 11, 27)
TABLE = """
[kernels]
what = "kernels"
sources = ["native/*.h", "native/cuda", "python/one.py"]

[pages]
what = "pages"
command = ["make", "pages"]
needs = "photos"
sources = ["native/*"]
"""
FILES = {
    "native/a.h": "int a;",
    "native/b.cpp": "int b;",
    "native/cuda/deep/c.cu": "int c;",
    "python/one.py": "A = 1\n",
    "tests/slow/kernels/test_a.py": "def test_a(): pass\n",
    "constraints.txt": "torch==2.13.0\n",
    "elsewhere.py": "B = 1\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    for name, text in {**FILES, str(groups.TABLE): TABLE}.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def digest(tree: Path, name: str = "kernels") -> str:
    return next(group for group in groups.groups(tree) if group.name == name).digest(tree)


@pytest.mark.parametrize(
    ("file", "text", "counts"),
    [
        ("native/a.h", "int other;", True),
        ("native/a.h", "int a;  // a comment", False),
        ("native/b.cpp", "int other;", False),
        ("native/cuda/deep/c.cu", "int other;", True),
        ("native/cuda/new.cu", "int new_one;", True),
        ("python/one.py", '"""A docstring."""\nA = 1\n', False),
        ("python/one.py", "A = 2\n", True),
        ("tests/slow/kernels/test_a.py", "def test_a(): raise ValueError\n", True),
        ("constraints.txt", "torch==2.14.0\n", True),
        ("elsewhere.py", "B = 2\n", False),
    ],
)
def test_only_a_groups_own_sources_tests_and_dependencies_count(tree: Path, file: str, text: str, counts: bool) -> None:
    before = digest(tree)
    (tree / file).write_text(text)
    assert (digest(tree) != before) == counts


def test_a_pass_is_recorded_and_counts_until_the_sources_change(tree: Path) -> None:
    kernels, pages = groups.groups(tree)
    assert groups.passes(tree) == {} and suite.why_left_out(kernels, tree, DAY) == ""
    groups.record_pass(pages, pages.digest(tree), DAY, tree)
    groups.record_pass(kernels, kernels.digest(tree), DAY, tree)
    assert list(groups.passes(tree)) == ["kernels", "pages"]
    assert suite.why_left_out(kernels, tree, DAY) == "its sources are those of its last pass on 2026-11-27"
    (tree / "native/a.h").write_text("int other;")
    assert suite.why_left_out(kernels, tree, DAY) == ""


def test_an_old_pass_is_mentioned_and_still_counts(tree: Path) -> None:
    kernels, _ = groups.groups(tree)
    groups.record_pass(kernels, kernels.digest(tree), DAY, tree)
    later = DAY + datetime.timedelta(days=groups.OLD_DAYS + 1)
    assert "61 days ago" in suite.why_left_out(kernels, tree, later)


def test_a_group_whose_material_is_missing_cannot_run(tree: Path) -> None:
    _, pages = groups.groups(tree)
    assert not suite.can_run(pages, tree)
    (tree / "photos").mkdir()
    assert suite.can_run(pages, tree)


def test_a_source_that_does_not_exist_is_an_error(tree: Path) -> None:
    (tree / "python/one.py").unlink()
    with pytest.raises(AssertionError, match="kernels names python/one"):
        digest(tree)


def test_every_folder_of_slow_tests_is_a_group_and_every_group_has_sources() -> None:
    found = groups.groups(ROOT)
    folders = {path.name for path in (ROOT / "tests/slow").iterdir() if list(path.glob("test_*.py"))}
    assert folders <= {group.name for group in found}
    for group in found:
        assert len(group.digest(ROOT)) == 64
        assert group.command or group.name in folders
