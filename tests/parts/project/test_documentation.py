"""README and docs: links lead somewhere, commands and options are real, generated pages are what the code says."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import options_page
import pytest
import rooms_page
import typer
from command import splatpipe
from repository import ROOT
from some_splats import some_gaussians

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.batch.capture_list import read_captures
from splatpipe.pipeline.app.cli.main import app
from splatpipe.pipeline.engine.config import load_file, load_preset, option_names, parse_set, resolve
from splatpipe.pipeline.splat.containers.ply import write_splat
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

README = ROOT / "README.md"
INDEX = ROOT / "docs/README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [README, *DOCS]
LONGEST_README = 150  # lines: what a surveyor reads in an afternoon, with the run
LONGEST_GUIDE = 150  # lines
GENERATED = ("api.md", "options.md", "rooms.md", "stages.md")  # in part; reference may be longer
FIRST_SCREEN = 30  # lines
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
QUICK = (
    "options",
    "doctor",
    "convert",
    "status",
    "report",
)  # seconds each on a run that has hardly begun
SOURCES = (ROOT, ROOT / "pipeline", ROOT / "pipeline/raster")  # the folders that paths in the pages are relative to
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ENDINGS = (
    *("csv", "json", "tif", "glb", "obj", "mtl", "jpg", "ply", "webm", "py", "toml", "laz", "md", "mbtiles"),
    *("txt", "html", "geojson", "dxf"),
)


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def fences(page: Path, *languages: str) -> Iterator[str]:
    """The fenced blocks of a page in one of the languages."""
    for language, text in FENCE.findall(page.read_text(encoding="utf-8")):
        if language in languages:
            yield text


def prose(page: Path) -> str:
    """A page without its fenced blocks."""
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def command_lines(page: Path, program: str) -> Iterator[list[str]]:
    """The calls of a program in a page's fenced blocks, without the program's own name."""
    for text in fences(page, "sh", ""):
        for line in text.replace("\\\n", " ").splitlines():
            if line.startswith(f"{program} "):
                yield shlex.split(line, comments=True)[1:]


def anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)\s]+)\)", prose(page))


def linked_by(page: Path) -> set[Path]:
    return {(page.parent / link.partition("#")[0]).resolve() for link in links(page)}


def test_the_readme_takes_an_afternoon_and_leads_to_the_index() -> None:
    assert len(README.read_text(encoding="utf-8").splitlines()) <= LONGEST_README
    assert INDEX in linked_by(README)


def test_the_index_leads_to_every_page() -> None:
    assert set(DOCS) - {INDEX} <= linked_by(INDEX)


def test_guides_are_short() -> None:
    guides = [page for page in DOCS if page.parent == INDEX.parent and page.name not in GENERATED]
    long = {page.name: len(page.read_text(encoding="utf-8").splitlines()) for page in guides}
    assert {name: lines for name, lines in long.items() if lines > LONGEST_GUIDE} == {}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_somewhere(page: Path) -> None:
    for link in links(page):
        if "://" in link:
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.is_file(), link
        assert not anchor or anchor in anchors(target), link


@pytest.mark.parametrize("page", DOCS, ids=name_of)
def test_a_page_begins_with_the_essentials(page: Path) -> None:
    first = page.read_text(encoding="utf-8").splitlines()[:FIRST_SCREEN]
    assert first[0].startswith("# ")
    assert any(line.startswith(("```", "|---")) for line in first)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_is_valid(page: Path) -> None:
    for name, *arguments in command_lines(page, "splatpipe"):
        params = COMMANDS[name].make_context(name, list(arguments)).params
        assignments = params.get("assignments") or []
        preset = params.get("preset") or "standard"
        resolve(LineConfig, [load_preset(preset), *(parse_set(text, LineConfig) for text in assignments)])
        stages = [stage.name for stage in LINE]
        assert all(each in stages for each in (params.get("until"), params.get("name")) if each)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_command_in_running_text_has_the_stated_options(page: Path) -> None:
    for text in re.findall(r"`splatpipe ([^`]+)`", prose(page)):
        words = text.split()
        if not re.match(r"[a-z]", words[0]):  # an option of all commands, or no command
            continue
        known = {option for parameter in COMMANDS[words[0]].params for option in parameter.opts}
        known |= {option for parameter in COMMANDS[words[0]].params for option in parameter.secondary_opts}
        assert {word for word in words if re.match(r"-{1,2}[a-z]", word)} <= known | {"--help", "-h"}, text


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_make_target_and_program_exists(page: Path) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    inline = [text.split() for text in re.findall(r"`make ([^`]+)`", prose(page))]
    for words in [*command_lines(page, "make"), *inline]:
        assert {word for word in words if "=" not in word} <= targets, words
    named = [text.split() for text in re.findall(r"`python (benchmarks [a-z][^`]+)`", prose(page))]
    for program, *arguments in [*command_lines(page, "python"), *command_lines(page, "python3"), *named]:
        if program == "-m":
            continue
        path = ROOT / program
        folders = [path.parent]
        if program == "benchmarks":
            (path,) = path.glob(f"*/{arguments[0]}.py")
            folders = [path.parent, ROOT / "benchmarks" / "shared"]
        near = "".join(each.read_text(encoding="utf-8") for folder in folders for each in folder.glob("*.py"))
        assert "__main__" in path.read_text(encoding="utf-8"), program
        assert all(f'"{word}"' in near for word in arguments if word.startswith("--")), (program, arguments)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_option_and_source_file_that_is_named_exists(page: Path) -> None:
    known = set(option_names(LineConfig))
    sections = "|".join(LineConfig.model_fields)
    for name in re.findall(rf"`((?:{sections})\.[a-z_]+)(?:=[^`]*)?`", prose(page)):
        assert name in known or name.rpartition(".")[2] in ENDINGS, name
    for path in re.findall(r"`((?:[\w-]+/)+[\w.-]+\.(?:py|md|sh|yaml|toml|h|cpp))`", prose(page)):
        assert any((folder / path).is_file() for folder in SOURCES), path


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_configuration_is_valid(page: Path, tmp_path: Path) -> None:
    for text in fences(page, "toml"):
        file = tmp_path / "example.toml"
        file.write_text(text, encoding="utf-8")
        if "[[capture]]" not in text:
            resolve(LineConfig, [load_file(file)])
            continue
        (tmp_path / "house.toml").write_text("[train]\nsh_degree = 2\n", encoding="utf-8")
        captures = read_captures(file, tmp_path / "out")
        assert captures
        assert [capture.trouble for capture in captures] == [None] * len(captures)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_example_in_python_compiles(page: Path) -> None:
    for text in fences(page, "python"):
        compile(text, page.name, "exec")


def test_the_page_of_options_matches_the_code() -> None:
    assert options_page.PAGE.read_text(encoding="utf-8") == options_page.written(), "run: make options-page"


def test_the_table_of_a_nodes_options_matches_the_code() -> None:
    assert options_page.NODE_PAGE.read_text(encoding="utf-8") == options_page.node_page(), "run: make options-page"


def test_the_page_of_options_has_types_limits_and_presets() -> None:
    rows = {
        row.split(" | ")[0].strip("| `"): row for row in options_page.tables().splitlines() if row.startswith("| `")
    }
    assert set(rows) == {name for name in option_names(LineConfig) if "." in name}
    assert "| `auto` or whole number, at least 1 | `auto` |" in rows["train.iterations"]
    assert "| `sift` | demo `opencv-sift`; preview `opencv-sift` |" in rows["features.extractor"]
    assert "| `true`, `false` | `false` |" in rows["export.sky"]
    assert "| number, at least 0, below 1 | `0` |" in rows["train.stop_when_flat"]


def test_the_stages_of_the_line_are_described() -> None:
    page = (ROOT / "docs/stages.md").read_text(encoding="utf-8")
    rows = [name.strip() for row in re.findall(r"^\| ([a-z_, ]+) \|", page, re.MULTILINE) for name in row.split(",")]
    assert [name for name in rows if name != "stage"] == [stage.name for stage in LINE]


def test_the_pages_of_rooms_and_stages_match_the_code() -> None:
    for page, text in rooms_page.pages().items():
        assert page.read_text(encoding="utf-8") == text, f"{page.name}: run make rooms-page"


def test_a_graph_leaves_out_arrows_that_a_longer_way_replaces() -> None:
    edges = {"app": {"train", "engine"}, "train": {"engine"}, "engine": set[str]()}
    assert rooms_page.reduced(edges) == {"app": {"train"}, "train": {"engine"}, "engine": set()}
    with pytest.raises(ValueError, match="a circle: app imports train imports app"):
        rooms_page.reduced({"app": {"train"}, "train": {"app"}})


def test_rooms_within_a_room_are_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    app = f"{rooms_page.ROOMS}.app"
    members = [f"{app}.{name}" for name in ("cli", "preflight", "report")]
    monkeypatch.setattr(rooms_page, "containers", lambda: {app: members})
    part = rooms_page.inner_rooms_part()
    assert part.startswith("### app\n")
    assert "preflight_ --> report_" in part
    assert "| `report` |" in part
    assert "`renders`" in part.partition("Beside them: ")[2]


def test_the_quick_commands_of_the_pages_run(tmp_path: Path) -> None:
    assert splatpipe("run", capture_path(), "OUT", "--until", "control", cwd=tmp_path).returncode == 0
    write_splat(tmp_path / "splat.ply", some_gaussians())
    calls = [call for page in PAGES for call in command_lines(page, "splatpipe") if call[0] in QUICK]
    fullest = {call[0]: call for call in sorted(calls, key=len)}
    assert set(fullest) == set(QUICK)
    for call in fullest.values():
        done = splatpipe(*call, cwd=tmp_path)
        assert done.returncode == 0, (call, done.stderr)
