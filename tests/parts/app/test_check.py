"""`splatpipe check`: faults injected into good photos are found and named, and good photos raise no findings."""

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command import splatpipe
from PIL import ExifTags, Image, ImageFilter

from splatpipe.demo import capture_path
from splatpipe.pipeline.app.library.requests import overrides
from splatpipe.pipeline.app.preflight.examination import examine_capture
from splatpipe.pipeline.app.preflight.findings import Finding, Preflight, as_json
from splatpipe.pipeline.app.preflight.intake import read_capture
from splatpipe.pipeline.app.preflight.places import control_findings
from splatpipe.pipeline.engine.config import load_preset
from splatpipe.pipeline.engine.events import EventReporter
from splatpipe.pipeline.engine.runs.source import open_source
from splatpipe.pipeline.photos.intake.detail import detail_at, levels_at
from splatpipe.pipeline.survey.positions.flight_gaps import find_missing
from splatpipe.pipeline.survey.positions.swapped_positions import PositionEvidence, find_swapped
from splatpipe.stages.line import LINE

RING = range(1, 17)  # photos of the demo's lower orbit
Picture = Callable[[np.ndarray], np.ndarray]


def examined(photos: Path, *sets: str) -> Preflight:
    config = overrides(None, list(sets), None).resolve(load_preset("preview"))
    return examine_capture(
        photos, {"preview": config}, 2, EventReporter("check", lambda _event: None), photos.parent / "frames"
    )


def found(preflight: Preflight, code: str) -> list[Finding]:
    return [finding for finding in preflight.findings if finding.code == code]


def name(number: int) -> str:
    return f"DJI_{number:04d}.JPG"


def ring(folder: Path, leave_out: tuple[int, ...] = ()) -> Path:
    """The lower orbit of the demo, copied."""
    folder.mkdir()
    for number in RING:
        if number not in leave_out:
            shutil.copy(capture_path() / name(number), folder)
    return folder


def changed(path: Path, change: Picture) -> None:
    """Save a photo again with other pixels and the same metadata."""
    with Image.open(path) as picture:
        pixels = change(np.asarray(picture.convert("RGB"), np.float32))
        kept = {"exif": picture.getexif().tobytes(), "xmp": picture.info["xmp"]}
    Image.fromarray(np.clip(np.rint(pixels), 0, 255).astype(np.uint8)).save(path, quality=92, **kept)


def shaken(pixels: np.ndarray) -> np.ndarray:
    """Blur by 4 px along x."""
    return np.mean([np.roll(pixels, shift, axis=1) for shift in range(4)], axis=0)


def darker(pixels: np.ndarray) -> np.ndarray:
    """Darken by 1.5 EV in linear light, with a plain gamma of 2.2."""
    return 255.0 * ((pixels / 255.0) ** 2.2 * 2.0**-1.5) ** (1 / 2.2)


def gps_of(path: Path) -> dict[int, object]:
    with Image.open(path) as picture:
        return dict(picture.getexif().get_ifd(ExifTags.IFD.GPSInfo))


def with_exif(path: Path, gps: dict[int, object] | None = None, model: str = "") -> None:
    """Another position or camera, in EXIF; XMP, which states both as well, is removed."""
    with Image.open(path) as picture:
        exif, pixels = picture.getexif(), picture.copy()
    if gps is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(gps)
    if model:
        exif[ExifTags.Base.Model] = model
    pixels.save(path, quality=92, exif=exif.tobytes())


def test_of_good_photos_without_a_strip_of_three_only_the_gap_is_reported(tmp_path: Path) -> None:
    preflight = examined(ring(tmp_path / "photos", leave_out=(6, 7, 8)))
    findings = [finding for finding in preflight.findings if finding.severity != "note"]
    assert [finding.code for finding in findings] == ["gap"] and findings[0].photos == ()
    assert "3 photos are missing between DJI_0005.JPG and DJI_0009.JPG" in findings[0].message
    assert len(preflight.gaps) == 1 and len(preflight.gaps[0].outline_m) == 4
    assert len(preflight.components) == 1 and preflight.orphans == ()
    assert all(photo.sharpness is not None and photo.sharpness > 0.7 for photo in preflight.photos)
    assert all(abs(photo.brightness_ev or 9.0) < 0.5 for photo in preflight.photos)
    assert all(photo.footprint_m is not None and len(photo.footprint_m) == 4 for photo in preflight.photos)
    assert preflight.forecasts[0].memory_bytes > 1e8
    text = json.dumps(as_json(preflight))
    assert json.loads(text)["verdict"] == "warning"
    assert str(tmp_path) not in text


def test_faults_of_single_photos_are_found_and_name_them(tmp_path: Path) -> None:
    photos = ring(tmp_path / "photos")
    changed(photos / name(3), shaken)
    changed(photos / name(8), darker)
    shutil.copy(photos / name(5), photos / "copy.JPG")
    data = (photos / name(10)).read_bytes()
    (photos / name(10)).write_bytes(data[: len(data) * 2 // 3])
    first, second = gps_of(photos / name(6)), gps_of(photos / name(13))
    with_exif(photos / name(6), second), with_exif(photos / name(13), first)
    with_exif(photos / name(15), model="M3T")
    with Image.open(photos / name(1)) as picture:
        small, kept = picture.resize((900, 675)), picture.getexif().tobytes()
    small.save(photos / name(1), quality=92, exif=kept)
    preflight = examined(photos)
    by_code = {code: found(preflight, code) for code in {finding.code for finding in preflight.findings}}
    assert [finding.photos for finding in by_code["blurred"]] == [(name(3),)]
    assert [finding.photos for finding in by_code["underexposed"]] == [(name(8),)]
    assert [finding.photos for finding in by_code["duplicate"]] == [(name(5), "copy.JPG")]
    assert by_code["unreadable"][0].photos == (name(10),) and "is truncated" in by_code["unreadable"][0].message
    assert [finding.photos for finding in by_code["position-swapped"]] == [(name(6), name(13))]
    assert (name(15),) in [finding.photos for finding in by_code["cameras"]]
    assert (name(1),) in [finding.photos for finding in by_code["resized"]]
    assert preflight.worst == "warning"


def lines(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions and times of a flight back and forth: 10 m and 2 s per photo, 25 m between lines, 5 s per turn."""
    places, times, now = [], [], 0.0
    for row in range(rows):
        way = range(columns) if row % 2 == 0 else reversed(range(columns))
        for column in way:
            places.append((10.0 * column, 25.0 * row, 60.0))
            times.append(now)
            now += 2.0
        now += 3.0
    return np.array(places), np.array(times)


def seen_together(places: np.ndarray) -> dict[tuple[int, int], int]:
    """Matches that fall with the distance, none beyond 60 m."""
    count = len(places)
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    return {(i, j): int(max(0.0, 300.0 - 5.0 * apart[i, j])) for i in range(count) for j in range(i + 1, count)}


def test_swapped_positions_are_found_by_matches_and_flight_path_and_correct_ones_are_not_reported() -> None:
    places, times = lines(4, 10)
    matches = seen_together(places)
    noisy = places + np.random.default_rng(0).normal(0.0, 1.0, places.shape)
    assert find_swapped(PositionEvidence(noisy, times, matches)) == []
    for pair in ((3, 4), (5, 27), (0, 39), (12, 15)):
        wrong = noisy.copy()
        wrong[list(pair)] = wrong[list(pair)[::-1]]
        assert find_swapped(PositionEvidence(wrong, times, matches)) == [pair]
        unknown = np.full(len(times), np.nan)
        if np.linalg.norm(places[pair[0]] - places[pair[1]]) > 50.0:
            assert find_swapped(PositionEvidence(wrong, unknown, matches)) == [pair]


def test_turns_between_lines_are_no_gaps_and_missing_photos_are() -> None:
    places, times = lines(4, 10)
    names = [f"IMG_{number:04d}.JPG" for number in range(40)]
    assert find_missing(names, PositionEvidence(places, times, {})) == []
    kept = [number for number in range(40) if number not in (14, 15, 16)]
    renamed = [f"photo {number}.JPG" for number in range(37)]
    for called in ([names[number] for number in kept], renamed):
        strips = find_missing(called, PositionEvidence(places[kept], times[kept], {}))
        assert [(strip.before, strip.after, strip.missing) for strip in strips] == [(13, 14, 3)]


def test_detail_falls_with_blur_in_its_direction_and_not_with_contrast() -> None:
    rough = np.random.default_rng(0).normal(0.0, 1.0, (128, 128))
    rough += 4.0 * np.kron(np.random.default_rng(1).normal(0.0, 1.0, (16, 16)), np.ones((8, 8)))
    sharp = np.clip(128.0 + 12.0 * rough, 0, 255)
    along_x = np.mean([np.roll(sharp, shift, axis=1) for shift in range(3)], axis=0)
    places = np.array([[x, y] for x in range(20, 110, 10) for y in range(20, 110, 10)], np.float64)
    clear = np.median(detail_at(sharp.astype(np.uint8), places), axis=0)
    blurred = np.median(detail_at(along_x.astype(np.uint8), places), axis=0)
    pale = np.median(detail_at((128.0 + (sharp - 128.0) / 2.0).astype(np.uint8), places), axis=0)
    assert clear[0] - blurred[0] > 1.0 > 5.0 * abs(clear[2] - blurred[2])
    assert np.abs(clear - pale).max() < 0.15
    assert np.isnan(detail_at(sharp.astype(np.uint8), np.array([[3.0, 60.0]]))).all()


def test_brightness_levels_are_of_linear_light() -> None:
    places = np.array([[10.0, 10.0]])
    step = levels_at(np.full((20, 20), 188, np.uint8), places) - levels_at(np.full((20, 20), 137, np.uint8), places)
    assert step[0] == pytest.approx(1.0, abs=0.02)  # 188 and 137 are 50 % and 25 % of light in sRGB


def little(folder: Path) -> Path:
    """Two photos that have nothing to do with each other."""
    folder.mkdir()
    for number in range(2):
        noise = np.random.default_rng(number).integers(0, 255, (300, 400, 3), dtype=np.uint8)
        Image.fromarray(noise).save(folder / f"{number}.jpg")
    return folder


def test_a_thermal_flight_is_told_to_have_little_texture(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    for number in range(17, 20):
        with Image.open(capture_path() / name(number)) as photo:
            blurred = photo.convert("L").resize((640, 480)).filter(ImageFilter.GaussianBlur(6))
        blurred.save(tmp_path / "photos" / name(number), "MPO", save_all=True, append_images=[blurred], quality=90)
    (finding,) = found(examined(tmp_path / "photos"), "texture")
    assert "little texture" in finding.message
    assert "run on the colour photos" in finding.hint


def test_a_capture_that_cannot_be_reconstructed_exits_with_1_and_says_why(tmp_path: Path) -> None:
    photos = little(tmp_path / "photos")
    (photos / "gcp_list.txt").write_text("EPSG:32633\n388710 5299705 512 112 514\n")
    (photos / "scale_bars.csv").write_text("name_a,name_b,metres\nA,A,1.0\n")
    done = splatpipe("check", photos, "--json", cwd=tmp_path)
    output = json.loads(done.stdout)
    assert done.returncode == output["exit_code"] == 1, done.stderr
    assert {"no-overlap", "control-broken", "scale-bars"} <= {finding["code"] for finding in output["findings"]}
    assert output["verdict"] == "error" and (tmp_path / "check.html").is_file()
    assert "Line 2 of gcp_list.txt" in done.stderr


def test_findings_are_printed_even_if_the_page_cannot_be_written(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    (photos / "[red]broken[bold].jpg").write_bytes(b"none")
    done = splatpipe("check", photos, "--json", "-o", "none/c.html", cwd=tmp_path)
    output = json.loads(done.stdout)
    assert done.returncode == output["exit_code"] == 4
    assert "Cannot write the page none/c.html" in output["error"]["message"]
    assert {"unreadable", "too-few"} == {finding["code"] for finding in output["findings"]}
    assert "[red]broken[bold].jpg" in done.stderr and "only one usable" not in done.stderr


def test_what_lies_in_place_of_photos_is_named(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    for file, words in {
        "": ("The folder photos is empty", "Give the folder"),
        "n.txt": ("only 1 other file", "Give the folder"),
        "f.zip": ("f.zip is an archive", "Unpack it"),
        "f.mp4": ("but a film: f.mp4", "splatpipe run photos/f.mp4 OUT"),
    }.items():
        (photos / file).touch()
        (few,) = found(examined(photos), "too-few")
        assert words[0] in few.message and words[1] in few.hint
        assert str(tmp_path) not in few.message + few.hint  # the page may be sent on


def test_masks_are_checked_as_in_a_run(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    (photos / "masks").mkdir(parents=True)
    for number in range(1, 6):
        shutil.copy(capture_path() / name(number), photos)
    Image.new("L", (600, 450), 255).save(photos / "masks" / "DJI_0001.png")
    Image.new("L", (450, 450), 255).save(photos / "masks" / "DJI_0002.png")
    (photos / "masks/DJI_0003.JPG.png").touch()
    (photos / "masks/DJI_0004.png").write_text("no picture")
    Image.new("L", (1200, 900), 0).save(photos / "DJI_0005_mask.png")
    Image.new("L", (1200, 900), 255).save(photos / "masks" / "DJI_9999.png")
    issues = found(examined(photos), "masks")
    assert {issue.photos: issue.message for issue in issues} == {
        (): "There is no photo for the mask masks/DJI_9999.png.",
        (name(2),): "Masks not used: masks/DJI_0002.png has another aspect ratio (450 × 450) than its photo.",
        (name(3),): "Masks not used: masks/DJI_0003.JPG.png is empty.",
        (name(4),): "Masks not used: masks/DJI_0004.png cannot be read: it is no picture, or its header is damaged.",
        (name(5),): "The mask of DJI_0005.JPG hides almost the whole photo: black areas are ignored.",
    }
    assert {issue.severity for issue in issues} == {"warning"}
    assert [issue.hint for issue in found(examined(photos), "companions")] == ["A run applies them."]
    unmasked = examined(photos, "ingest.masks=false")
    assert found(unmasked, "masks") == []
    assert [issue.hint for issue in found(unmasked, "companions")] == [
        "A run leaves them unused, by ingest.masks=false."
    ]


def test_several_models_are_told(tmp_path: Path) -> None:
    (tmp_path / "cm/images").mkdir(parents=True)
    for model, count in (("0", 2), ("1", 5)):
        folder = tmp_path / "cm/sparse" / model
        folder.mkdir(parents=True)
        (folder / "cameras.txt").touch()
        (folder / "images.txt").write_text("".join(f"{i} 1 0 0 0 0 0 0 1 {i}.jpg\n\n" for i in range(count)))
    (told,) = found(examined(tmp_path / "cm"), "models")
    assert told.severity == "note" and "sparse/1 with 5 photos is used; sparse/0 has 2" in told.message


@pytest.mark.parametrize(
    ("north_m", "severities"),
    [
        ((0.0, 5.0, -5.0), []),
        ((0.0, 5.0, 900.0), ["warning"]),
        ((20e3, 20.1e3, 20.2e3), ["error"]),
        ((0.0, 1.0, 2.0, 3.0, 4.0, 5.0), []),
    ],
)
def test_points_that_no_photo_can_show_are_reported(
    tmp_path: Path, north_m: tuple[float, ...], severities: list[str]
) -> None:
    photos = ring(tmp_path / "photos", leave_out=tuple(number for number in RING if number not in (1, 6, 11)))
    config = overrides(None, [], None).resolve(load_preset("preview"))
    source = open_source(photos, tmp_path / "out", LINE, config)
    intake, _ = read_capture(source, config, 1, EventReporter("check", lambda _event: None), tmp_path)
    stated = intake.positions.positions  # around the house, which all of them show
    latitude, longitude = np.mean([(each.latitude, each.longitude) for each in stated], axis=0)
    rows = [f"P{k},{latitude + step / 111_195.0:.8f},{longitude:.8f}" for k, step in enumerate(north_m)]
    (tmp_path / "points.csv").write_text("\n".join(["name,lat,lon", *rows]))
    findings, places = control_findings(tmp_path / "points.csv", intake, config.georef)
    assert [(finding.code, finding.severity) for finding in findings] == [("control-outside", s) for s in severities]
    assert "P2" in findings[0].message if severities == ["warning"] else True
    assert [place.name for place in places if place.kind == "check"] == (["P2", "P5"] if len(north_m) == 6 else [])


def test_accurate_positions_straight_down_are_told_what_control_would_buy(tmp_path: Path) -> None:
    """The demo's lower orbit, with a positions file that states RTK's accuracy and cameras that look straight down."""
    photos = ring(tmp_path / "photos")
    config = overrides(None, [], None).resolve(load_preset("preview"))
    quiet = EventReporter("check", lambda _event: None)
    intake, _ = read_capture(open_source(photos, tmp_path / "out", LINE, config), config, 1, quiet, tmp_path)
    rows = [
        f"{each.name} {each.longitude:.10f} {each.latitude:.10f} 500.0 {20 * k} 1 0 0.02 0.03"
        for k, each in enumerate(intake.positions.positions)
    ]
    (photos / "geo.txt").write_text("\n".join(["EPSG:4979", *rows]))
    preflight = examined(photos)
    (finding,) = found(preflight, "heights-uncertain")
    heights = json.loads(json.dumps(as_json(preflight)))["heights"]
    assert "straight down from one height" in finding.message and heights["straight_down"]
    assert heights["height_m"] > 3.0 * heights["gsd_m"] > heights["control_1_m"]
    assert len(heights["spots"]) == 3 and heights["photos"] == len(RING)
    assert not found(preflight, "nadir-only")


def test_a_run_reports_a_broken_control_file_before_its_first_stage(tmp_path: Path) -> None:
    photos = little(tmp_path / "photos")
    (photos / "gcp_list.txt").write_text("EPSG:32633\n388710 5299705 512 112 514\n")
    done = splatpipe("run", photos, tmp_path / "out")
    assert done.returncode == 1 and "Line 2 of gcp_list.txt" in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_folder_of_rubbish_is_reported_file_by_file(tmp_path: Path) -> None:
    photos = tmp_path / "photos"
    photos.mkdir()
    rng = np.random.default_rng(0)
    buffer = io.BytesIO()
    Image.fromarray(rng.integers(0, 255, (400, 500, 3), dtype=np.uint8)).save(buffer, "JPEG")
    good = bytearray(buffer.getvalue())
    for number in range(12):
        data = good.copy()
        for at in rng.integers(2, len(data), 40):
            data[at] = rng.integers(256)
        (photos / f"{number}.jpg").write_bytes(bytes(data[: int(rng.integers(10, len(data)))]))
    preflight = examined(photos)
    assert preflight.worst == "error"
    assert len(preflight.photos) + len(preflight.left_out) == 12
