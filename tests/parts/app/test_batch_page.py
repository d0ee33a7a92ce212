"""The batch's page: a single file, correct during and after the batch, whatever the captures are called."""

import base64
import io
import os
import time
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.batch.pages.page import batch_page
from splatpipe.pipeline.app.batch.pages.pictures import capture_picture
from splatpipe.pipeline.app.batch.pages.state import BatchState, CaptureState


def batch(*captures: CaptureState, **facts: object) -> BatchState:
    return replace(BatchState("night", captures, as_of_s=time.time(), began_s=time.time() - 3600.0), **facts)


@pytest.mark.parametrize(
    ("captures", "facts", "level", "headline"),
    [
        (("done", "reused"), {"exit_code": 0}, "good", "All 2 captures succeeded"),
        (("done", "failed", "failed"), {"exit_code": 1}, "bad", "2 of 3 captures failed; 1 finished"),
        (("done", "stopped", "waiting"), {"exit_code": 130}, "doubt", "Stopped: 1 of 3 captures finished"),
        (("done", "waiting"), {"exit_code": 4, "message": "The disk is full."}, "bad",
         "Ended early: 1 of 2 captures finished"),
        ((), {"exit_code": 0}, "doubt", "There were no captures to process"),
    ],
)  # fmt: skip
def test_the_headline_states_how_it_ended(
    tmp_path: Path, captures: tuple[str, ...], facts: dict[str, object], level: str, headline: str
) -> None:
    states = [CaptureState(f"c{i}", standing) for i, standing in enumerate(captures)]  # type: ignore[arg-type]
    page = batch_page(batch(*states, ended_s=time.time(), **facts), tmp_path)
    assert f'<section class="verdict {level}"' in page and f"<h2>{headline}</h2>" in page
    assert "refresh" not in page and "<script>" not in page


def test_no_folder_of_this_machine_is_named(tmp_path: Path) -> None:
    reason = f"{tmp_path}/one/stages/x is gone, and so is /home/somebody/photos/a.jpg."
    page = batch_page(batch(CaptureState("one", "failed", reason=reason), warnings=(f"{tmp_path} is full.",)), tmp_path)
    assert "OUT/one/stages/x is gone, and so is a.jpg." in page and "OUT is full." in page
    assert str(tmp_path.parent) not in page and "somebody" not in page


def test_a_reason_of_many_lines_is_shortened_to_its_first(tmp_path: Path) -> None:
    reason = "None of the 70 pictures can be used. Left out:\n" + "\n".join(f"  {i}.jpg is cut off" for i in range(70))
    capture = CaptureState("a", "failed", "ingest", verdict="Failed in ingest", level="bad", reason=reason)
    page = batch_page(batch(capture), tmp_path)
    assert "can be used. Left out:</p>" in page and ">49.jpg is cut off<" in page and ">50.jpg" not in page
    assert "and 20 more" in page and page.count("Failed in ingest") == 1


def test_finished_with_doubts_is_stated_in_the_headline(tmp_path: Path) -> None:
    captures = (CaptureState("a", "done", level="good"), CaptureState("b", "done", level="doubt"))
    page = batch_page(batch(*captures, ended_s=time.time(), exit_code=0), tmp_path)
    assert "<h2>All 2 captures succeeded; 1 to check</h2>" in page


def test_a_card_shows_a_photo_until_there_is_a_render(demo_run: Path, tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    photo = capture_picture(tmp_path / "none", capture_path(), kept)
    assert photo is not None and photo.parent == kept
    with Image.open(photo) as picture:
        assert max(picture.size) == 480
    out = tmp_path / "out"
    out.symlink_to(demo_run)
    render = capture_picture(out, capture_path(), kept)
    assert render is not None
    views = {path.name: path for path in demo_run.glob("stages/evaluate-*/views/*.render.png")}
    with Image.open(render) as image:
        small = image.convert("RGB")
    off = {name: difference(small, path) for name, path in views.items()}
    assert min(off.values()) < 6.0  # JPEG's
    stamp = render.stat().st_mtime_ns
    assert capture_picture(out, capture_path(), kept) == render and render.stat().st_mtime_ns == stamp
    other = capture_picture(tmp_path / "none", tmp_path / "nowhere", kept)
    assert other is None and sorted(kept.iterdir()) == sorted({photo, render})  # each capture keeps its own


def difference(small: Image.Image, path: Path) -> float:
    """Return the mean grey-value difference between a small image and a large one."""
    with Image.open(path) as large:
        again = large.convert("RGB")
    again.thumbnail((480, 480), Image.Resampling.BOX)
    if again.size != small.size:
        return 255.0
    pairs = zip(small.tobytes(), again.tobytes(), strict=True)
    return sum(abs(a - b) for a, b in pairs) / len(small.tobytes())


def test_unreadable_images_affect_nothing_else(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "a.jpg").write_bytes(b"no picture")
    (photos / "b.jpg").symlink_to(photos / "b.jpg")
    assert capture_picture(tmp_path / "none", photos, tmp_path / "kept") is None
    page = batch_page(batch(CaptureState("x", "done", picture="photos/a.jpg")), tmp_path)
    assert "no picture</p>" in page and "data:image" not in page
    whole = sorted(capture_path().glob("*.JPG"))[0].read_bytes()
    (photos / "c.jpg").write_bytes(whole[: len(whole) // 2])  # the existing half is shown
    page = batch_page(batch(CaptureState("x", "done", picture="photos/c.jpg")), tmp_path)
    code = page.split("data:image/jpeg;base64,")[1].split('"')[0]
    with Image.open(io.BytesIO(base64.b64decode(code))) as picture:
        assert picture.convert("L").crop((0, 0, 480, 100)).getextrema()[1] > 60


def test_a_pipe_among_the_photos_does_not_block(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    os.mkfifo(photos / "pipe.jpg")
    assert capture_picture(tmp_path / "out", photos, tmp_path / "kept") is None
