"""benchmarks/ablation: what it runs, what it does not repeat, and the arithmetic of its tables."""

import json
import math
from pathlib import Path
from typing import Any

import ablation
import comparison
import pytest
import tiny_scene
import variants
from commands import Command, CommandEnd
from finished import ResultLog, figures, work_folder

from splatpipe.pipeline.engine.errors import UsageError
from splatpipe.pipeline.train.options import TrainConfig


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("scene") / "tiny")


def row(variant: str, capture: str, seed: int, **values: float) -> dict[str, Any]:
    return {"variant": variant, "capture": capture, "seed": seed, **values}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--variant", "typo=train.antialiased=true"], "Variant typo: There is no option train.antialiased. Did you"),
        (["--variant", "wrong=train.iterations=-3"], "Variant wrong: train.iterations = -3"),
        (["--variant", "seeded=train.seed=7"], "Variant seeded: train.seed is not a variant's"),
        (["--variant", "front=sparse.min_model_size=4"], "would not act on this variant alone"),
        (["--variant", "easy=split.every=2"], "would not act on this variant alone"),
        (["--variant", "base=train.antialias=true"], "cannot be a variant's name"),
        (["--only", "nothing"], "There is no variant nothing. There are: defaults"),
        (["--base", "train.nonsense=1"], "Variant base: There is no option train.nonsense"),
        (["--data", "a/tiny", "b/tiny"], "Write --data NAME=PATH"),
    ],
)
def test_an_invalid_call_is_refused_before_anything_runs(
    options: list[str], message: str, dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        ablation.main(["--data", str(dataset), "--work", str(tmp_path / "work"), *options])
    assert ended.value.code == 2 and message in " ".join(capfd.readouterr().err.split())
    assert not (tmp_path / "work").exists()


def test_the_variants_beside_the_script_are_all_valid() -> None:
    base = variants.base_of(ablation.VARIANTS)
    chosen = variants.choose(ablation.VARIANTS, (), None, base)
    assert chosen[0].name == "base" and len(chosen) > 5
    whole = {each.name: variants.config_of((*base, *each.sets), 0) for each in chosen}
    assert len({config.model_dump_json() for config in whole.values()}) == len(whole)  # each changes something
    assert all(each.what for each in chosen)
    # Options that every variant sets alike.
    unlike_presets = {"iterations": 7, "least_iterations": 7, "max_megapixels": 0.5, "stop_when_flat": 0.0}
    alone = whole["defaults"].train.model_copy(update=unlike_presets)
    assert alone == TrainConfig().model_copy(update=unlike_presets)


def test_differences_are_paired_by_capture_and_seed() -> None:
    rows = [
        row("base", "a", 0, psnr=20.0, cpu_s=10.0),
        row("base", "a", 1, psnr=21.0, cpu_s=10.0),
        row("base", "b", 0, psnr=30.0, cpu_s=10.0),
        row("base", "b", 1, psnr=33.0, cpu_s=10.0),  # its partner failed
        row("new", "a", 0, psnr=20.5, cpu_s=11.0, **{"floaters.depth_disagreement": 0.1}),
        row("new", "a", 1, psnr=22.5, cpu_s=12.0),
        row("new", "b", 0, psnr=34.0, cpu_s=10.0),
    ]
    (found,) = comparison.differences(rows, ["new"])
    # Differences 0.5, 1.5 on a and 4 on b: (1 + 4) / 2; around their mean of 2 the squares are 2.25, 0.25 and 4.
    assert found["psnr"] == {"mean": 2.5, "error": pytest.approx(math.sqrt(6.5 / 2.0 / 3.0)), "pairs": 3}
    assert found["cpu_s"]["mean"] == pytest.approx(0.75)
    assert "floaters.depth_disagreement" not in found and "ssim" not in found  # nothing to compare with
    (text,) = comparison.written([found])
    assert text["PSNR dB"] == "+2.50 ± 1.04" and text["pairs"] == 3
    (only,) = comparison.differences(rows[2:3] + rows[6:], ["new"])
    assert only["psnr"] == {"mean": 4.0, "error": None, "pairs": 1}


def test_means_are_over_seeds_with_half_their_range() -> None:
    rows = [row("base", "a", seed, psnr=psnr, ssim=0.5) for seed, psnr in enumerate((18.0, 19.0, 18.5))]
    rows.append(row("new", "a", 0, psnr=17.0))
    base, new, lost = comparison.means(rows, ["base", "new", "lost"])
    assert (base["runs"], base["PSNR dB"], base["SSIM"]) == (3, "18.50 ± 0.50", "0.5000 ± 0.0000")
    assert (new["runs"], new["PSNR dB"]) == (1, "17.00") and "SSIM" not in new
    assert lost == {"variant": "lost", "runs": 0}


def test_every_figure_of_a_run_is_kept_whatever_was_measured(tmp_path: Path) -> None:
    metrics = {"gaussians": 5, "train_megapixels": 0.2, "peak_memory_bytes": 7, "psnr": None, "device": "cpu"}
    metrics |= {"floaters": {"free_space_opacity": 0.25, "views": {"pairs": 3}}, "per_view": [{"psnr": 1.0}]}
    (tmp_path / "metrics.json").write_text(json.dumps(metrics))
    (tmp_path / "stages/train-1").mkdir(parents=True)
    (tmp_path / "stages/train-1/history.json").write_text('{"curve": [{"loss": 0.5}, {"loss": NaN}]}')
    found = figures(tmp_path, CommandEnd(Command("a", (), tmp_path / "log"), "", 2.0, 3.0), 4)
    assert found == {
        "gaussians": 5,
        "megapixels": 0.2,
        "threads": 4,
        "wall_s": 2.0,
        "cpu_s": 3.0,
        "peak_bytes": 7,
        "floaters.free_space_opacity": 0.25,
        "floaters.views.pairs": 3,
        "loss": None,
    }
    (row_text,) = comparison.means([row("base", "a", 0, **found)], ["base"])
    assert row_text["free space"] == "0.250000" and "depth off" not in row_text and "loss" not in row_text


def test_results_survive_a_truncated_line(tmp_path: Path) -> None:
    ResultLog(tmp_path).add("one", {"psnr": 1.0})
    with (tmp_path / "results.jsonl").open("a") as file:
        file.write('{"key": "two", "ro')
    ResultLog(tmp_path).add("three", {"psnr": 3.0})
    assert ResultLog(tmp_path).rows == {"one": {"psnr": 1.0}, "three": {"psnr": 3.0}}


def test_a_work_folder_is_used_by_one_process_at_a_time(tmp_path: Path) -> None:
    with work_folder(tmp_path), pytest.raises(UsageError, match="Another run works"), work_folder(tmp_path):
        pass
