"""Files are written in one way: a link or a pipe that somebody left in a received OUT does no harm."""

from __future__ import annotations

import ast
import os
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from repository import ROOT

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.events import Event, EventLog
from splatpipe.pipeline.engine.files.durable import copy_durably, remove_unfinished, write_durably
from splatpipe.pipeline.engine.files.output_file import (
    appended_file,
    is_inside,
    new_file,
    open_own,
    own_folder,
    write_file,
)

MINE = "alias ll='ls -l'\n"

# What these modules write otherwise, and why it cannot go through a link.
ALLOWED = {
    "pipeline/engine/files/output_file.py": "this is the one way",
    "pipeline/engine/files/small_file.py": "only reads",
    "pipeline/engine/files/durable.py": "flushes folders; copies into a file that it has just made",
    "pipeline/engine/runs/peak_memory.py": "the kernel's file of its own process",
    "pipeline/engine/runs/worker.py": "the kernel's file of its own process",
    "pipeline/app/serving/files.py": "only reads",
    "pipeline/film/video.py": "OpenCV writes a file that has just been made; the null device",
    "pipeline/surface/facades/elevation_files.py": "GDAL and Pillow, in the new folder of whole_file",
    "pipeline/surface/drawings/drawing_picture.py": "matplotlib, in the new folder of whole_file",
    "pipeline/surface/rasters/geotiff.py": "GDAL, in the new folder of whole_file",
    "pipeline/surface/levels/mbtiles.py": "SQLite, in the new folder of whole_file",
    # In a stage's working folder, which is new, or in which open_store found no link:
    "pipeline/surface/levels/mesh_texture.py": "decoded pages, in a new temporary folder",
    "pipeline/sfm/mapping/completion.py": "COLMAP's database",
    "pipeline/sfm/matching/keypoints.py": "COLMAP's database",
    "pipeline/photos/colmap/colmap_text.py": "a copy of a model's text, in a new temporary folder",
    "pipeline/sfm/recovery/ladder_keypoints.py": "COLMAP's database, in a new temporary folder",
    "pipeline/sfm/recovery/ladder_pairs.py": "COLMAP's database, in a new temporary folder",
    "pipeline/sfm/pairing/layout.py": "COLMAP's database",
    "pipeline/sfm/mapping/mapping.py": "COLMAP's database",
    "pipeline/sfm/matching/matching.py": "COLMAP's database",
    "pipeline/sfm/matching/matching_process.py": "COLMAP's database",
    "pipeline/sfm/matching/reduction.py": "COLMAP's database",
    "pipeline/sfm/model/view_graph.py": "COLMAP's database",
    "stages/features.py": "COLMAP's database",
    "pipeline/surface/levels/point_octree.py": "points added to piles, in a folder that has just been made",
    "stages/clean.py": "a copy of the trained model; photos in a new temporary folder",
    "pipeline/train/blocks/assembly.py": "copies of the coarse pass's files",
    "pipeline/survey/placing/model.py": "copies of the model's files",
    "pipeline/delivery/trainer_dataset.py": "copies of the dataset's files",
    "pipeline/train/state/checkpoint.py": "a member of an archive that is open",
    # In a node's own folder, below names that it has made itself:
    "pipeline/app/node/tasks/jobs.py": "hard links and copies of uploads and artifacts, in new folders",
    "pipeline/app/node/tasks/uploads.py": "hard links of equal uploads, under unpredictable names",
    "pipeline/app/node/page/gate.py": "the page's secret, as a new file for this user only",
    "pipeline/app/node/assets/rasters.py": "GDAL, in the new folder of whole_file",
    "pipeline/app/node/assets/archive.py": "an entry of an archive that is open",
    # Never installed:
    "pipeline/web/build.py": "builds the wheel",
    "pipeline/native/sbom.py": "builds the wheel",
}
WRITERS = {"write_text", "write_bytes", "touch", "symlink_to", "hardlink_to", "tofile"}
OF_MODULES = {
    ("os", "open"),
    ("os", "link"),
    ("os", "symlink"),
    ("os", "mkfifo"),
    ("shutil", "copy"),
    ("shutil", "copy2"),
    ("shutil", "copyfile"),
    ("shutil", "copytree"),
    ("shutil", "move"),
    ("cv2", "VideoWriter"),
    ("cv2", "imwrite"),
    ("sqlite3", "connect"),
    ("Database", "open"),
}


def writes(source: str) -> Iterator[str]:
    """Calls in a module's source that open a file for writing by its path, or may."""
    for call in ast.walk(ast.parse(source)):
        if not isinstance(call, ast.Call):
            continue
        function = call.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        owner = ast.unparse(function.value).split(".")[-1] if isinstance(function, ast.Attribute) else ""
        modes = [ast.literal_eval(each) for each in _arguments(call) if isinstance(each, ast.Constant)]
        opened = name == "open" and any(_is_writing(mode) for mode in modes)
        saved = name in ("save", "savez", "savez_compressed", "savefig") and any(map(_is_path, call.args[:1]))
        if name in WRITERS or (owner, name) in OF_MODULES or opened or saved:
            yield ast.unparse(call)


def _arguments(call: ast.Call) -> list[ast.expr]:
    return [*call.args, *(each.value for each in call.keywords if each.arg == "mode")]


def _is_writing(mode: object) -> bool:
    return (
        isinstance(mode, str) and 0 < len(mode) <= 3 and set(mode) <= set("rwaxbt+") and bool(set(mode) & set("wax+"))
    )


def _is_path(argument: ast.expr) -> bool:
    """Whether it is a path by its form, ``folder / name``, or by its name."""
    return isinstance(argument, ast.BinOp) or ast.unparse(argument) in ("path", "aside", "target", "out")


def test_nothing_else_writes_files() -> None:
    sources = [*(ROOT / "pipeline").rglob("*.py"), *(ROOT / "stages").glob("*.py")]
    found = {path.relative_to(ROOT).as_posix(): list(writes(path.read_text(encoding="utf-8"))) for path in sources}
    assert {name: calls for name, calls in found.items() if calls and name not in ALLOWED} == {}, (
        "use engine.files.output_file or engine.files.durable"
    )
    assert [name for name in ALLOWED if not found[name]] == [], "these need no exception"


@pytest.mark.parametrize(
    "line",
    [
        'path.open("w")',
        'path.open(mode="ab")',
        'open(path, "xb")',
        'io.open(path, "r+")',
        "os.open(path, flags)",
        "path.write_text(text)",
        "(out / name).write_bytes(data)",
        "shutil.copyfile(a, b)",
        "sqlite3.connect(path)",
        'np.save(out / "a.npy", array)',
        "image.save(path)",
    ],
)
def test_the_guard_sees_it(line: str) -> None:
    assert list(writes(line)) == [line.replace('"', "'")]


@pytest.mark.parametrize("line", ['path.open("rb")', "path.open()", "image.save(buffer)", "np.savez(file, a=a)"])
def test_the_guard_passes_it(line: str) -> None:
    assert list(writes(line)) == []


def place_link(path: Path, victim: Path) -> None:
    path.symlink_to(victim)


def place_pipe(path: Path, victim: Path) -> None:
    os.mkfifo(path)


def place_socket(path: Path, victim: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


def place_device(path: Path, victim: Path) -> None:
    path.symlink_to("/dev/full")


PLACED = [place_link, place_pipe, place_socket, place_device]


@pytest.fixture
def victim(tmp_path: Path) -> Path:
    path = tmp_path / "bashrc"
    path.write_text(MINE)
    return path


@pytest.mark.parametrize("place", PLACED)
def test_what_is_appended_to_must_be_a_file_of_its_own(
    tmp_path: Path, victim: Path, place: Callable[[Path, Path], None]
) -> None:
    path = tmp_path / "events.jsonl"
    place(path, victim)
    with pytest.raises(UsageError, match=r"events\.jsonl is a (link|named pipe|socket), which splatpipe"):
        appended_file(path)
    with pytest.raises(UsageError, match="events"):
        EventLog(path)
    assert victim.read_text() == MINE


@pytest.mark.parametrize("place", PLACED)
def test_what_is_written_anew_replaces_it(tmp_path: Path, victim: Path, place: Callable[[Path, Path], None]) -> None:
    for write in (write_file, write_durably):
        path = tmp_path / write.__name__
        place(path, victim)
        write(path, "new")
        assert path.read_text() == "new" and not path.is_symlink()
    assert victim.read_text() == MINE


def test_appended_lines_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    for message in ("a", "b"):
        log = EventLog(path)
        log(Event("note", data={"message": message}))
        log.close()
    with appended_file(path) as file:
        file.write(b"c\n")
    assert path.read_text().count("\n") == 3


def test_temporary_names_cannot_be_foreseen_and_are_never_reused(tmp_path: Path, victim: Path) -> None:
    (tmp_path / f".config.toml.{os.getpid()}.new").symlink_to(victim)  # the name of versions up to 0.2
    names = []

    def fill(file: object) -> None:
        names.extend(path.name for path in tmp_path.glob(".config.toml.*.*.new"))

    for _ in range(2):
        write_durably(tmp_path / "config.toml", fill)
    assert victim.read_text() == MINE and len(set(names)) == 2
    remove_unfinished(tmp_path, "config.toml")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bashrc", "config.toml"]


def test_leftovers_of_one_process_are_removed_and_those_of_others_kept(tmp_path: Path) -> None:
    left, other = (tmp_path / f".report.html.{process}.0123456789abcdef.new" for process in (12, 123))
    for path in (left, other):
        path.write_text("half")
    (tmp_path / ".scene.7.0123456789abcdef.new").mkdir()
    remove_unfinished(tmp_path, "report.html", 12)
    assert not left.exists() and other.exists()
    remove_unfinished(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_link_is_not_copied(tmp_path: Path, victim: Path) -> None:
    (tmp_path / "notes.txt").symlink_to(victim)
    with pytest.raises(OSError, match="it is a link, not a file"):
        copy_durably(tmp_path / "notes.txt", tmp_path / "copy")
    assert not (tmp_path / "copy").exists()


def test_folders_below_an_out_are_its_own_but_the_out_may_be_a_link(tmp_path: Path) -> None:
    real, elsewhere = tmp_path / "real", tmp_path / "elsewhere"
    real.mkdir()
    elsewhere.mkdir()
    out = tmp_path / "out"
    out.symlink_to(real)
    assert own_folder(out, "viewer", "tiles") == out / "viewer/tiles" and (real / "viewer/tiles").is_dir()
    (real / "films").symlink_to(elsewhere)
    for name in ("films", "films/new"):
        with pytest.raises(UsageError, match="out/films is a link"):
            own_folder(out, name)
    assert list(elsewhere.iterdir()) == []
    assert is_inside(out, Path("viewer/index.html")) and not is_inside(out, Path("films/a.webm"))


def test_a_new_file_has_the_usual_permissions(tmp_path: Path) -> None:
    (tmp_path / "plain").write_text("")
    with new_file(tmp_path / "new"):
        pass
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_a_file_that_has_a_second_name_elsewhere_is_copied_before_it_is_changed(tmp_path: Path) -> None:
    mine, log = tmp_path / "mine", tmp_path / "out.log"
    mine.write_bytes(b"mine\n")
    mine.chmod(0o600)
    os.link(mine, log)
    with appended_file(log) as file:
        file.write(b"ours\n")
    assert (mine.read_bytes(), log.read_bytes()) == (b"mine\n", b"mine\nours\n")
    assert mine.stat().st_nlink == 1 and log.stat().st_mode & 0o777 == 0o600
    log.unlink()
    os.link(mine, log)
    descriptor = open_own(log, os.O_RDWR)
    os.ftruncate(descriptor, 0)
    os.close(descriptor)
    assert (mine.read_bytes(), log.read_bytes()) == (b"mine\n", b"")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine", "out.log"]


@pytest.mark.parametrize("inner", ["", "below/out"])
def test_an_out_that_is_a_link_to_nothing_is_named(tmp_path: Path, inner: str) -> None:
    (tmp_path / "out").symlink_to(tmp_path / "nothing")
    with pytest.raises(UsageError, match=r"out is a link to .*nothing, which does not exist\.") as caught:
        own_folder(tmp_path / "out" / inner, "stages")
    assert caught.value.hint == "Make that folder, or remove the link."
    (tmp_path / "nothing").mkdir()
    assert own_folder(tmp_path / "out" / inner, "stages").is_dir()
