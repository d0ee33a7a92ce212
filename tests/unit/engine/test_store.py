"""An OUT that somebody else has made: only what its manifests list is an artifact, and only in it."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.engine.runs.run_folder import RunFolder
from splatpipe.pipeline.engine.runs.store import Artifact, StageInputs, Store, open_store
from splatpipe.pipeline.engine.stage import Stage, StageConfig

SECRET = "key " * 10
STAGE = Stage(
    name="export",
    version=1,
    config=StageConfig,
    reads=(),
    parts={"splat": "splat.ply", "viewer": "viewer"},
    entry="",
    resumable=True,
    deliverables=("splat", "viewer"),
)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret/index.html").write_text(SECRET)
    return tmp_path / "out"


def finished(out: Path) -> tuple[Store, Artifact]:
    """A store with one artifact."""
    store = open_store(out, create=True)
    inputs = StageInputs("export", 1, {}, {}, {})
    folder = store.begin(STAGE, inputs.key)
    (folder / "viewer/pages").mkdir(parents=True)
    (folder / "splat.ply").write_text("ply")
    (folder / "viewer/index.html").write_text(SECRET.upper())
    (folder / "viewer/pages/one.html").write_text("one")
    return store, store.commit(STAGE, inputs, folder, {}, {})


def test_what_the_manifest_does_not_list_is_not_delivered(out: Path) -> None:
    store, artifact = finished(out)
    (artifact.folder / "viewer/notes.txt").symlink_to(out.parent / "secret/index.html")
    (artifact.folder / "viewer/copy.txt").write_text(SECRET)
    os.mkfifo(artifact.folder / "viewer/pipe")
    store.deliver(artifact, STAGE)
    delivered = sorted(path.relative_to(out).as_posix() for path in out.rglob("*") if "stages" not in path.parts)
    assert delivered == ["index.html", "pages", "pages/one.html", "splat.ply"]


def replace_file(folder: Path, secret: Path) -> None:
    (folder / "viewer/index.html").unlink()
    (folder / "viewer/index.html").symlink_to(secret / "index.html")


def replace_part(folder: Path, secret: Path) -> None:
    for name in ("pages/one.html", "index.html"):
        (folder / "viewer" / name).rename(secret / Path(name).name)
    (secret / "pages").mkdir()
    (secret / "one.html").rename(secret / "pages/one.html")
    (folder / "viewer/pages").rmdir()
    (folder / "viewer").rmdir()
    (folder / "viewer").symlink_to(secret)


def replace_artifact(folder: Path, secret: Path) -> None:
    folder.rename(secret / "artifact")
    folder.symlink_to(secret / "artifact")


def lead_out(folder: Path, secret: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["parts"]["splat"] |= {"path": "../../../secret/index.html", "files": []}
    (folder / "manifest.json").write_text(json.dumps(manifest))


def list_outside(folder: Path, secret: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    entry = {"path": "viewer/../../../../secret/index.html", "size": len(SECRET), "sha256": ""}
    manifest["parts"]["viewer"]["files"].append(entry)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def list_elsewhere(folder: Path, secret: Path) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["parts"]["viewer"]["files"][0]["path"] = f"{secret}/index.html"
    (folder / "manifest.json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "tamper", [replace_file, replace_part, replace_artifact, lead_out, list_outside, list_elsewhere]
)
def test_an_artifact_that_leads_elsewhere_is_none(out: Path, tamper: Callable[[Path, Path], None]) -> None:
    store, artifact = finished(out)
    tamper(artifact.folder, out.parent / "secret")
    assert store.find(STAGE, artifact.key) is None and store.artifacts("export") == []


@pytest.mark.parametrize("name", ["index.html", "pages"])
def test_a_link_in_place_of_a_deliverable_is_never_written_through(out: Path, name: str) -> None:
    store, artifact = finished(out)
    secret = out.parent / "secret"
    if name == "pages":
        (out / name).symlink_to(secret)
        with pytest.raises(UsageError, match="out/pages is a link"):
            store.deliver(artifact, STAGE)
    else:
        (out / name).symlink_to(secret / name)
        store.deliver(artifact, STAGE)
        assert (out / name).read_text() == SECRET.upper() and not (out / name).is_symlink()
    assert [path.name for path in secret.iterdir()] == ["index.html"]
    assert (secret / "index.html").read_text() == SECRET


@pytest.mark.parametrize(
    "name",
    [
        "stages",
        "stages/.partial",
        "stages/.shards",
        "stages/.shards/train.1.log",
        "stages/.lock",
        "stages/photos-index.json",
        "stages/.partial/train-0123/history.json",
        "stages/.partial/sparse-0123/database.db",
        "stages/train-0123",
    ],
)
@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_links_and_pipes_among_our_own_files_are_refused_by_name(out: Path, name: str, kind: str) -> None:
    path = out / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.symlink_to(out.parent / "secret") if kind == "link" else os.mkfifo(path)
    with pytest.raises(UsageError, match=rf"{name} is a (link|named pipe)|out does not|damaged"):
        open_store(out, create=True)
    assert [each.name for each in (out.parent / "secret").iterdir()] == ["index.html"]


def test_the_out_itself_may_be_a_link(out: Path) -> None:
    (out.parent / "disk").mkdir()
    out.symlink_to(out.parent / "disk")
    store, artifact = finished(out)
    assert store.find(STAGE, artifact.key) is not None and (out.parent / "disk/stages").is_dir()


@pytest.mark.parametrize("name", ["finished_s", "key", "stage", "summary", "inputs"])
@pytest.mark.parametrize("value", [None, [1], "x"])
def test_a_manifest_that_lacks_something_is_of_no_artifact(out: Path, name: str, value: object) -> None:
    store, artifact = finished(out)
    path = artifact.folder / "manifest.json"
    manifest = json.loads(path.read_text())
    if (name, value) in [("key", "x"), ("stage", "x")]:
        value = 7
    path.write_text(json.dumps({**manifest, name: value}))
    assert store.artifacts("export") == []
    path.write_text(json.dumps({key: entry for key, entry in manifest.items() if key != name}))
    assert store.artifacts("export") == []


def test_working_folders_that_events_name_are_looked_for_in_their_folder_only(out: Path) -> None:
    store = open_store(out, create=True)
    for name in (".partial/export-k", ".partial/export-", ".partial/x", "elsewhere"):
        (store.stages / name).mkdir()
    (store.partials / "export-link").symlink_to(out.parent / "secret")
    run = RunFolder(out, [STAGE])
    assert run.contents(None, {"export": "k"}).working == {"export": store.partials / "export-k"}
    for key in ("/../x", "/../../elsewhere", "link"):
        assert run.contents(None, {"export": key}).working == {}


def test_folders_too_deep_are_refused_by_name(out: Path) -> None:
    store = open_store(out, create=True)
    store.partials.joinpath(*["d"] * 400).mkdir(parents=True)
    most = sys.getrecursionlimit()
    sys.setrecursionlimit(350)  # so that what is removed after the tests is not as deep as an attacker's
    try:
        with pytest.raises(UsageError, match=r"\.partial has folders a thousand deep"):
            open_store(out, create=True)
    finally:
        sys.setrecursionlimit(most)
