"""Render targets into photos and detect them: ``targets PHOTOS [--photos N] [--seed N] [--empty FOLDER …]``.

Targets of random size, tilt (up to 60 degrees), blur, light, exposure, noise and JPEG quality are drawn into each photo
(`target_scenes`), quadrants from 12 px and coded ones from 20 px, and searched for in the whole photo. Reported by
kind and size: the share detected, and the RMS error of the centres along an axis. Photos in the folders of ``--empty``
contain no targets: every detection there is false.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
from target_scenes import Pattern, RenderedTarget, TargetAppearance, bow_tie, coded, disc, quadrants, render

from splatpipe.pipeline.photos.targets.coded_targets import DICTIONARIES, find_coded_targets
from splatpipe.pipeline.photos.targets.quadrant_targets import find_quadrant_targets

SIZES_PX = (12.0, 20.0, 30.0, 45.0)
NEAR_PX = 2.0  # a detection farther from the truth is another one
APART_PX = 100.0
QUADRANTS = {"quadrants": quadrants, "disc": disc, "bow tie": bow_tie}
Results = defaultdict[tuple[str, float], list[tuple[float, float] | None]]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photos", type=Path)
    parser.add_argument("--photos", dest="most", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--empty", type=Path, nargs="*", default=[])
    asked = parser.parse_args()
    cv2.setNumThreads(1)
    rng = np.random.default_rng(asked.seed)
    results: Results = defaultdict(list)
    paths = sorted(path for path in asked.photos.iterdir() if path.suffix.lower() in (".jpg", ".jpeg", ".png"))
    for path in paths[:: max(1, len(paths) // asked.most)]:
        photo = read_photo(path)
        trial(photo, [(kind, pattern) for kind, pattern in QUADRANTS.items() for _ in range(4)], 12.0, rng, results)
        trial(photo, [marker(name, rng) for name in DICTIONARIES], 20.0, rng, results)
    for (kind, size), errors in sorted(results.items()):
        found = np.array([error for error in errors if error is not None]).reshape(-1, 2)
        rms = float(np.sqrt((found**2).mean())) if len(found) else float("nan")
        print(f"{kind:28s} from {size:2.0f} px  {len(found):4d} of {len(errors):4d}  {rms:.3f} px")
    for folder in asked.empty:
        false_finds(folder)


def read_photo(path: Path) -> np.ndarray:
    """Read RGB in the stored orientation."""
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise SystemExit(f"{path} cannot be read")
    return np.ascontiguousarray(pixels[:, :, ::-1])


def marker(name: str, rng: np.random.Generator) -> tuple[str, Pattern]:
    """Return a coded target of a dictionary."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    number = int(rng.integers(0, len(dictionary.bytesList)))
    cells = dictionary.generateImageMarker(number, dictionary.markerSize + 2) > 127
    return f"{name.removeprefix('DICT_').lower()}:{number}", coded(cells.astype(np.uint8))


def trial(
    photo: np.ndarray, kinds: list[tuple[str, Pattern]], least: float, rng: np.random.Generator, results: Results
) -> None:
    """Draw targets into a photo and detect them."""
    drawn, placed = render(photo, kinds, TargetAppearance((least, SIZES_PX[-1])), rng, APART_PX)
    finds = {"": [(t.x, t.y) for t in find_quadrant_targets(drawn)]} if least < SIZES_PX[1] else {}
    if not finds:
        for target in find_coded_targets(drawn):
            finds.setdefault(f"{target.dictionary}:{target.number}", []).append((target.x, target.y))
    for target in placed:
        size = max(each for each in SIZES_PX if each <= max(target.size_px, SIZES_PX[0]))
        results[target.name.split(":")[0], size].append(error_of(target, finds.get(target.name, finds.get("", []))))


def error_of(target: RenderedTarget, finds: list[tuple[float, float]]) -> tuple[float, float] | None:
    """Return the error of the nearest detection; None if none is near."""
    errors = [(x - target.centre[0], y - target.centre[1]) for x, y in finds]
    near = [error for error in errors if np.hypot(*error) < NEAR_PX]
    return min(near, key=lambda error: np.hypot(*error), default=None)


def false_finds(folder: Path) -> None:
    """Print false detections in photos without targets."""
    began, pixels, photos, found = time.process_time(), 0.0, 0, 0
    for path in sorted(each for each in folder.iterdir() if each.suffix.lower() in (".jpg", ".jpeg", ".png")):
        photo = read_photo(path)
        photos, pixels = photos + 1, pixels + photo.shape[0] * photo.shape[1] / 1e6
        for target in (*find_quadrant_targets(photo), *find_coded_targets(photo)):
            found += 1
            print(f"  {path.name} {target}")
    seconds = (time.process_time() - began) / pixels
    print(f"{folder}: {found} false in {photos} photos, {seconds:.3f} CPU s a megapixel")


if __name__ == "__main__":
    main()
