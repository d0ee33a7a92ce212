"""Captures for the small pipeline whose stage has shards."""

from pathlib import Path

NORTH, SOUTH = (3, 14, 15, 92), (2, 71)


def captures(folder: Path) -> Path:
    for name, numbers in (("north", NORTH), ("south", SOUTH)):
        (folder / name).mkdir(parents=True)
        for at, number in enumerate(numbers):
            (folder / name / f"{at}.txt").write_text(str(number))
    listed = folder / "list.toml"
    listed.write_text('[[capture]]\nphotos = "north"\n[[capture]]\nphotos = "south"\n')
    return listed
