"""What a run reports before it begins: its cost, and a memory limit that is too small."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import splatpipe

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.library.requests import overrides, request_of
from splatpipe.pipeline.app.preflight.start import COMMAND_BYTES, forecast_text, require_memory, shortage_text
from splatpipe.pipeline.engine import machine
from splatpipe.pipeline.engine.config import load_preset, resolve
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.runs.session import Request
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.stages.forecast.needs import RunForecast
from splatpipe.stages.forecast.training import CaptureSize, min_memory_bytes
from splatpipe.stages.options import LineConfig


def request(tmp_path: Path, preset: str, **train: object) -> Request:
    config = resolve(LineConfig, [load_preset(preset), {"train": train}])
    return request_of(capture_path(), tmp_path / "out", config, "cpu", 2)


def test_a_limit_that_no_training_can_keep_is_refused_before_anything_is_done(tmp_path: Path) -> None:
    done = splatpipe("run", capture_path(), tmp_path / "out", "--device", "cpu", "--max-memory", "500M")
    assert done.returncode == 4 and "Training does not fit in 0.50 GB" in done.stderr and "at least" in done.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("said", "size"),
    [([], 0.3), (["train.time_budget_s=60"], 0.0), (["train.time_budget_s=60", "train.max_megapixels=0.4"], 0.4)],
)
def test_a_time_budget_may_use_photos_at_full_size_unless_a_smaller_one_is_set(said: list[str], size: float) -> None:
    assert overrides(None, said, None).resolve(load_preset("preview")).train.max_megapixels == size


def test_the_smallest_limit_that_the_message_names_is_accepted(tmp_path: Path) -> None:
    least = min_memory_bytes(TrainConfig())
    require_memory(request(tmp_path, "standard"))
    require_memory(request(tmp_path, "standard", max_memory_bytes=least))
    with pytest.raises(MachineError) as raised:
        require_memory(request(tmp_path, "standard", max_memory_bytes=least - 1))
    assert f"{-(-least // 1_000_000)}M" in raised.value.hint


def test_a_container_that_is_too_small_to_train_is_refused_at_once_unless_it_need_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    least = min_memory_bytes(TrainConfig()) + COMMAND_BYTES
    asked = request(tmp_path, "standard")
    monkeypatch.setattr(machine, "memory_limit_bytes", lambda limit=0: least)
    require_memory(asked)
    monkeypatch.setattr(machine, "memory_limit_bytes", lambda limit=0: 700 << 20)
    require_memory(asked, "sparse")
    require_memory(asked, here=False)
    with pytest.raises(MachineError, match=r"this machine's or container's 0\.73 GB") as raised:
        require_memory(asked)
    assert f"{-(-least // (1 << 20))}m (docker run --memory)" in raised.value.hint


def test_a_run_states_its_cost_and_what_the_memory_limit_leaves_out(tmp_path: Path) -> None:
    text = forecast_text(request(tmp_path, "preview"))
    assert text.startswith("40 photos of 1.1 megapixels take about ") and "1,500 iterations" in text
    assert "GB of memory" in text and "GB of disk" in text and "memory holds" not in text
    least = min_memory_bytes(TrainConfig())
    tight = request(tmp_path, "standard", max_memory_bytes=least)
    assert "the memory holds" in forecast_text(tight) and "the photos would support more" in forecast_text(tight)
    assert forecast_text(request(tmp_path, "preview", time_budget_s=600.0)).endswith("GB of disk.")


def test_a_run_says_which_stages_may_exceed_its_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shortage_text(request(tmp_path, "preview")) == ""
    tight = request(tmp_path, "preview", max_memory_bytes=1_000_000_000)
    text = shortage_text(tight)
    assert "evaluate up to 1.3 GB" in text and "the limit is 1.0 GB" in text and "train" not in text
    assert "features" not in text  # one photo at a time fits
    assert shortage_text(tight, "features") == ""
    monkeypatch.setattr(machine, "available_memory_bytes", lambda root=Path("/"): 400_000_000)
    assert "features up to 0.4 GB" in shortage_text(request(tmp_path, "preview"), "features")


@pytest.mark.parametrize("preset", ["preview", "standard", "high"])
def test_forecasts_follow_lengths_windows_and_limits(preset: str) -> None:
    config = resolve(LineConfig, [load_preset(preset)])
    small, large = (CaptureSize(photos, 20.0, True) for photos in (50, 1000))
    few, many = (RunForecast.of(size, config, 2) for size in (small, large))
    visits = (20.0, 5.4) if preset == "preview" else (20.0, 20.0)  # a preview's fall: train.length_growth
    for run, least in zip((few, many), visits, strict=True):
        assert run.training.iterations >= least * run.size.photos and run.training.window <= 530_000
    fewer, more = (run.needs(1.0)["train"] for run in (few, many))
    decoded = 3 * 0.25e6 * (1000 - 50)  # bytes of the additional photos, at less than any preset's size
    assert more.cpu_seconds > fewer.cpu_seconds and more.scratch_bytes > fewer.scratch_bytes + decoded
    limit = {"train": {"max_memory_bytes": 800_000_000}}
    limited = RunForecast.of(small, resolve(LineConfig, [load_preset(preset), limit]), 2)
    assert limited.training.window < few.training.window
    assert limited.needs(1.0)["train"].memory_bytes <= 800_000_000
