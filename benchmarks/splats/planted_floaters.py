"""Plant floaters into a run's model, and count how many the cleaner finds: ``planted_floaters OUT [--seed 19]``.

The planting rule is that of `floater_planting`, not the cleaner's. Required: 95 % found, of each kind; at most 0.5 %
of the building's Gaussians lost, where photos see a surface; and the cleaned trained model reproduces the held-out
photos as before, within 0.05 dB of psnr_cc.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from floater_planting import KINDS, FloaterScene, plant, render_depths
from jaxtyping import Bool
from opened_run import OpenedRun, open_run
from tables import Row, print_table

from splatpipe.pipeline.edit.floaters.cleaning import clean_scene
from splatpipe.pipeline.edit.floaters.visibility import TrainingPhotos
from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.images import Mask, Pixels, reduced_camera, reduced_view
from splatpipe.pipeline.render.rendering import Model, render_pixels
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.quality.metrics import psnr, psnr_cc

ASKED_FOUND, MAX_LOST, MAX_LOSS_DB = 0.95, 0.005, 0.05
DEPTH_MEGAPIXELS = 0.07  # size of a render that locates surfaces

KIND_COLUMNS = {"kind": "kind:", "planted": "planted:,", "found": "found:,", "share": "share:.4f", "bars": "bars:"}
LOSS_COLUMNS = {
    "model": "model:",
    "Gaussians": "gaussians:,",
    "taken away": "taken:,",
    "of the building": "lost:.5f",
    "bars": "bars:",
}
PICTURE_COLUMNS = {
    "photo": "photo:",
    "trained psnr_cc": "trained:.3f",
    "cleaned": "cleaned:.3f",
    "with floaters": "planted:.3f",
    "cleaned of them": "planted_cleaned:.3f",
    "its likeness to trained dB": "alike:.2f",
    "bars": "bars:",
}


def photos_of(run: OpenedRun) -> TrainingPhotos:
    """Return the photos passed to the cleaner: those of the training, none that was held out."""
    views = [view for view in run.views if view.camera.name not in run.held_out]

    def picture(index: int) -> tuple[Pixels, Mask | None]:
        return reduced_view(views[index], SEEN_MEGAPIXELS)[1:]

    cameras = [reduced_camera(view.camera, SEEN_MEGAPIXELS) for view in views]
    return TrainingPhotos(cameras, run.options, picture, run.model[1])


def kept_by_cleaner(model: Gaussians, photos: TrainingPhotos | None) -> Bool[np.ndarray, " n"]:
    """Return which Gaussians the cleaner keeps."""
    return np.asarray(clean_scene(model, photos).keep.numpy())


def kind_rows(planted: FloaterScene, kept: Bool[np.ndarray, " n"]) -> list[Row]:
    """Return a row per kind and one for all: how many floaters were removed."""
    gone = ~kept[planted.trained :]
    rows = []
    for number, kind in enumerate((*KINDS, "all")):
        mask = np.ones(len(gone), bool) if kind == "all" else planted.kinds == number
        share = float(gone[mask].mean())
        row: Row = {"kind": kind, "planted": int(mask.sum()), "found": int(gone[mask].sum()), "share": share}
        rows.append(row | {"bars": "met" if share >= ASKED_FOUND else "missed"})
    return rows


def loss_row(planted: FloaterScene, kept: Bool[np.ndarray, " n"], model: str) -> Row:
    """Return how much of the trained model was lost."""
    gone = ~kept[: planted.trained]
    lost = float(gone[planted.building].mean())
    row: Row = {"model": model, "gaussians": planted.trained, "taken": int(gone.sum()), "lost": lost}
    return row | {"bars": "met" if lost <= MAX_LOST else "missed"}


def picture_rows(run: OpenedRun, models: dict[str, Model]) -> list[Row]:
    """Compare each held-out photo with renders of all models."""
    rows = []
    for view in run.views:
        if view.camera.name not in run.held_out:
            continue
        camera, pixels, mask = reduced_view(view, run.megapixels)
        photo = torch.from_numpy(pixels).float() / 255.0
        counts = None if mask is None else torch.from_numpy(mask)
        renders = {name: _render(run, model, camera) for name, model in models.items()}
        row: Row = {"photo": view.camera.name}
        row |= {name: psnr_cc(render, photo, counts) for name, render in renders.items()}
        row["alike"] = psnr(renders["planted_cleaned"], renders["trained"])
        rows.append(row)
    means: Row = {"photo": "mean"}
    means |= {key: float(np.mean([row[key] for row in rows])) for key in rows[0] if key != "photo"}
    worse = means["trained"] - means["cleaned"]
    return [*rows, means | {"bars": "met" if worse <= MAX_LOSS_DB else "missed"}]


def _render(run: OpenedRun, model: Model, camera: Camera) -> torch.Tensor:
    return torch.from_numpy(render_pixels(model, camera, run.options)).float() / 255.0


def main() -> None:
    """Plant, clean, count."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="a finished run")
    parser.add_argument("--seed", type=int, default=19)
    parser.add_argument("--share", type=float, default=0.004, help="floaters of each kind a Gaussian")
    parser.add_argument("--without-photos", action="store_true", help="as of a file whose run nobody knows")
    parser.add_argument("--json", type=Path, help="leaves all figures here, too")
    options = parser.parse_args()
    run = open_run(options.out)
    model, sky = run.model
    training = [view for view in run.views if view.camera.name not in run.held_out]
    views = render_depths(model, [reduced_camera(view.camera, DEPTH_MEGAPIXELS) for view in training], run.options)
    per_kind = max(40, math.ceil(options.share * len(model) / 40) * 40)
    planted = plant(model, views, run.options, per_kind, np.random.default_rng(options.seed))
    photos = None if options.without_photos else photos_of(run)
    start = time.process_time()
    kept = kept_by_cleaner(planted.model, photos)
    seconds = time.process_time() - start
    plain = kept_by_cleaner(model, photos)
    found = kind_rows(planted, kept)
    lost = [loss_row(planted, kept, "with floaters"), loss_row(planted, np.append(plain, True), "as trained")]
    alike = picture_rows(
        run,
        {
            "trained": (model, sky),
            "cleaned": (model.select(torch.from_numpy(plain)), sky),
            "planted": (planted.model, sky),
            "planted_cleaned": (planted.model.select(torch.from_numpy(kept)), sky),
        },
    )
    title = f"planted into {options.out.name}, seed {options.seed}; cleaned in {seconds:.1f} CPU s"
    print_table(title, found, KIND_COLUMNS)
    print_table("lost", lost, LOSS_COLUMNS)
    print_table("held-out photos", alike, PICTURE_COLUMNS)
    if options.json is not None:
        figures = {"found": found, "lost": lost, "pictures": alike, "cpu_s": seconds}
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
