"""`splatpipe export` and `splatpipe convert`: finished runs and files in more formats."""

import json
from pathlib import Path
from typing import Any

import command
import laspy
import numpy as np
import pytest
from some_splats import some_gaussians

from splatpipe.pipeline.app.formats import check_possible, with_formats
from splatpipe.pipeline.engine.errors import SplatpipeError, UsageError
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import Scene, SceneFacts


def splatpipe(*arguments: str) -> tuple[int, dict[str, Any]]:
    done = command.splatpipe(*arguments, "--json")
    return done.returncode, json.loads(done.stdout)


@pytest.mark.usefixtures("plain_reports")
def test_a_finished_run_is_exported_in_more_formats_and_keeps_earlier_ones(demo_copy: Path) -> None:
    out = demo_copy
    before = (out / "splat.ply").read_bytes()
    code, output = splatpipe("export", str(out), "--format", "laz,model")
    assert code == 0
    assert [stage["name"] for stage in output["stages"] if stage["state"] != "reused"] == ["export"]
    assert (out / "splat.ply").read_bytes() == before
    place = read_scene(out / "splat.ply").facts.place
    assert place is not None and place.crs == "EPSG:32633"
    assert read_scene(out / "export/model").facts.place == place
    crs = json.loads((out / "georef.json").read_text())["origin"]["in_crs"]
    centres = laspy.read(out / "export/centres.laz")
    assert abs(float(np.mean(centres.x)) - crs[0]) < 200.0 and abs(float(np.mean(centres.y)) - crs[1]) < 200.0
    code, output = splatpipe("export", str(out), "-f", "colmap")
    assert code == 0
    assert (out / "export/dataset/sparse/0/images.bin").is_file() and (out / "export/model").is_dir()


def test_unknown_or_impossible_formats_are_reported_at_once(demo_copy: Path) -> None:
    out = demo_copy
    with pytest.raises(UsageError, match="no format 'obj'"):
        with_formats(out, "obj")
    with pytest.raises(UsageError, match="No format is given"):
        with_formats(out, " , ")
    check_possible(out, "laz,tiles")


def test_maps_of_a_finished_run_are_made_without_touching_the_rest(demo_copy: Path) -> None:
    out = demo_copy
    with pytest.raises(SplatpipeError, match=r"cloud\.laz") as refused:
        check_possible(out, "copc")
    assert "--products cloud" in refused.value.hint
    code, output = splatpipe("export", str(out), "--format", "mbtiles")
    assert code == 0
    assert [stage["name"] for stage in output["stages"] if stage["state"] != "reused"] == ["publish"]
    assert sorted(path.name for path in (out / "export").iterdir()) == ["dsm.mbtiles", "ortho.mbtiles"]
    assert with_formats(out, "spz") == {"export": {"formats": "spz"}, "publish": {"formats": "mbtiles"}}


def test_a_file_is_converted_and_the_result_is_reported(demo_run: Path, tmp_path: Path) -> None:
    code, output = splatpipe("convert", str(demo_run / "splat.ply"), str(tmp_path / "made.viewer.ply"))
    assert code == 0
    read = read_scene(tmp_path / "made.viewer.ply")
    assert output["convert"]["gaussians"] == len(read.gaussians)
    assert output["convert"]["bytes"] == (tmp_path / "made.viewer.ply").stat().st_size
    assert read.facts.axes == "y down" and read.facts.place == read_scene(demo_run / "splat.ply").facts.place


def test_far_coordinates_and_steps_are_printed(tmp_path: Path) -> None:
    facts = SceneFacts("z up", offset=(388714.0, 5299720.0, 515.0))
    plain_ply.write(tmp_path / "utm.ply", Scene(some_gaussians(1), facts))
    done = command.splatpipe("convert", str(tmp_path / "utm.ply"), str(tmp_path / "a.spz"))
    assert done.returncode == 0
    first, origin, steps = done.stderr.strip().splitlines()
    assert first.startswith("1 Gaussian, ") and first.endswith(f" B: {tmp_path / 'a.spz'}")
    assert origin.startswith("Origin 3887") and "recorded in the file" in origin
    assert steps.startswith("Positions in steps of 0.0002")


def test_a_splat_with_values_that_are_not_numbers_is_refused_with_the_command_that_drops_them(tmp_path: Path) -> None:
    plain_ply.write(tmp_path / "a.ply", Scene(some_gaussians(20)))
    data = bytearray((tmp_path / "a.ply").read_bytes())
    data[-4:] = np.float32("nan").tobytes()
    (tmp_path / "a.ply").write_bytes(data)
    code, output = splatpipe("convert", str(tmp_path / "a.ply"), str(tmp_path / "a.spz"))
    assert code == 1 and "1 of 20 Gaussians" in output["error"]["message"]
    assert f"splatpipe edit {tmp_path / 'a.ply'} cleaned.ply --clean" in output["error"]["hint"]


@pytest.mark.parametrize(
    ("source", "target", "code"), [("no.ply", "a.ply", 1), ("bad.ply", "a.ply", 1), ("bad.ply", "a.xyz", 2)]
)
def test_files_that_cannot_be_converted_are_reported(tmp_path: Path, source: str, target: str, code: int) -> None:
    (tmp_path / "bad.ply").write_bytes(b"ply\nnonsense\n")
    found, output = splatpipe("convert", str(tmp_path / source), str(tmp_path / target))
    assert found == code
    assert output["error"]["message"]
    assert not (tmp_path / target).exists()
