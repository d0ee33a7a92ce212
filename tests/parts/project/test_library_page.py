"""The examples of docs/library.md run as they stand."""

from __future__ import annotations

import ast
import contextlib
import io
import re
import runpy
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from finished_run import linked_copy
from repository import ROOT
from some_splats import some_gaussians

import splatpipe
from splatpipe.demo import capture_path
from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.engine.config import dump, merge, parse_set
from splatpipe.pipeline.survey.crs.world import open_world
from splatpipe.stages.options import LineConfig

PAGE = ROOT / "docs" / "library.md"
EXAMPLE = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(rb"^comment .*\n", re.MULTILINE)


def examples() -> dict[str, str]:
    """The examples by the titles of their sections."""
    sections = re.split(r"^## ", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {section.partition("\n")[0]: text for section in sections for text in EXAMPLE.findall(section)}


def names_used(text: str) -> Iterator[str]:
    """Yield the names of splatpipe that an example uses."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "splatpipe":
            yield node.attr


@pytest.fixture
def folder(demo_run: Path, demo_options: list[str], tmp_path: Path) -> Path:
    """A folder with what the examples name: a finished run, flights, a configuration, splats of other programs."""
    linked_copy(demo_run, tmp_path / "out" / "house")
    (tmp_path / "flights" / "empty").mkdir(parents=True)
    (tmp_path / "flights" / "house").symlink_to(capture_path())
    options = merge(parse_set(text, LineConfig) for text in demo_options if text != "--set")
    (tmp_path / "survey.toml").write_text(dump(options))
    write_foreign(tmp_path / "other.ply", in_grid(splatpipe.read_splat(demo_run / "splat.ply")))
    arrays = {name: tensor.numpy() for name, tensor in some_gaussians().tensors().items()}
    write_foreign(tmp_path / "model.ply", splatpipe.Splat(**arrays))
    return tmp_path


def in_grid(splat: splatpipe.Splat) -> splatpipe.Splat:
    """A georeferenced splat in the projected coordinates of its CRS, as other programs have it."""
    assert splat.place is not None
    grid = open_world(frame_of(splat.place)).crs_from_local(splat.means.astype(np.float64))
    x, y, z = grid.mean(axis=0).round().tolist()
    return replace(splat, means=grid - [x, y, z], origin=(x, y, z), place=None, metres=False)


def write_foreign(path: Path, splat: splatpipe.Splat) -> None:
    """Write a PLY without our record in its header."""
    splatpipe.write_splat(path, splat)
    head, end, body = path.read_bytes().partition(b"end_header\n")
    path.write_bytes(COMMENT.sub(b"", head) + end + body)


def run_example(title: str, folder: Path) -> str:
    """Run an example as a script, in this process; return what it printed."""
    (folder / "example.py").write_text(examples()[title], encoding="utf-8")
    printed, warned = io.StringIO(), io.StringIO()
    with contextlib.chdir(folder), contextlib.redirect_stdout(printed), contextlib.redirect_stderr(warned):
        runpy.run_path("example.py", run_name="__main__")
    assert warned.getvalue() == ""
    return printed.getvalue()


def run_script(title: str, folder: Path) -> str:
    """Run an example in a process of its own; return what it printed."""
    (folder / "example.py").write_text(examples()[title], encoding="utf-8")
    done = subprocess.run([sys.executable, "example.py"], cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def test_the_page_has_six_examples_with_public_names_only() -> None:
    assert len(examples()) == 6
    used = {name for text in examples().values() for name in names_used(text)}
    assert used <= set(splatpipe.__all__)


def test_a_toy_scene_is_trained(folder: Path) -> None:
    losses = [float(line.split()[1]) for line in run_example("Train a toy scene", folder).splitlines()]
    assert len(losses) == 5 and losses[-1] < 0.5 * losses[0]


def test_a_finished_run_is_rendered_from_a_new_view(folder: Path) -> None:
    printed = run_example("Render a finished run from a new view", folder)
    assert re.fullmatch(r"2\d\.\d dB, \d+\.\d m away\n", printed)
    assert (folder / "view.png").stat().st_size > 50_000


def test_a_batch_shows_its_progress_and_survives_a_bad_capture(folder: Path) -> None:
    printed = run_script("A batch with a progress callback", folder)
    assert re.search(r"^empty: \S.*\.$", printed, re.MULTILINE)
    assert f"house: 40 of 40 photos, {folder.resolve()}/out/house/report.html\n" in printed


def test_another_programs_splat_becomes_tiles_at_its_place(folder: Path, demo_run: Path) -> None:
    printed = run_example("Another program's splat to 3D Tiles with a CRS", folder)
    place = splatpipe.read_splat(demo_run / "splat.ply").place
    assert place is not None
    found = re.search(r"SplatOrigin\(latitude=([\d.]+), longitude=([\d.]+)", printed)
    assert found is not None
    assert (float(found[1]), float(found[2])) == pytest.approx((place.latitude, place.longitude), abs=0.001)
    assert "vertical datum is not known" in printed
    assert (folder / "tiles" / "tileset.json").is_file()


def test_a_model_is_georeferenced_by_three_points(folder: Path) -> None:
    printed = run_example("Georeference a model by three points", folder)
    assert printed.startswith("scale ") and "standard deviations in its middle: [[" in printed
    placed = splatpipe.read_splat(folder / "georeferenced.ply")
    assert placed.crs == "EPSG:32633" and placed.metres and placed.axes == "z up"


def test_a_notebooks_cell_shows_a_render(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cell = ast.parse(examples()["In a notebook"])
    last = cell.body.pop()
    assert isinstance(last, ast.Expr)
    monkeypatch.chdir(folder)
    names: dict[str, Any] = {}
    exec(compile(cell, "cell", "exec"), names)
    shown = eval(compile(ast.Expression(last.value), "cell", "eval"), names)
    assert shown._repr_png_().startswith(b"\x89PNG")
