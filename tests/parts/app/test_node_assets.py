"""all.zip of the finished run: imported as WebODM does, the same bytes again, and what it lacks is named."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import NamedTuple

import pytest
import webodm_assets
from webodm_import import told

from splatpipe.pipeline.app.node.assets import collecting, packing
from splatpipe.pipeline.app.node.assets.packing import Packing, pack_run
from splatpipe.pipeline.app.node.assets.single import list_assets, open_asset
from splatpipe.pipeline.engine.errors import MachineError, StopSignal, UsageError
from splatpipe.pipeline.engine.runs.lock import locked

MODULE = "splatpipe.pipeline.app.node.assets"


class Packed(NamedTuple):
    """A packed run."""

    path: Path
    facts: Packing


@pytest.fixture(scope="module")
def packed(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Packed:
    folder = tmp_path_factory.mktemp("task")
    (folder / "log").write_text(f"first line\n{demo_run}/dsm.tif  2 MB\n/home/anna/x.jpg", encoding="utf-8")
    return Packed(folder / "all.zip", pack_run(demo_run, folder / "all.zip", (), folder / "log"))


def names(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def test_webodm_imports_it(packed: Packed, tmp_path: Path) -> None:
    checks = webodm_assets.import_archive(packed.path, tmp_path)
    assert len(checks) > 10 and all(check.met for check in checks), "\n".join(told(checks))


def test_it_has_what_the_run_made_and_names_the_rest(packed: Packed, demo_run: Path) -> None:
    there = names(packed.path)
    assert there == set(packed.facts.entries) and packed.facts.size == packed.path.stat().st_size
    assert {"splat.ply", "viewer.html", "report.html", "odm_report/report.pdf", "odm_dem/dsm.tif"} <= there
    assert not any(name.startswith("mesh/") for name in there)
    told_of = "\n".join(packed.facts.lines)
    assert "textured mesh" in told_of and str(demo_run.parent) not in told_of
    with zipfile.ZipFile(packed.path) as archive:
        log = archive.read("task_output.txt").decode()
        assert archive.read("splat.ply") == (demo_run / "splat.ply").read_bytes()
    assert log.splitlines() == ["first line", "OUT/dsm.tif  2 MB", "x.jpg", *packed.facts.lines]


def test_every_single_file_is_the_one_in_it(packed: Packed) -> None:
    listed = list_assets(packed.path.parent)
    assert {
        "all.zip",
        "orthophoto.tif",
        "orthophoto.png",
        "dsm.tif",
        "report.pdf",
        "shots.geojson",
        "cameras.json",
    } <= set(listed)
    with zipfile.ZipFile(packed.path) as archive:
        file = open_asset(packed.path.parent, "orthophoto.tif")
        assert file.size == listed["orthophoto.tif"]
        assert file.read(1000, 0) == archive.read("odm_orthophoto/odm_orthophoto.tif")[:1000]
        os.close(file.descriptor)


def test_the_same_run_gives_the_same_bytes(packed: Packed, demo_run: Path, tmp_path: Path) -> None:
    log = packed.path.parent / "log"
    done = subprocess.run(
        [sys.executable, "-m", MODULE, demo_run, tmp_path, "--log", log], capture_output=True, check=True
    )
    assert done.stdout.decode().splitlines() == list(packed.facts.lines)
    assert (tmp_path / "all.zip").read_bytes() == packed.path.read_bytes()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["all.zip"]


def test_outputs_replace_its_content(demo_run: Path, tmp_path: Path) -> None:
    facts = pack_run(demo_run, tmp_path / "all.zip", ("odm_dem", "report.html", "odm_dem/dtm.tiff"))
    tops = {name.partition("/")[0] for name in facts.entries}
    assert tops == {"odm_dem", "report.html"} and "odm_dem/dsm.tif" in facts.entries
    assert any("odm_dem/dtm.tiff, which outputs names" in line for line in facts.lines)
    facts = pack_run(demo_run, tmp_path / "all.zip", ("odm_report",))  # a lone folder would be unwrapped
    assert {name.partition("/")[0] for name in facts.entries} == {"odm_report", "task_output.txt"}


def test_a_run_that_is_running_is_refused(demo_copy: Path, tmp_path: Path) -> None:
    with locked(demo_copy), pytest.raises(UsageError, match="being worked in"):
        pack_run(demo_copy, tmp_path / "all.zip")


def test_a_stopped_packing_leaves_what_was_there(
    demo_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "all.zip").write_bytes(b"before")

    def stopped(*_: object) -> None:
        raise StopSignal(143)

    monkeypatch.setattr(packing, "write_archive", stopped)
    with pytest.raises(StopSignal):
        pack_run(demo_run, tmp_path / "all.zip", ("cameras.json",))
    assert [path.name for path in tmp_path.iterdir()] == ["all.zip"]
    assert (tmp_path / "all.zip").read_bytes() == b"before"


def test_a_full_disk_is_noticed_before_it_is_full(
    demo_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 1000))
    with pytest.raises(MachineError, match="do not fit"):
        pack_run(demo_run, tmp_path / "all.zip", ("cameras.json",))
    assert not list(tmp_path.iterdir())


def test_broken_and_foreign_files_are_left_out_and_named(demo_copy: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text("secret", encoding="utf-8")
    for name in ("viewer.html", "dsm.tif"):
        (demo_copy / name).unlink()
    (demo_copy / "viewer.html").symlink_to(secret)
    (demo_copy / "dsm.tif").write_bytes((demo_copy / "ortho.tif").read_bytes()[:3000])
    facts = pack_run(demo_copy, tmp_path / "all.zip", ("odm_dem", "viewer.html", "secret"))
    assert "viewer.html" not in facts.entries and "odm_dem/dsm.tif" not in facts.entries
    assert "all.zip lacks viewer: the one in OUT is a link." in facts.lines
    assert any(line.startswith("all.zip lacks surface model: it cannot be read") for line in facts.lines)


def test_a_call_that_is_wrong_says_so_without_paths(tmp_path: Path) -> None:
    def call(*words: object) -> tuple[int, str]:
        command = [sys.executable, "-m", MODULE, *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert not done.stderr
        return done.returncode, done.stdout

    code, said = call(tmp_path / "no", tmp_path / "assets")
    assert code == 2 and str(tmp_path) not in said and said.startswith("The results were not packed: ")
    code, said = call(tmp_path / "no", tmp_path / "assets", "--outputs", '["../../etc/passwd"]')
    assert code == 2 and "leads out" in said and not list((tmp_path / "assets").iterdir())


def test_a_run_without_a_place_has_no_maps_in_their_places(
    demo_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nowhere(*_: object, **__: object) -> None:
        raise collecting.UnplacedRaster("it has no place on the earth")

    monkeypatch.setattr(collecting, "check_raster", nowhere)
    facts = pack_run(demo_run, tmp_path / "all.zip", ("odm_orthophoto", "odm_dem/dsm.tif", "ortho.tif", "dsm.tif"))
    assert set(facts.entries) == {"ortho.tif", "dsm.tif"}
    assert "all.zip lacks orthophoto: it has no place on the earth; it is there as ortho.tif." in facts.lines
