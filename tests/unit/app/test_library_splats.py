"""Splats as arrays: files keep their bits, place and origin; coordinates in a CRS become a place on the earth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from some_splats import some_gaussians

import splatpipe
from splatpipe.pipeline.app.library.splats import ARRAYS, Splat
from splatpipe.pipeline.delivery.delivery_frame import frame_of
from splatpipe.pipeline.splat.formats.catalogue import SPLAT_FORMATS
from splatpipe.pipeline.splat.formats.files import read_scene
from splatpipe.pipeline.splat.model.scene import SplatOrigin
from splatpipe.pipeline.survey.crs.world import open_world

PLACE = SplatOrigin(47.84, 13.51, 515.0, "ellipsoidal", "EPSG:32633")


def some_splat(count: int = 40) -> Splat:
    """A splat of small Gaussians within some metres of its origin, at a place on the earth."""
    arrays = {name: tensor.numpy() for name, tensor in some_gaussians(count).tensors().items()}
    return Splat(**arrays, place=PLACE, metres=True)


def same_arrays(one: Splat, other: Splat) -> bool:
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in ARRAYS)


def test_a_ply_keeps_every_bit_and_the_place(tmp_path: Path) -> None:
    splat = replace(some_splat(), antialias=True)
    assert splatpipe.write_splat(tmp_path / "splat.ply", splat) == ()
    back = splatpipe.read_splat(str(tmp_path / "splat.ply"))
    assert same_arrays(splat, back)
    assert (back.place, back.crs, back.axes, back.metres, back.antialias) == (PLACE, "EPSG:32633", "z up", True, True)
    assert read_scene(tmp_path / "splat.ply").facts.place == PLACE


@pytest.mark.parametrize("kind", SPLAT_FORMATS, ids=lambda kind: kind.name)
def test_every_format_is_written_by_its_suffix_or_name_and_read_back(tmp_path: Path, kind: object) -> None:
    splat = some_splat()
    name, file = kind.name, kind.file  # type: ignore[attr-defined]
    splatpipe.write_splat(tmp_path / file, splat, format=name if name in ("spz2", "model") else None)
    back = splatpipe.read_splat(tmp_path / file).turned("z up")
    assert len(back) == len(splat)
    # Some formats sort. The coarsest, compressed PLY, has 11 bits for the extent of 120 m.
    assert np.abs(np.sort(back.means, axis=0) - np.sort(splat.means, axis=0)).max() < 120.0 / 2**11


def test_far_coordinates_keep_their_accuracy(tmp_path: Path) -> None:
    splat = replace(some_splat(), place=None, origin=(388_720.25, 5_299_720.0, 510.0))
    splatpipe.write_splat(tmp_path / "far.ply", splat)
    back = splatpipe.read_splat(tmp_path / "far.ply")
    there = back.means.astype(np.float64) + back.origin
    assert np.abs(there - (splat.means.astype(np.float64) + splat.origin)).max() < 1e-5
    assert back.place is None and back.crs == ""


def test_coordinates_in_a_crs_become_a_place_on_the_earth() -> None:
    splat = some_splat()
    world = open_world(frame_of(PLACE))
    grid = world.crs_from_local(splat.means.astype(np.float64))
    origin = np.rint(grid.mean(axis=0))
    theirs = replace(splat, means=grid - origin, place=None, metres=False, origin=tuple(origin))
    placed = theirs.georeferenced("EPSG:32633")
    assert placed.place is not None and placed.metres and placed.crs == "EPSG:32633"
    again = open_world(frame_of(placed.place)).crs_from_local(placed.means.astype(np.float64))
    assert np.abs(again - grid).max() < 1e-4
    scale = world.grid_scale()
    assert scale is not None
    grown = float(np.exp(placed.log_scales - splat.log_scales).mean())
    # A grid metre is 1.0003 m on the ground; vertical lengths are not scaled, and a Gaussian has a single scale.
    assert grown == pytest.approx(scale.ground ** (-2.0 / 3.0), abs=1e-5)
    turn = Rotation.from_quat(placed.quats[:, [1, 2, 3, 0]]) * Rotation.from_quat(splat.quats[:, [1, 2, 3, 0]]).inv()
    assert np.degrees(turn.as_rotvec()[:, 2]) == pytest.approx(-scale.convergence_deg, abs=0.01)


@pytest.mark.parametrize(
    ("crs", "message"),
    [("EPSG:4326", "has degrees"), ("EPSG:1", "There is no EPSG:1"), ("EPSG:25833", "outside the area"), ("", "form")],
)
def test_a_crs_that_cannot_be_is_refused(crs: str, message: str) -> None:
    far = replace(some_splat(), place=None, origin=(500_000.0, -4_000_000.0, 0.0))
    with pytest.raises(splatpipe.SplatpipeError, match=message) as caught:
        far.georeferenced(crs)
    assert caught.value.hint


def test_a_splat_with_a_place_is_not_placed_again() -> None:
    with pytest.raises(splatpipe.SplatpipeError, match="georeferenced already"):
        some_splat().georeferenced("EPSG:32633")


def test_a_similarity_moves_a_splat_far_away_and_back() -> None:
    splat = replace(some_splat(), place=None)
    rotation = Rotation.from_rotvec([0.1, -0.4, 2.0]).as_matrix()
    there = splatpipe.Similarity(3.0, rotation, np.array([412_345.5, 5_654_321.25, 120.0]))
    moved = splat.transformed(there)
    expected = there.apply(splat.means.astype(np.float64))
    assert np.abs(moved.means.astype(np.float64) + moved.origin - expected).max() < 2e-5
    assert np.abs(moved.scales / splat.scales - 3.0).max() < 1e-5
    back = moved.transformed(there.inverse())
    assert back.origin == (0.0, 0.0, 0.0)
    assert np.abs(back.means - splat.means).max() < 1e-4 and np.abs(back.sh - splat.sh).max() < 1e-5


def test_activated_values_are_stored_as_logarithms_and_logits() -> None:
    splat = some_splat()
    opacities = splat.opacities.copy()
    opacities[:2] = 0.0, 1.0
    made = Splat.of_activated(splat.means, splat.scales, splat.quats, opacities, splat.sh, place=PLACE)
    assert made.log_scales == pytest.approx(splat.log_scales, abs=1e-5)
    assert made.opacities == pytest.approx(opacities, abs=1e-6) and np.isfinite(made.opacity_logits).all()
    with pytest.raises(splatpipe.SplatpipeError, match="must be positive"):
        Splat.of_activated(splat.means, -splat.scales, splat.quats, opacities, splat.sh)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"means": np.zeros((3, 2))}, "shapes that do not fit"),
        ({"sh": np.zeros((40, 5, 3))}, "shapes that do not fit"),
        ({"means": np.full((40, 3), np.nan)}, "not finite"),
        ({"axes": "x up"}, "not valid"),
        ({"origin": (np.nan, 0.0, 0.0), "place": None}, "not valid"),
        ({"place": SplatOrigin(91.0, 0.0, 0.0)}, "not valid"),
    ],
)
def test_a_splat_that_is_none_is_refused(tmp_path: Path, change: dict[str, object], message: str) -> None:
    arrays = {name: getattr(some_splat(), name) for name in ARRAYS}
    broken = object.__new__(Splat)  # as without the tests' checks of shapes
    values = {"origin": (0.0, 0.0, 0.0), "place": PLACE, "axes": "z up", "metres": True, "antialias": False}
    for name, value in {**arrays, **values, "notes": (), "_edits": (), **change}.items():
        object.__setattr__(broken, name, value)
    with pytest.raises(splatpipe.SplatpipeError, match=message) as caught:
        Splat.__post_init__(broken)
        splatpipe.write_splat(tmp_path / "splat.ply", broken)
    assert caught.value.hint and not (tmp_path / "splat.ply").exists()


def test_tiles_need_a_place(tmp_path: Path) -> None:
    assert splatpipe.write_splat(tmp_path / "tiles", some_splat(), format="tiles") == ()
    assert (tmp_path / "tiles" / "tileset.json").is_file()
    assert splatpipe.write_splat(tmp_path / "lod", some_splat(), format="streamed-sog") == ()
    assert (tmp_path / "lod" / "lod-meta.json").is_file()
    with pytest.raises(splatpipe.SplatpipeError, match="georeferenced"):
        splatpipe.write_splat(tmp_path / "none", replace(some_splat(), place=None), format="tiles")
    assert not (tmp_path / "none").exists()


def test_files_that_are_no_splats_and_names_without_a_format_are_refused(tmp_path: Path) -> None:
    (tmp_path / "photo.ply").write_bytes(b"not a splat")
    for path in (tmp_path / "photo.ply", tmp_path / "missing.ply"):
        with pytest.raises(splatpipe.SplatpipeError) as caught:
            splatpipe.read_splat(path)
        assert caught.value.hint
    with pytest.raises(splatpipe.SplatpipeError, match="extension"):
        splatpipe.write_splat(tmp_path / "splat.obj", some_splat())


def test_axes_can_be_stated_where_a_file_does_not_say_them(tmp_path: Path) -> None:
    splatpipe.write_splat(tmp_path / "splat.ply", replace(some_splat(), place=None, metres=False, axes="y down"))
    assert splatpipe.read_splat(tmp_path / "splat.ply").axes == "y down"
    stated = splatpipe.read_splat(tmp_path / "splat.ply", axes="z up")
    assert stated.axes == "z up" and same_arrays(stated, some_splat())


@pytest.mark.parametrize("name", ["splat.ply", "splat.sog", "splat.spz", "splat.glb", "link.ply"])
def test_a_pipe_is_not_replaced(tmp_path: Path, name: str) -> None:
    pipe = tmp_path / ("pipe" if name == "link.ply" else name)
    os.mkfifo(pipe)
    if name == "link.ply":
        (tmp_path / name).symlink_to(pipe)
    with pytest.raises(splatpipe.SplatpipeError, match="is a named pipe, which splatpipe does not replace") as caught:
        splatpipe.write_splat(tmp_path / name, some_splat())
    assert caught.value.hint and pipe.is_fifo()


def test_far_means_in_float64_get_an_origin() -> None:
    splat = replace(some_splat(), place=None)
    grid = splat.means.astype(np.float64) + np.array([388_720.25, 5_299_720.125, 510.0])
    rest = (splat.log_scales, splat.quats, splat.opacity_logits, splat.sh)
    activated = (splat.scales, splat.quats, splat.opacities, splat.sh)
    for made in (Splat(grid, *rest), Splat.of_activated(grid, *activated)):
        assert np.abs(made.means.astype(np.float64) + made.origin - grid).max() < 1e-5
    shifted = Splat(grid - 1000.0, *rest, origin=(1000.0, 1000.0, 1000.0))
    assert np.abs(shifted.means.astype(np.float64) + shifted.origin - grid).max() < 1e-5
    with pytest.raises(splatpipe.SplatpipeError, match="from its place") as caught:
        Splat(grid, *rest, place=PLACE)
    assert caught.value.hint
