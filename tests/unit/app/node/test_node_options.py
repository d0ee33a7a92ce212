"""The node's options: what clients send, what is echoed, and what a run is told."""

import json
import re

import pytest

from splatpipe.pipeline.app.node.tasks.options import (
    CATALOGUE,
    LISTED,
    MAX_BOUNDARY_CHARACTERS,
    WrongOptionsError,
    parse_options,
)
from splatpipe.pipeline.app.node.tasks.run_options import run_options
from splatpipe.pipeline.engine.config import load_preset, resolve
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


def test_a_preview_makes_maps_only_if_asked() -> None:
    assert "ortho" not in run_options({"preset": "preview"}).tables
    assert run_options({"preset": "preview", "dtm": True}).tables["dtm"] == {"enabled": True}


def test_the_crs_of_the_control_file_is_asked_for_by_webodms_word() -> None:
    assert parse_options(_sent(crs="gcp")).values == {"crs": "auto"}
