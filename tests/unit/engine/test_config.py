"""Configuration: layers, presets, and error messages for invalid ones."""

import copy
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from splatpipe.pipeline.app.library.requests import overrides
from splatpipe.pipeline.app.terminal.parameters import LineSettings
from splatpipe.pipeline.engine.config import (
    current_options,
    dump,
    load_file,
    load_preset,
    option_help,
    option_names,
    parse_set,
    preset_names,
    resolve,
    with_seed,
)
from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.stages.line import LINE
from splatpipe.stages.options import LineConfig


@pytest.mark.parametrize("name", preset_names())
def test_every_preset_resolves_and_states_only_what_differs(name: str) -> None:
    preset = load_preset(name)
    resolved = resolve(LineConfig, [preset]).model_dump()
    defaults = LineConfig().model_dump()
    for section, values in preset.items():
        for option, value in values.items():
            assert resolved[section][option] == value
            assert defaults[section][option] != value, f"{section}.{option} repeats the default"


def test_later_layers_win() -> None:
    resolved = resolve(
        LineConfig, [load_preset("preview"), parse_set("train.iterations=77", LineConfig), with_seed(LineConfig, 5)]
    )
    assert resolved.train.iterations == 77
    assert (resolved.matches.seed, resolved.sparse.seed, resolved.train.seed) == (5, 5, 5)


def test_a_resolved_configuration_survives_its_file() -> None:
    resolved = resolve(LineConfig, [load_preset("high")])
    assert resolve(LineConfig, [tomllib.loads(dump(resolved.model_dump(mode="json")))]) == resolved


@pytest.mark.parametrize("own", [[], ["train.max_megapixels=1.5"]], ids=("of the preset", "one's own"))
def test_the_stored_configuration_of_a_run_with_budgets_has_the_same_budgets(tmp_path: Path, own: list[str]) -> None:
    first = overrides(None, LineSettings(own, "10m", "4GB").assignments(), 3).resolve(load_preset("standard"))
    assert first.train.max_megapixels == (1.5 if own else 0.0) and first.train.time_budget_s == 600.0
    kept = tmp_path / "config.toml"
    kept.write_text(dump(first.model_dump(mode="json") | {"photos": "photos", "splatpipe": "0.1"}))
    assert overrides(kept, [], None).resolve(load_preset("preview")) == first


def test_every_option_has_a_help_text() -> None:
    for name, text in option_help(LineConfig):
        assert len(text) > 10, name


def test_the_pipeline_is_complete() -> None:
    """Every part read is written by an earlier stage or named by an option; every stage has its section."""
    known = {"source.photos"} | {file.part for stage in LINE for file in stage.files.values()}
    sections = set(option_names(LineConfig))
    for stage in LINE:
        assert {f"{stage.name}.{option}" for option in stage.files} <= sections
        assert set(stage.reads) <= known, stage.name
        assert {stage.name, *stage.borrows} <= sections
        known |= {f"{stage.name}.{part}" for part in stage.parts}


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"train": {"iteration": 5}}, "no option train.iteration. Did you mean train.iterations?"),
        ({"training": {"iterations": 5}}, "no option training. Did you mean train?"),
        ({"train": {"iterations": -5}}, "train.iterations = -5"),
        ({"train": {"iterations": "many"}}, "train.iterations = 'many'"),
        ({"train": 5}, "train = 5"),
        ({"evaluate": {"views": "a"}}, "There is no option evaluate.views. Did you mean"),
        ({"features": {"extractor": "aliked"}}, "features.extractor = 'aliked'"),
    ],
)
def test_a_wrong_option_is_named(table: dict[str, object], message: str) -> None:
    with pytest.raises(UsageError) as caught:
        resolve(LineConfig, [table])
    assert message in caught.value.message


@pytest.mark.parametrize("text", ["train", "train=5", "=5", ".=5", "train.=5", "", "iterations=5"])
def test_a_broken_assignment_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="--set"):
        parse_set(text, LineConfig)


@given(st.text())
def test_any_assignment_is_parsed_or_a_usage_error(text: str) -> None:
    try:
        table = parse_set(text, LineConfig)
    except UsageError:
        return
    assert isinstance(table, dict)


@pytest.mark.parametrize(
    "content", [b"[train\niterations = 1", b"\xff\xfe\x00", b"a = " + b"[" * 5000, b"x" * (2 << 20)]
)
def test_a_broken_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=r"broken\.toml"):
        load_file(path)


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="No such file"):
        load_file(tmp_path / "none.toml")


def test_options_of_another_version_in_an_out_are_dropped() -> None:
    table = {"train": {"lr_sh": 0.1, "iterations": 900}, "initialize": {"opacity": 0.2}, "nothing": {"of": 1}}
    before = copy.deepcopy(table)
    config = resolve(LineConfig, [current_options(LineConfig, table)])
    assert (config.train.iterations, config.initialize.opacity) == (900, 0.2)
    assert table == before


def test_a_wrong_value_in_an_out_is_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"train\.iterations = '7000'"):
        resolve(LineConfig, [current_options(LineConfig, {"train": {"iterations": "7000"}})])


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(UsageError, match='no preset "fast"'):
        load_preset("fast")


def test_text_options_are_taken_as_they_are_written() -> None:
    """A photo's name such as 100_7105 is a number to TOML."""
    assert parse_set("split.views=100_7105", LineConfig) == {"split": {"views": "100_7105"}}


@pytest.mark.parametrize(
    "text", ["train.lr_means=inf", "train.lr_means=nan", "train.iterations=true", "train.iterations=1.5"]
)
def test_an_invalid_number_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="train"):
        resolve(LineConfig, [parse_set(text, LineConfig)])


def test_an_integer_is_accepted_as_a_length() -> None:
    assert (
        resolve(LineConfig, [parse_set("georef.max_position_error_m=3", LineConfig)]).georef.max_position_error_m == 3.0
    )
