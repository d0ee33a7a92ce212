"""Photos of several bands of a shot: told by XMP and by name, one band is used."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from splatpipe.pipeline.engine.errors import SplatpipeError
from splatpipe.pipeline.photos.files.scan import Candidate
from splatpipe.pipeline.photos.intake.bands import bands_of, choose_band
from splatpipe.pipeline.photos.intake.check import CheckedPhoto, PictureLimits, check_photo
from splatpipe.pipeline.photos.metadata.xmp import parse_xmp

LIMITS = PictureLimits(min_side=100, max_pixels=10_000_000)
BANDS = {"Green": 550, "Red": 660, "Red edge": 735, "NIR": 790}
WIDTH, HEIGHT = 240, 180


def xmp(band: str, wavelength: int, shot: str) -> bytes:
    """The packet of a multispectral camera, with its band in a list, as Parrot writes it."""
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        '<rdf:Description xmlns:Camera="http://pix4d.com/camera/1.0/">'
        f"<Camera:BandName><rdf:Seq><rdf:li>{band}</rdf:li></rdf:Seq></Camera:BandName>"
        f"<Camera:CentralWavelength><rdf:Seq><rdf:li>{wavelength}</rdf:li></rdf:Seq></Camera:CentralWavelength>"
        f"<Camera:CaptureUUID>{shot}</Camera:CaptureUUID></rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


def texture(seed: int, blur: int = 1) -> np.ndarray:
    coarse = np.random.default_rng(seed).integers(0, 256, (HEIGHT // blur, WIDTH // blur), np.uint8)
    return np.kron(coarse, np.ones((blur, blur), np.uint8))


def check(folder: Path) -> list[CheckedPhoto]:
    photos = [check_photo(Candidate(path.name, path), LIMITS) for path in sorted(folder.iterdir())]
    assert all(isinstance(photo, CheckedPhoto) for photo in photos), photos
    return [photo for photo in photos if isinstance(photo, CheckedPhoto)]


def multispectral(folder: Path, colour: bool = True, names: str = "DJI_{shot:03d}{number}.TIF") -> list[CheckedPhoto]:
    """Four 16-bit bands and a colour JPEG a shot; the red edge is the sharpest."""
    for shot in range(1, 4):
        for number, (band, wavelength) in enumerate(BANDS.items(), 1):
            grey = texture(10 * shot + number, 1 if band == "Red edge" else 6).astype(np.uint16) * 200
            path = folder / names.format(shot=shot, number=number, tag=("GRE", "RED", "REG", "NIR")[number - 1])
            Image.fromarray(grey).save(path, tiffinfo={700: xmp(band, wavelength, f"id{shot}")})
        if colour:
            Image.fromarray(np.dstack([texture(shot, 2)] * 3)).save(folder / f"DJI_{shot:03d}0.JPG")
    return check(folder)


def test_the_items_of_a_list_are_a_propertys_value() -> None:
    found = parse_xmp(xmp("Red edge", 735, "id1"))
    assert found["Camera:BandName"] == "Red edge"
    assert found["Camera:CentralWavelength"] == "735"
    assert parse_xmp(xmp("Red</rdf:li><rdf:li>Green", 1, ""))["Camera:BandName"] == "Red, Green"


def test_the_colour_photos_of_a_multispectral_flight_are_used_and_the_bands_named(tmp_path: Path) -> None:
    photos = multispectral(tmp_path)
    assert set(bands_of(photos).values()) == {"colour", "green", "red", "red edge", "near infrared"}
    chosen = choose_band(photos, "auto")
    assert [photo.name for photo in chosen.photos] == ["DJI_0010.JPG", "DJI_0020.JPG", "DJI_0030.JPG"]
    assert len(chosen.left_out) == 12
    assert chosen.left_out[0].reason == "shows the band green, and colour is used"
    assert "5 bands: colour is used, without green, near infrared, red, red edge" in chosen.note


def test_without_colour_the_sharpest_band_is_used(tmp_path: Path) -> None:
    chosen = choose_band(multispectral(tmp_path, colour=False), "auto")
    assert [photo.name for photo in chosen.photos] == ["DJI_0013.TIF", "DJI_0023.TIF", "DJI_0033.TIF"]


@pytest.mark.parametrize("wanted", ["NIR", "near infrared", "Near-Infrared"])
def test_a_band_can_be_chosen(tmp_path: Path, wanted: str) -> None:
    photos = multispectral(tmp_path)
    assert [photo.name for photo in choose_band(photos, wanted).photos] == [
        "DJI_0014.TIF",
        "DJI_0024.TIF",
        "DJI_0034.TIF",
    ]
    assert len(choose_band(photos, "all").photos) == 15


@pytest.mark.parametrize(
    ("colour", "said"), [(True, "these are of colour, green"), (False, "no photo states its band")]
)
def test_a_band_that_no_photo_shows_is_refused(tmp_path: Path, colour: bool, said: str) -> None:
    if colour:
        multispectral(tmp_path)
    else:
        Image.fromarray(np.dstack([texture(1)] * 3)).save(tmp_path / "a.jpg")
    with pytest.raises(SplatpipeError, match=said) as caught:
        choose_band(check(tmp_path), "blue")
    assert caught.value.hint


def test_shots_without_the_chosen_band_are_named(tmp_path: Path) -> None:
    photos = [photo for photo in multispectral(tmp_path, colour=False) if photo.name != "DJI_0023.TIF"]
    choice = choose_band(photos, "auto")
    assert [photo.name for photo in choice.photos] == ["DJI_0013.TIF", "DJI_0033.TIF"]
    assert choice.note.endswith("Shots without a photo of that band: those of DJI_0021.TIF.")
    assert "without a photo" not in choose_band(multispectral(tmp_path), "auto").note  # colour ones state no shot


def test_bands_are_told_by_name_where_metadata_are_lost(tmp_path: Path) -> None:
    for shot in range(3):
        for tag in ("GRE", "RED", "REG", "NIR"):
            Image.fromarray(texture(shot)).save(tmp_path / f"IMG_160904_{shot:04d}_{tag}.TIF")
        Image.fromarray(np.dstack([texture(shot)] * 3)).save(tmp_path / f"IMG_160904_{shot:04d}_RGB.JPG")
    chosen = choose_band(check(tmp_path), "auto")
    assert [photo.name[-7:] for photo in chosen.photos] == ["RGB.JPG"] * 3


def test_thermal_twins_are_left_out_beside_their_colour_photos_only(tmp_path: Path) -> None:
    small = np.dstack([texture(3)[:90, :120]] * 3)
    for shot in range(1, 4):
        Image.fromarray(small + np.uint8(shot)).save(tmp_path / f"DJI_2023010112000{shot}_000{shot}_T.JPG")
    assert len(choose_band(check(tmp_path), "auto").photos) == 3  # a thermal flight
    for shot in range(1, 4):
        Image.fromarray(np.dstack([texture(shot, 2)] * 3)).save(tmp_path / f"DJI_2023010112001{shot}_000{shot}_W.JPG")
    chosen = choose_band(check(tmp_path), "auto")
    assert [photo.name[-6:] for photo in chosen.photos] == ["_W.JPG"] * 3
    assert chosen.left_out[0].reason == "shows the band thermal, and colour is used"


def test_photos_of_names_that_only_look_like_bands_are_all_used(tmp_path: Path) -> None:
    for name in ("door_red", "door_rgb", "east_w", "east_t", "plan_v", "plan_d"):
        Image.fromarray(np.dstack([texture(len(name))] * 3) + np.uint8(ord(name[-1]) % 7)).save(
            tmp_path / f"{name}.jpg"
        )
    photos = check(tmp_path)
    assert choose_band(photos, "auto").photos == photos
