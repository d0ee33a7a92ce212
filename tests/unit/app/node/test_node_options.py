"""The node's options: what clients send, what is echoed, and what a run is told."""

import json
import re
from pathlib import Path

import pytest

from splatpipe.pipeline.app.node.tasks.options import (
    CATALOGUE,
    LISTED,
    MAX_BOUNDARY_CHARACTERS,
    WrongOptionsError,
    dropped_notes,
    parse_options,
)
from splatpipe.pipeline.app.node.tasks.run_options import idle_options, run_options
from splatpipe.pipeline.engine.config import load_preset, resolve
from splatpipe.pipeline.engine.runs.line import Line
from splatpipe.pipeline.engine.runs.store import Part
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig

SQUARE = {"type": "Polygon", "coordinates": [[[7, 48], [7.001, 48], [7.001, 48.001], [7, 48.001], [7, 48]]]}


def _sent(**options: object) -> str:
    return json.dumps([{"name": name.replace("_", "-"), "value": value} for name, value in options.items()])


def test_each_option_is_listed_with_exactly_the_keys_that_clients_take() -> None:
    assert len(LISTED) <= 20
    for item in (option.as_json() for option in LISTED):
        assert list(item) == ["name", "type", "value", "domain", "help"]
        assert isinstance(item["value"], str) and isinstance(item["help"], str)
        assert isinstance(item["domain"], list) == (item["type"] == "enum")


def test_the_help_of_each_option_can_be_filled_in_as_clients_do() -> None:
    for option in LISTED:
        option.help.replace("%(default)s", option.default).replace("%(choices)s", str(option.domain))
        assert not re.search(r"%(?!\((default|choices)\)s)", option.help)


def test_a_default_is_a_value_of_its_option_or_stands_for_none() -> None:
    for option in CATALOGUE:
        if option.kind in ("bool", "enum"):
            assert option.typed(option.default) in (False, option.default)


@pytest.mark.parametrize("sent", [True, "true", "True"])
def test_a_switch_is_turned_on_by_what_clients_send_for_it(sent: object) -> None:
    assert parse_options(_sent(dsm=sent)).values == {"dsm": True}


def test_numbers_come_as_text_and_are_echoed_as_numbers_in_the_order_sent() -> None:
    given = parse_options(_sent(mesh_size="12345", orthophoto_resolution="2.5", nonsense="1"))
    assert list(given.values.items()) == [("mesh-size", 12345), ("orthophoto-resolution", 2.5)]
    assert given.dropped == ("nonsense",)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mesh-size", "1.5"),
        ("mesh-size", -3),
        ("mesh-size", True),
        ("orthophoto-resolution", "nan"),
        ("orthophoto-resolution", "1e400"),
        ("orthophoto-resolution", [1]),
        ("orthophoto-resolution", None),
        ("dsm", "perhaps"),
        ("preset", "best"),
        ("preset", 3),
        ("boundary", "not JSON"),
        ("boundary", "[" * 100_000),
        ("boundary", "x" * (MAX_BOUNDARY_CHARACTERS + 1)),
        ("time-budget", "soon"),
        ("crs", "x" * 501),
        ("crs", "EPSG:99999"),
        ("crs", "25833"),
        ("crs", "WGS84 UTM 61N"),
        ("crs", "+proj=pipeline +step"),
        ("crs", "EPSG:5783"),
        ("vertical", "EPSG:25832"),
        ("vertical", "sea level"),
        ("crs", "\ud800"),
        ("check-points", "A1\nB2"),
        ("vertical", "\0"),
    ],
)
def test_a_wrong_value_is_refused_and_named(name: str, value: object) -> None:
    with pytest.raises(WrongOptionsError) as refused:
        parse_options(json.dumps([{"name": name, "value": value}]))
    assert [each for each, _ in refused.value.errors] == [name]


@pytest.mark.parametrize("text", ["{", "3", '{"name": 1}', "[3]", '[{"name": 3}]', "[" * 10**5, "[1e999]", "\ud800"])
def test_what_is_not_a_list_of_options_is_refused(text: str) -> None:
    with pytest.raises(WrongOptionsError):
        parse_options(text)


def test_a_boundary_may_be_sent_as_json_or_as_text() -> None:
    as_text, as_json = parse_options(_sent(boundary=json.dumps(SQUARE))), parse_options(_sent(boundary=SQUARE))
    assert json.loads(as_text.values["boundary"]) == json.loads(as_json.values["boundary"]) == SQUARE


def test_every_combination_of_options_is_one_that_a_run_takes() -> None:
    values = {
        "dtm": True,
        "orthophoto-resolution": 5.0,
        "dem-resolution": 10.0,
        "pc-quality": "low",
        "feature-quality": "high",
        "mesh-size": 5000,
        "facades": True,
        "crs": "EPSG:25832",
        "vertical": "ellipsoidal",
        "check-points": "none",
        "sky": True,
    }
    run = run_options(values)
    config = resolve(LineConfig, [load_preset(run.preset), run.tables])
    assert config.ortho.gsd_m == pytest.approx(0.05) and config.dsm.cell_m == pytest.approx(0.1)
    assert config.mesh.enabled and config.mesh.triangles == 5000 and config.cloud.enabled and config.facades.enabled
    assert config.georef.crs == "EPSG:25832" and config.export.sky and config.features.max_image_size == 2800


def test_a_fast_orthophoto_trains_no_splat() -> None:
    run = run_options({"fast-orthophoto": True, "preset": "preview"})
    assert run.until == "ortho" and run.tables["ortho"] == {"enabled": True}
    assert "cloud" not in run.tables


def test_with_a_fast_orthophoto_the_terrain_model_comes_if_it_is_asked_for_and_still_no_splat() -> None:
    for preset in ("preview", "standard", "high"):
        run = run_options({"fast-orthophoto": True, "dtm": True, "preset": preset, "mesh": True})
        config = resolve(LineConfig, [load_preset(run.preset), run.tables])
        outside = {f"source.{name}" for name in ("photos", "control", "boundary", "geo", "lens", "scale_bars")}
        line = Line(LINE, config, {name: Part(Path(), "") for name in outside}, Path())
        needed = {stage.name for stage in line.needed(run.until)}
        assert {"dsm", "dtm", "ortho"} <= needed and not needed & {"initialize", "blocks", "train", "export"}
        assert config.dtm.enabled and config.ortho.enabled and not config.mesh.enabled


def test_options_that_others_make_idle_are_named() -> None:
    assert idle_options({"fast-orthophoto": True, "mesh-size": 500, "sky": True, "dtm": True}) == ("mesh-size", "sky")
    assert idle_options({"mesh-size": 500, "sky": True}) == ()


def test_what_takes_the_place_of_an_option_that_is_not_offered_is_said() -> None:
    said = dropped_notes(parse_options(_sent(gps_accuracy=3, pc_ept=True)).dropped)
    assert "gps-accuracy, pc-ept" in said[0] and "geo.txt" in said[1] and len(said) == 2
    assert dropped_notes(()) == ()


def test_a_preview_makes_maps_only_if_asked() -> None:
    assert "ortho" not in run_options({"preset": "preview"}).tables
    assert run_options({"preset": "preview", "dtm": True}).tables["dtm"] == {"enabled": True}


@pytest.mark.parametrize("crs", ["EPSG:25832", "epsg:25832+7837", "WGS84 UTM 33N", "+proj=utm +zone=33 +datum=WGS84"])
def test_each_form_of_a_crs_that_a_run_takes_is_taken_as_it_was_sent(crs: str) -> None:
    assert parse_options(_sent(crs=crs, vertical="ellipsoidal")).values == {"crs": crs, "vertical": "ellipsoidal"}


def test_an_unknown_crs_is_refused_in_the_words_of_the_command() -> None:
    with pytest.raises(WrongOptionsError, match=r"crs: There is no EPSG:99999\. Look it up at epsg\.org"):
        parse_options(_sent(crs="EPSG:99999"))


def test_the_crs_of_the_control_file_is_asked_for_by_webodms_word() -> None:
    assert parse_options(_sent(crs="gcp")).values == {"crs": "auto"}
