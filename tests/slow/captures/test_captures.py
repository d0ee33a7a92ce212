"""The pipeline on real photos from outside the project: `make test-captures`, where they exist."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.captures


def splatpipe(*arguments: object) -> dict[str, object]:
    command = [sys.executable, "-m", "splatpipe.pipeline.app.cli.main", *map(str, arguments), "--json"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    output: dict[str, object] = json.loads(done.stdout)
    assert done.returncode == 0, output
    return output


@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    ("capture", "photos", "registered"),
    [("sceaux", 11, 11), ("brighton", 18, 18), ("ochota", 28, 28), ("copr", 41, 38)],
)
def test_a_real_capture_becomes_a_splat(
    captures: Path, tmp_path: Path, capture: str, photos: int, registered: int
) -> None:
    out = tmp_path / capture
    splatpipe("run", captures / capture / "photos", out, "--preset", "preview")
    metrics = json.loads((out / "metrics.json").read_text())
    print(json.dumps({name: value for name, value in metrics.items() if isinstance(value, int | float | str)}))
    assert metrics["photos"] == photos
    assert metrics["registered"] >= registered
    for name in ("splat.ply", "cameras.json", "sparse.glb", "config.toml", "events.jsonl", "report.html"):
        assert (out / name).stat().st_size > 0


@pytest.mark.timeout(600)
def test_a_phones_focal_length_that_the_photos_do_not_determine_stays_near_the_stated_one(
    captures: Path, tmp_path: Path
) -> None:
    """Incremental mapping places 2 of these 29 photos, and free, the focal length becomes 706 pixels.

    An iPhone 4S has some 4.28 mm over a sensor 4.54 mm wide: 965 pixels. Its EXIF states 35 mm, which is 1035.
    """
    splatpipe("run", captures / "lund" / "photos", tmp_path / "out", "--preset", "preview", "--until", "sparse")
    [summary] = (tmp_path / "out" / "stages").glob("sparse-*/models.json")
    found = json.loads(summary.read_text())
    assert found["registered"] >= 28
    assert 930.0 <= found["cameras"][0]["focal_px"] <= 1070.0
    assert found["verdict"]["level"] != "bad"


@pytest.mark.timeout(1200)
def test_a_thousand_iterations_reach_the_peer_on_sceaux(captures: Path, tmp_path: Path) -> None:
    """18.4 dB is what the best CPU peer reaches at its best on the same view, resolution and points.

    It has only the sparse points and models no exposure; nothing fits the render's colours to the photo's.
    """
    settings = ("undistort.max_megapixels=0.4", "train.iterations=1000", "split.views=100_7105.JPG")
    settings += ("initialize.dense=false", "train.exposure=off")
    chosen = [part for text in settings for part in ("--set", text)]
    splatpipe("run", captures / "bench_sceaux", tmp_path / "out", *chosen)
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["test_views"] == 1
    assert metrics["psnr"] >= 18.4
