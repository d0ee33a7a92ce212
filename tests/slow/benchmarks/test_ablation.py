"""benchmarks/ablation, with real trainings."""

import json
from pathlib import Path
from typing import Any

import ablation
import pytest
import tiny_scene

KEYS = {"variant", "capture", "seed", "gaussians", "megapixels", "threads", "wall_s", "cpu_s", "peak_bytes"}


KEYS |= {"psnr", "psnr_cc", "ssim", "train_seconds", "loss"}


TINY = "ingest.min_size=50"  # the line leaves out thumbnails


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_scene.write_dataset(tmp_path_factory.mktemp("scene") / "tiny")


def ablate(dataset: Path, work: Path, *options: str) -> tuple[int, dict[str, Any]]:
    out = work.parent / "figures.json"
    words = ["--data", str(dataset), "--work", str(work), "--json", str(out), "--base", TINY, "--iterations", "10"]
    code = ablation.main([*words, "--threads", "1", "--jobs", "2", *options])
    found: dict[str, Any] = json.loads(out.read_text())
    return code, found


def tables(output: str) -> str:
    """Return the tables in a call's output, without the facts about the machine below."""
    return output[: output.index("cpu: ")]


def test_only_new_trainings_run(dataset: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    work = tmp_path / "work"
    smooth = ("--only", "smooth", "--variant", "smooth=train.antialias=true")
    code, first = ablate(dataset, work, *smooth, "--seeds", "2")
    printed = capfd.readouterr()
    assert code == 0 and printed.err.count("min left") == 4
    assert {(each["variant"], each["seed"]) for each in first["rows"]} == {
        (variant, seed) for variant in ("base", "smooth") for seed in (0, 1)
    }
    for each in first["rows"]:
        assert each.keys() >= KEYS and each["capture"] == "tiny" and each["iterations"] == 10
        assert each["test_views"] == 3 and all(
            each[key] > 0 for key in KEYS - {"variant", "capture", "seed"} - {"train_seconds"}
        )
    by_name = {(each["variant"], each["seed"]): each for each in first["rows"]}
    assert by_name["base", 0]["psnr"] != by_name["base", 1]["psnr"]
    (paired,) = first["machine"]["differences"]
    apart = [by_name["smooth", seed]["psnr"] - by_name["base", seed]["psnr"] for seed in (0, 1)]
    assert paired["psnr"]["mean"] == pytest.approx(sum(apart) / 2.0)
    kept = {path.name for path in (work / "runs").glob("*/*")}
    assert kept == {"log", "metrics.json"}

    code, again = ablate(dataset, work, *smooth, "--seeds", "2")
    repeated = capfd.readouterr()
    assert code == 0 and "min left" not in repeated.err
    assert again["rows"] == first["rows"] and tables(repeated.out) == tables(printed.out)

    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_text("no picture")
    changed = (
        "--data",
        f"tiny={dataset}",
        f"lost={photos}",
        "--only",
        "smooth",
        "broken",
        "--variant",
        "smooth=train.antialias=true train.sh_degree=0",
    )
    broken = ("--variant", "broken=ingest.min_size=9999", "--seeds", "1")  # fails as soon as it runs
    code, partly = ablate(dataset, work, *changed, *broken)
    printed = capfd.readouterr()
    assert code == 1 and printed.err.count("min left") == 2  # the base is there
    found = {each["variant"]: each for each in partly["rows"]}
    assert found.keys() == {"base", "smooth"} and found["base"] == by_name["base", 0]
    assert found["smooth"]["psnr"] != by_name["smooth", 0]["psnr"]
    lost, failure = partly["machine"]["failed"]
    assert (failure["capture"], failure["variant"]) == ("tiny", "broken")
    assert "ingest.min_size=9999" in failure["message"] and "None of the 9" in " ".join(printed.out.split())
    assert (lost["capture"], lost["variant"]) == ("lost", None) and "a.jpg" in lost["message"]


def test_following_a_training_reports_how_far_its_end_is_below_its_best(dataset: Path, tmp_path: Path) -> None:
    work = tmp_path / "work"
    none = tmp_path / "none.toml"
    none.touch()
    code, found = ablate(dataset, work, "--variants", str(none), "--seeds", "1", "--curve", "1e-3")
    (path,) = (work / "runs").glob("*/curve.json")
    curve = [each["psnr"] for each in json.loads(path.read_text())["rows"]]
    (only,) = found["rows"]
    # The curve changes no training.
    assert code == 0 and len(curve) == 10 and curve[-1] == pytest.approx(only["psnr"], abs=1e-6)
    assert (only["best_psnr"], only["below_best"]) == (max(curve), max(curve) - curve[-1])
