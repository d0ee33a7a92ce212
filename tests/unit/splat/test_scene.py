"""Metadata of a splat file: axes, georeference, edits; written, read back, and read from other programs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from splatpipe.pipeline.delivery.delivery_frame import facts_of, frame_of
from splatpipe.pipeline.splat.containers.ply import read_splat_header, write_splat
from splatpipe.pipeline.splat.formats import plain_ply
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.scene import (
    MAX_RECORD_BYTES,
    Scene,
    SceneFacts,
    SplatOrigin,
    facts_of_record,
    turn_of,
)

PLACE = SplatOrigin(52.2, 21.0, 113.25, "EPSG:5773", "EPSG:32634")
FACTS = SceneFacts("z up", True, True, PLACE, ({"step": "crop", "box": [0, 1]},))


def some_gaussians(count: int = 50, degree: int = 3) -> Gaussians:
    generator = torch.Generator().manual_seed(5)
    empty = Gaussians.empty(count, degree)
    return Gaussians(*(torch.randn(tensor.shape, generator=generator) for tensor in empty.tensors().values()))


@pytest.mark.parametrize("axes", ["z up", "y up", "y down"])
def test_change_of_axes_moves_up_accordingly_and_back(axes):
    scene = Scene(some_gaussians(), FACTS)
    up = turn_of(axes, "z up") @ torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert up.tolist() == {"z up": [0, 0, 1], "y up": [0, 1, 0], "y down": [0, -1, 0]}[axes]
    assert (turn_of(axes, "z up") @ torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)).tolist() == [1, 0, 0]
    back = scene.turned(axes).turned("z up").gaussians
    for name, tensor in scene.gaussians.tensors().items():
        torch.testing.assert_close(getattr(back, name), tensor, rtol=1e-5, atol=1e-5)


def test_a_ply_keeps_its_bits_georeference_and_edits(tmp_path: Path):
    path = tmp_path / "splat.ply"
    scene = Scene(some_gaussians(), FACTS)
    plain_ply.write(path, scene)
    read = plain_ply.read(path)
    assert read.facts == FACTS
    for name, tensor in scene.gaussians.tensors().items():
        assert torch.equal(getattr(read.gaussians, name), tensor)
    assert "crs: EPSG:32634 (see georef.json)" in read_splat_header(path).comments


def test_a_foreign_ply_is_y_down_without_georeference(tmp_path: Path):
    write_splat(tmp_path / "foreign.ply", some_gaussians(3))
    assert plain_ply.read(tmp_path / "foreign.ply").facts == SceneFacts("y down")


def test_a_georeference_round_trips_through_a_frame():
    frame = frame_of(PLACE)
    assert facts_of(frame, antialias=True) == replace(FACTS, edits=())
    np.testing.assert_array_equal(frame.world_from_model.matrix(), np.eye(4))


GOOD = json.loads(FACTS.record())


@pytest.mark.parametrize(
    "record",
    [
        None,
        "",
        "{",
        "[1]",
        "[" * 50_000,
        json.dumps(GOOD | {"axes": "sideways"}),
        json.dumps(GOOD | {"format": 2}),
        json.dumps(GOOD | {"edits": [1]}),
        json.dumps(GOOD | {"edits": [{}] * 201}),
        json.dumps(GOOD | {"edits": [{"height_m": 1}]}).replace("1}]", "1e400}]"),
        json.dumps(GOOD | {"place": {**GOOD["place"], "latitude": 91.0}}),
        json.dumps(GOOD | {"place": {**GOOD["place"], "height_m": float("nan")}}),
        json.dumps(GOOD | {"place": [1, 2]}),
        json.dumps(GOOD) + " " * MAX_RECORD_BYTES,
    ],
)
def test_a_foreign_record_is_ignored(record):
    otherwise = SceneFacts("y up")
    assert facts_of_record(record, otherwise) is otherwise


def test_a_record_larger_than_files_may_carry_is_refused():
    with pytest.raises(ValueError, match="larger"):
        replace(FACTS, edits=({"text": "x" * MAX_RECORD_BYTES},)).record()
