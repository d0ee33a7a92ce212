"""What a run reports before it begins: its cost, and a memory limit that is too small."""

from __future__ import annotations

from pathlib import Path

import pytest
from command import splatpipe

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.cli_runs import overrides, request_of
from splatpipe.pipeline.app.preflight.start import forecast_text, require_memory
from splatpipe.pipeline.engine.config import load_preset, resolve
from splatpipe.pipeline.engine.errors import MachineError
from splatpipe.pipeline.engine.session import Request
from splatpipe.stages.costs import REFERENCE
from splatpipe.stages.forecast import forecast, min_memory_bytes
from splatpipe.stages.options import LineConfig
from splatpipe.stages.work import CaptureSize, CaptureWork


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
    least = min_memory_bytes(LineConfig())
    require_memory(request(tmp_path, "standard"))
    require_memory(request(tmp_path, "standard", max_memory_bytes=least))
    with pytest.raises(MachineError) as raised:
        require_memory(request(tmp_path, "standard", max_memory_bytes=least - 1))
    assert f"{-(-least // 1_000_000)}M" in raised.value.hint


def test_a_run_states_its_cost_and_what_the_memory_limit_leaves_out(tmp_path: Path) -> None:
    text = forecast_text(request(tmp_path, "preview"))
    assert text.startswith("40 photos of 1.1 megapixels take about ") and "1,500 iterations" in text
    assert "GB of memory" in text and "GB of disk" in text and "memory holds" not in text
    least = min_memory_bytes(LineConfig())
    tight = request(tmp_path, "standard", max_memory_bytes=least)
    assert "the memory holds" in forecast_text(tight) and "the photos would support more" in forecast_text(tight)
    assert forecast_text(request(tmp_path, "preview", time_budget_s=600.0)).endswith("GB of disk.")


@pytest.mark.parametrize("preset", ["preview", "standard", "high"])
def test_forecasts_follow_lengths_windows_and_limits(preset: str) -> None:
    config = resolve(LineConfig, [load_preset(preset)])
    small, large = (CaptureSize(photos, 20.0, True) for photos in (50, 1000))
    each = [CaptureWork.of(size, config, REFERENCE, 2) for size in (small, large)]
    assert all(work.iterations >= 20 * work.size.photos and work.window <= 0.53 for work in each)
    few, many = (forecast(size, config)["train"] for size in (small, large))
    decoded = 3 * 0.25e6 * (1000 - 50)  # bytes of the additional photos, at less than any preset's size
    assert many.cpu_seconds > few.cpu_seconds and many.scratch_bytes > few.scratch_bytes + decoded
    limited = resolve(LineConfig, [load_preset(preset), {"train": {"max_memory_bytes": 800_000_000}}])
    assert CaptureWork.of(small, limited, REFERENCE, 2).window < each[0].window
    assert forecast(small, limited)["train"].memory_bytes <= 800_000_000
