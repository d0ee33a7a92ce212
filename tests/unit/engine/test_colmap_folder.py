"""COLMAP-style folders: the model with the most photos is used, and said; hostile counts choose nothing."""

import struct
from pathlib import Path

import pytest

from splatpipe.pipeline.engine.runs.colmap_folder import SparseModels, find_models, has_model
from splatpipe.pipeline.engine.runs.source import open_source


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "cm/images").mkdir(parents=True)
    return tmp_path / "cm"


def add_binary(folder: Path, name: str, photos: int, size: int | None = None) -> None:
    """The start of a binary model: the number of photos, and as many bytes as they take."""
    model = folder / "sparse" / name
    model.mkdir(parents=True, exist_ok=True)
    (model / "cameras.bin").write_bytes(b"")
    (model / "images.bin").write_bytes(struct.pack("<Q", photos) + bytes(73 * photos if size is None else size))


def add_text(folder: Path, name: str, photos: int) -> None:
    model = folder / "sparse" / name
    model.mkdir(parents=True)
    (model / "cameras.txt").write_text("# Cameras\n")
    lines = "".join(f"{i} 1 0 0 0 0 0 0 1 DJI {i}.JPG\n{'1 2 3' * (i % 2)}\n" for i in range(1, photos + 1))
    (model / "images.txt").write_text("# Images\n#   IMAGE_ID\n" + lines)


def choice(folder: Path) -> SparseModels:
    found = find_models(folder)
    assert found is not None
    assert has_model(folder) and open_source(folder, folder.parent / "out").model == found.used
    return found


def test_the_model_with_the_most_photos_is_used_and_the_others_are_counted(folder: Path) -> None:
    add_binary(folder, "0", 2)
    add_text(folder, "1", 9)
    add_binary(folder, "10", 3)
    found = choice(folder)
    assert found.used == folder / "sparse/1"
    assert found.note == (
        "There are 3 models in sparse/, which were not joined: sparse/1 with 9 photos is used; sparse/0 has 2, "
        "sparse/10 has 3. To use another one, move the others elsewhere."
    )


def test_of_equal_models_the_first_is_used(folder: Path) -> None:
    for name in ("2", "10", "1"):
        add_binary(folder, name, 4)
    assert choice(folder).used == folder / "sparse/1"


@pytest.mark.parametrize("name", ["0", "1", "."])
def test_a_single_model_is_used_wherever_it_lies_and_nothing_is_said(folder: Path, name: str) -> None:
    add_text(folder, name, 3) if name != "." else add_binary(folder, name, 3)
    found = choice(folder)
    assert (found.used, found.note) == ((folder / "sparse" / name), "")


def test_models_of_other_names_are_not_chosen(folder: Path) -> None:
    add_binary(folder, "0", 2)
    for name in ("aligned", "²", "-1", "0.5"):
        add_binary(folder, name, 9)
    assert choice(folder).used == folder / "sparse/0"


def test_without_images_or_models_there_is_none(folder: Path) -> None:
    (folder / "sparse/0").mkdir(parents=True)
    assert find_models(folder) is None and not has_model(folder)
    add_binary(folder, "0", 2)
    (folder / "images").rmdir()
    assert find_models(folder) is None and not has_model(folder)


def test_a_count_beyond_the_files_end_chooses_nothing(folder: Path) -> None:
    add_binary(folder, "0", 2)
    add_binary(folder, "1", 1 << 61, size=500)
    add_binary(folder, "2", 0)
    (folder / "sparse/2/images.bin").write_bytes(b"\1\2")
    assert choice(folder).used == folder / "sparse/0"
    assert [count for _, count in choice(folder).photos] == [2, 0, 0]


def test_a_text_without_line_ends_chooses_nothing(folder: Path) -> None:
    add_text(folder, "0", 1)
    add_text(folder, "1", 5)
    with (folder / "sparse/1/images.txt").open("r+b") as file:
        file.truncate(1 << 40)
    assert choice(folder).used == folder / "sparse/0"


def test_many_models_are_summed_up(folder: Path) -> None:
    for number in range(12):
        add_binary(folder, str(number), 30 - number)
    assert choice(folder).note.count("sparse/") == 1 + 1 + 5
    assert "6 more have fewer" in choice(folder).note
