"""Compare the former mapping, COLMAP's own and ours on the same matches: ``sfm_speed DATABASE …``.

Each runs in a process of its own, on one thread, in turn. A database is the output of the stage `matches`; a run's
folder is accepted, too. With the demo's ``--truth truth.json``, the distances of its camera centres after a similarity
fit are reported as well.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
import pycolmap
from mapped_apart import COLUMNS, centre_errors, centres, run_apart
from tables import Row, print_table

HOWS = ("before", "plain", "ours", "global")
ONES = {**COLUMNS, "centres mm": "centres_mm:.2f"}


def database_of(path: Path) -> Path:
    """Return the path itself if it is a database, or that of a run's newest matches."""
    if path.is_file():
        return path
    found = sorted(path.glob("stages/matches-*/database.db"), key=lambda each: each.stat().st_mtime)
    if not found:
        raise SystemExit(f"{path} has no stages/matches-*/database.db.")
    return found[-1]


def true_centres(path: Path) -> dict[str, list[float]]:
    """Return the true camera centres in metres, by photo name."""
    photos = json.loads(path.read_text(encoding="utf-8"))["photos"]
    return {photo["name"]: photo["centre_m"] for photo in photos}


def measure(path: Path, how: str, truth: dict[str, list[float]]) -> Row:
    """Return one mapping's figures."""
    database = database_of(path)
    with pycolmap.Database.open(database) as opened:
        total = opened.num_images()
    with tempfile.TemporaryDirectory() as folder:
        row = run_apart(how, database, Path(folder))
        row |= {"capture": path.name if path.is_dir() else path.stem, "photos": total}
        if row["placed"] > 2:
            model = pycolmap.Reconstruction(Path(folder) / how)
            numbers, found = centres(model)
            names = [model.images[number].name for number in numbers]
            if truth and all(name in truth for name in names):
                errors, _ = centre_errors(found, np.array([truth[name] for name in names]))
                row["centres_mm"] = 1e3 * float(np.sqrt(np.mean(errors**2)))
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("databases", nargs="+", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--mappers", nargs="+", choices=HOWS, default=["before", "plain", "ours"])
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    truth = true_centres(wanted.truth) if wanted.truth else {}
    rows = [measure(path, how, truth) for path in wanted.databases for how in wanted.mappers]
    for how in wanted.mappers:
        mine = [row for row in rows if row["how"] == how]
        sums = {key: sum(row[key] for row in mine) for key in ("placed", "photos", "cpu_s")}
        rows.append({"capture": "together", "how": how, **sums})
    print_table("Mapping on the same matches, one thread", rows, ONES)
    if wanted.json:
        wanted.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
