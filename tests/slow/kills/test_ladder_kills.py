"""Every rung of the ladder in one run of the stage: killed in each, a rerun gives the same bits."""

import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import corner_photos
import numpy as np
import pycolmap
import pytest
from repository import LINES, environment

from splatpipe.pipeline.sfm.options import FeaturesConfig, MatchesConfig
from splatpipe.stages import features, matches

KILLED_LADDER = Path(__file__).with_name("killed_ladder.py")
BODY = {1, 3, 5, 7, 9, 10}
OTHER = {2, 4, 6}  # a model of its own, tied to the body by some matches
FAINT = 8  # has too few matches for the mapper
APART = 11  # no pair with it was tried
WEAK = 12  # hardly any keypoints
TIES = {(2, 3): 16, (3, 4): 16, (5, 6): 16, (7, 8): 15, (8, 9): 15}
FEW = 40
RUNGS = ("placing the remaining photos", "joining models", "matching", "more keypoints")


def prepare(folder: Path) -> None:
    """Photos, and the output of the stages before `sparse`, with work for each rung."""
    names = [f"{number:02}.png" for number in range(1, WEAK + 1)]
    inputs = corner_photos.write_capture(folder, corner_photos.room(names, step_deg=6.0))
    prepared = folder / "photos" / "prepared"
    (prepared / "ingest").mkdir(parents=True)
    (folder / "part").rename(prepared / "ingest" / "photos")
    for name in ("cameras.json", "positions.json", "lenses.json"):
        (folder / name).rename(prepared / "ingest" / name)
    parts = {f"ingest__{name}": prepared / "ingest" / name for name in ("photos",)}
    parts |= {f"ingest__{name}": prepared / "ingest" / f"{name}.json" for name in ("cameras", "positions", "lenses")}
    inputs = corner_photos.with_parts(inputs, **parts)
    recorder = corner_photos.Recorder()
    for stage in ("features", "matches"):
        (prepared / stage).mkdir()
    config = FeaturesConfig(extractor="opencv-sift", max_features=800)
    features.run(config, inputs, prepared / "features", recorder)
    weaken(prepared / "features")
    inputs = corner_photos.with_parts(inputs, features__database=prepared / "features" / "database.db")
    matches.run(MatchesConfig(), inputs, prepared / "matches", recorder)
    thin(prepared / "matches")


def weaken(folder: Path) -> None:
    """Leave one photo, the last, only a few keypoints."""
    with pycolmap.Database.open(folder / "database.db") as database:
        keypoints = database.read_keypoints(WEAK)
        kind = pycolmap.FeatureExtractorType.SIFT
        found = {number: database.read_descriptors(number).data for number in range(1, WEAK + 1)}
        database.clear_descriptors()
        found[WEAK] = found[WEAK][:FEW]
        for number, values in found.items():
            database.write_descriptors(number, pycolmap.FeatureDescriptors(kind, values))
        database.update_keypoints(WEAK, keypoints[:FEW])
    colours = np.load(folder / "colours.npy")
    np.save(folder / "colours.npy", colours[: len(colours) - len(keypoints) + FEW])


def thin(folder: Path) -> None:
    pairs = json.loads((folder / "pairs.json").read_text())
    pairs["pairs"] = [row for row in pairs["pairs"] if f"{APART:02}.png" not in row[:2]]
    (folder / "pairs.json").write_text(json.dumps(pairs))
    with pycolmap.Database.open(folder / "database.db") as database:
        found = {
            pycolmap.pair_id_to_image_pair(number): geometry
            for number, geometry in zip(*database.read_two_view_geometries(), strict=True)
        }
        seen: Counter[tuple[int, int]] = Counter()
        for (i, j), geometry in found.items():
            if {i, j} <= BODY or {i, j} <= OTHER:
                for first, second in np.asarray(geometry.inlier_matches).tolist():
                    seen.update([(i, first), (j, second)])
        for (i, j), geometry in found.items():
            if {i, j} <= BODY or {i, j} <= OTHER:
                continue
            database.delete_two_view_geometry(i, j)
            if (i, j) in TIES:
                rows = np.asarray(geometry.inlier_matches)
                # Those most certain to have a point in the photos' models.
                sure = [min(seen[n, row] for n, row in ((i, a), (j, b)) if n != FAINT) for a, b in rows.tolist()]
                geometry.inlier_matches = rows[np.argsort(-np.array(sure), kind="stable")[: TIES[i, j]]]
                database.write_two_view_geometry(i, j, geometry)


def run(photos: Path, out: Path, stop_at: str = "", threads: int = 1) -> int:
    command = [sys.executable, KILLED_LADDER, photos, out, stop_at, str(threads)]
    # The stages' own processes import the line's bodies, too.
    done = subprocess.run(command, check=False, start_new_session=True, capture_output=True, env=environment(LINES))
    assert done.returncode in (0, -signal.SIGKILL), done.stderr.decode()[-3000:]
    return done.returncode


def digests(out: Path) -> dict[str, str]:
    manifest = json.loads(next((out / "stages").glob("sparse-*/manifest.json")).read_text())
    return {name: part["digest"] for name, part in manifest["parts"].items()}


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("left")
    prepare(folder)
    return folder / "photos"


def test_every_rung_places_its_photos_and_a_kill_in_any_changes_no_bit(photos: Path, tmp_path: Path) -> None:
    assert run(photos, tmp_path / "whole") == 0
    (summary,) = (tmp_path / "whole" / "stages").glob("sparse-*/models.json")
    content = json.loads(summary.read_text())
    assert content["registered"] == WEAK, content["ladder"]
    assert [(row["rung"], row["placed"]) for row in content["ladder"]] == [
        ("registration", 4),
        ("more pairs", 1),
        ("stronger keypoints", 1),
    ]
    assert content["ladder"][0]["models_joined"] == 1
    out = tmp_path / "killed"
    for rung in RUNGS:
        assert run(photos, out, rung) == -signal.SIGKILL, f"{rung} was never reported"
        assert not list((out / "stages").glob("sparse-*")), f"{rung}: left in spite of the kill"
    assert run(photos, out, threads=2) == 0
    assert digests(out) == digests(tmp_path / "whole")
    assert list((out / "stages" / ".partial").iterdir()) == []
