"""The captures of a batch: folders, and hand-written lists."""

from pathlib import Path

import pytest

from splatpipe.pipeline.app.batch.capture_list import MAX_CAPTURES, MAX_LIST_BYTES, read_captures
from splatpipe.pipeline.engine.errors import UsageError


def folders(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).mkdir(parents=True)
    return root


def test_each_folder_is_a_capture_except_hidden_ones_files_and_the_results(tmp_path: Path) -> None:
    folders(tmp_path, "b", "a", ".git", "out")
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "linked").symlink_to(tmp_path / "a")
    assert [capture.name for capture in read_captures(tmp_path, tmp_path / "out")] == ["a", "b", "linked"]


def test_a_capture_is_distinguished_from_a_folder_of_captures(tmp_path: Path) -> None:
    (tmp_path / "DJI_0001.JPG").write_bytes(b"")
    with pytest.raises(UsageError, match="photos of one capture") as caught:
        read_captures(tmp_path, tmp_path.parent / "out")
    assert "splatpipe run" in caught.value.hint


@pytest.mark.parametrize("out", ["captures/north/out", "captures/north"])
def test_results_are_never_placed_among_a_captures_photos(tmp_path: Path, out: str) -> None:
    folders(tmp_path / "captures", "north/out", "south")
    (tmp_path / "linked").symlink_to(tmp_path / "captures" / "north")
    (tmp_path / "a.toml").write_text("[[capture]]\nphotos = 'captures/south'\n[[capture]]\nphotos = 'linked'\n")
    for listed in (tmp_path / "a.toml", *([tmp_path / "captures"] if out.endswith("out") else [])):
        with pytest.raises(UsageError, match="inside the photos of the capture"):
            read_captures(listed, tmp_path / out)


TOML = """
preset = "preview"
set = ["train.iterations=900"]

[[capture]]
photos = "north"

[[capture]]
name = "south, again"
photos = "{south}"
preset = "high"
time_budget = "1h30m"
max_memory = "8G"
set = "train.iterations=5000"

[[capture]]
name = "surveyed"
photos = "north"
set = ["georef.control=points.txt"]

[[capture]]
name = "wrong"
photos = "north"
time_budget = "soon"
"""

CSV = """name;photos;preset;time_budget;train.iterations;georef.control
north;north;;;900;
south, again;{south};high;1h30m;5000;none
surveyed;north;preview;;;points.txt
wrong;north;;soon;;
"""


@pytest.mark.parametrize(("name", "text"), [("night.toml", TOML), ("night.CSV", CSV)])
def test_a_list_gives_each_capture_its_options_and_paths_from_its_own_folder(
    tmp_path: Path, name: str, text: str
) -> None:
    south = folders(tmp_path / "elsewhere", "south") / "south"
    listed = folders(tmp_path / "lists", "north") / name
    listed.write_text(text.format(south=south), encoding="utf-8-sig")
    north, again, surveyed, wrong = read_captures(listed, tmp_path / "out")
    assert (north.name, north.photos) == ("north", listed.parent / "north")
    assert (again.name, again.photos, again.preset) == ("south, again", south, "high")
    merged = {section: values for table in again.tables for section, values in table.items()}
    assert merged["train"]["iterations"] == 5000
    assert {"train": {"time_budget_s": 5400.0}} in again.tables
    control = {section: values for table in surveyed.tables for section, values in table.items()}["georef"]["control"]
    assert Path(control) == listed.parent / "points.txt"
    assert wrong.trouble is not None and "soon" in wrong.trouble.message  # only this one fails, once it runs


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "[[capture]]\nphotos = 'x'\n[[capture]]\nphotos = 'y'\nname = 'X'\n", 'Two captures are called "X"'),
        ("a.toml", "[[capture]]\nphotos = 'x'\nname = '../x'\n", "cannot be used as the name"),
        ("a.toml", "[[capture]]\nphotos = 'x'\nname = '.batch'\n", "cannot be used as the name"),
        ("a.toml", "[[capture]]\nphotos = 'x'\nname = 'Batch.HTML'\n", "cannot be used as the name"),
        ("a.toml", "[[capture]]\nphotos = 'x'\nname = 'a\\u202eb'\n", "cannot be used as the name"),
        ("a.toml", f"[[capture]]\nphotos = 'x'\nname = '{'n' * 101}'\n", "cannot be used as the name"),
        ("a.toml", "[[capture]]\nname = 'x'\n", "has no photos"),
        ("a.toml", "[[capture]]\nphotos = 3\n", "photos is not a string"),
        ("a.toml", "[[capture]]\nphotos = 'x'\nset = {a = 1}\n", "set is not a list"),
        ("a.toml", "[[capture]]\nphotos = 'x'\npresets = 'high'\n", 'no "presets"'),
        ("a.toml", "capture = 'x'\n", "no tables"),
        ("a.toml", "", "contains no captures"),
        ("a.toml", "[[capture]\n", "not valid TOML"),
        ("a.toml", "a = " + "[" * 100_000, "not valid TOML"),
        ("a.toml", "#" * (MAX_LIST_BYTES + 1), "too large"),
        ("a.toml", f"a = {'1' * 5000}\n", "not valid TOML"),
        (
            "a.toml",
            "[[capture]]\nphotos = 'x'\n[[capture]]\nphotos = '~nobody-here/x'\n",
            "cannot be expanded to a path",
        ),
        ("a.toml", '[[capture]]\nphotos = "a\\u0000b"\n', "cannot be expanded to a path"),
        (
            "a.toml",
            "[[capture]]\nphotos = 'x'\nname = '\u00e9'\n[[capture]]\nphotos = 'y'\nname = 'e\u0301'\n",
            "Two captures",
        ),
        ("a.csv", "name,photo\nx,y\n", 'unknown column "photo"'),
        ("a.csv", "name,preset\nx,y\n", "no photos column"),
        ("a.csv", "photos,photos\nx,y\n", "a duplicate column"),
        ("a.csv", "photos,preset\nx,high,8G\n", "more cells"),
        ("a.csv", "photos,preset\n,high\n", "has no photos"),
        ("a.csv", 'photos,preset\n"x,high\n', "not valid CSV"),
        ("a.csv", "photos\n" + "\n".join(f"p{at}" for at in range(MAX_CAPTURES + 1)), "2,001 captures"),
        ("a.csv", "photos\n" + "x\n" * (MAX_CAPTURES + 200), "more than"),
        ("a.csv", "photos\nx\0y\n", "no plain text"),
        ("a.txt", "x\n", "neither a folder nor a list"),
    ],
)
def test_an_invalid_list_is_refused_in_one_sentence(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(UsageError, match=message) as caught:
        read_captures(tmp_path / name, tmp_path / "out")
    assert caught.value.hint and len(caught.value.message) < 400


def test_a_missing_list_and_a_binary_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="There is no"):
        read_captures(tmp_path / "none", tmp_path / "out")
    for name in ("a.toml", "a.csv"):
        (tmp_path / name).write_bytes(b"\xff\xfe\x00p\x80")
        with pytest.raises(UsageError, match=r"not UTF-8 text|not valid TOML"):
            read_captures(tmp_path / name, tmp_path / "out")


@pytest.mark.parametrize("column", ["config", "georef.control"])
@pytest.mark.parametrize("path", ["~nobody-here/x", "a\\u0000b"])
def test_an_impossible_path_fails_only_its_own_capture(tmp_path: Path, column: str, path: str) -> None:
    setting = f'config = "{path}"' if column == "config" else f'set = ["{column}={path}"]'
    (tmp_path / "a.toml").write_text(f'[[capture]]\nphotos = "x"\n{setting}\n[[capture]]\nphotos = "y"\n')
    wrong, right = read_captures(tmp_path / "a.toml", tmp_path / "out")
    assert (
        wrong.trouble is not None and "cannot be expanded to a path" in wrong.trouble.message and right.trouble is None
    )
