"""Measure how mapping's cost grows with the photos: ``sfm_scaling --photos 250 500 1000 2000 --json FILE``.

For each number of photos a synthetic flight (`flight_scene`) is mapped in a process of its own on one thread and
compared with the truth: camera centres after a similarity fit, in GSD, and relative to the error that the adjustment of
the true tracks from the true cameras leaves for the same noise. Plain COLMAP runs beside it up to ``--plain-up-to``
photos. Pair selection is measured separately, with descriptors generated on demand.

``--captures DATABASE …`` maps real captures instead: databases of the stage `matches`, or folders of runs. The exponent
is the slope of a line through log CPU seconds over log photos. ``--nameless 290`` shuffles a flight's photos, takes
their positions and focal length away, and times all of `reconstruct`.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from flight_scene import GSD_M, anonymous, guessed, make_flight, write_database, write_features
from mapped_apart import COLUMNS, centre_errors, centres, run_apart
from sfm_speed import measure
from tables import Row, print_table

FLOWN = {
    **COLUMNS,
    "centres GSD": "centres_gsd:.2f",
    "over noise": "over_noise:.2f",
}
PAIRS = {
    "photos": "photos:",
    "by position, CPU s": "by_position_s:.1f",
    "by look, CPU s": "by_look_s:.1f",
    "pairs a photo": "pairs_a_photo:.1f",
    "by look": "look_pairs_a_photo:.1f",
    "peak MB": "peak_bytes:MB",
}


def fly(count: int, seed: int, hows: Sequence[str], folder: Path, nameless: bool) -> list[Row]:
    """Generate a flight and map it in each of the ways, with the noise's own error for comparison."""
    flight = make_flight(count, seed)
    database = folder / "database.db"
    if nameless:
        flight = anonymous(flight, seed)
        write_features(flight, folder / "features.db", seed)
    write_database(flight, database, seed, guessed() if nameless else None)
    true = flight.centres_m
    del flight
    rows = []
    for how in hows if nameless else ("oracle", *hows):
        row = run_apart(how, database, folder, count, seed)
        row |= {"capture": "flight", "photos": count}
        if row["placed"] > 2:
            numbers, found = centres(pycolmap.Reconstruction(folder / how))
            errors, _ = centre_errors(found, true[np.array(numbers) - 1])
            row["centres_gsd"] = float(np.sqrt(np.mean(errors**2))) / GSD_M
            if not nameless:
                row["over_noise"] = row["centres_gsd"] / (rows[0]["centres_gsd"] if rows else row["centres_gsd"])
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def exponent(rows: Sequence[Row]) -> float | None:
    """Return the exponent of the CPU seconds over the photos; None for a single size."""
    photos = np.log([row["photos"] for row in rows])
    if len(set(photos.tolist())) < 2:
        return None
    return float(np.polyfit(photos, np.log([row["cpu_s"] for row in rows]), 1)[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--photos", nargs="*", type=int, default=[250, 500, 1000, 2000])
    parser.add_argument("--captures", nargs="+", type=Path)
    parser.add_argument("--nameless", nargs="+", type=int, default=[])
    parser.add_argument("--mappers", nargs="+", choices=["ours", "global"], default=["ours"])
    parser.add_argument("--plain-up-to", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    rows: list[Row] = []
    if wanted.captures:
        rows = [measure(path, how, {}) for path in wanted.captures for how in wanted.mappers]
        rows.sort(key=lambda row: row["photos"])
    elif wanted.nameless:
        for count in wanted.nameless:
            with tempfile.TemporaryDirectory() as folder:
                rows += fly(count, wanted.seed, ["whole"], Path(folder), nameless=True)
    else:
        for count in wanted.photos:
            hows = [*wanted.mappers, *(["plain"] if count <= wanted.plain_up_to else [])]
            with tempfile.TemporaryDirectory() as folder:
                rows += fly(count, wanted.seed, hows, Path(folder), nameless=False)
                rows.append({**run_apart("pairs", Path(folder), Path(folder), count, wanted.seed), "photos": count})
    print_table("Mapping, one thread", [row for row in rows if row["how"] != "pairs"], FLOWN)
    chosen = [row for row in rows if row["how"] == "pairs"]
    if chosen:
        print_table("Choice of pairs", chosen, PAIRS)
    exponents = {how: exponent([row for row in rows if row["how"] == how]) for how in wanted.mappers}
    for how, value in exponents.items():
        if value is not None:
            print(f"{how}: CPU seconds grow as the photos to the {value:.2f}")
    if wanted.json:
        wanted.json.write_text(json.dumps({"rows": rows, "exponents": exponents}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
