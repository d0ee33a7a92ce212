"""The sizes of a run that its costs follow from, by the capture's size and the options. Light to import."""

from __future__ import annotations

from splatpipe.pipeline.edit.options import SEEN_MEGAPIXELS
from splatpipe.pipeline.film.options import MAX_FILM_MEGAPIXELS
from splatpipe.pipeline.render.options import JUDGED_MEGAPIXELS
from splatpipe.pipeline.train.options import FILM_FROM_BUDGET_S
from splatpipe.pipeline.web.options import parse_formats
from splatpipe.stages.forecast.costs import FORMAT_COSTS, WITH_PHOTOS, Costs, Sizes
from splatpipe.stages.forecast.training import MEGA, CaptureSize, Training
from splatpipe.stages.options import LineConfig

SIFT_WORK = {"opencv-sift": 1.0, "sift": 3.2}  # CPU seconds per pixel relative to OpenCV's: 2.4 on sceaux, 4.3 on demo
SIFT_MEMORY = {"opencv-sift": 1.0, "sift": 1.5}  # memory per thread relative to OpenCV's
MAX_KEYPOINTS = 1.3  # times max_features: several orientations, whole scales
NEIGHBOURS = 20  # per photo, behind `Costs.pairs`
PHOTOS_OF_ONE_COST = 50  # up to this many photos, mapping costs the constant per photo; with more photos it costs more
WITHOUT_POSITIONS = 1.8  # times the mapping cost: pairs that only look alike, doubts, second mappings
RETRIED_MEGAPIXELS = 4.3  # size of an image in which unplaced photos get further keypoints, on half of the threads
TARGETS_TILE = 2.4  # megapixels of a tile in which targets are searched


def sizes_of(size: CaptureSize, config: LineConfig, threads: int, costs: Costs, training: Training) -> Sizes:
    """Return the sizes of a run, by name; the arguments are those of ``RunForecast``.

    Pixels are in millions and of all photos, but for those that the threads hold `at_once`.
    """
    photos, dataset, extractor = float(size.photos), training.size.megapixels, config.features.extractor
    searched = min(size.megapixels, size.shape * config.features.max_image_size**2 / MEGA)
    photo_keypoints = min(MAX_KEYPOINTS * config.features.max_features, costs.keypoints[extractor] * searched)
    pairs = _pairs(size, config, costs.pairs)
    formats = set(parse_formats(config.export.formats))
    each = [FORMAT_COSTS[name] for name in formats & set(FORMAT_COSTS)]
    return {
        "threads": float(threads),
        "photos": photos,
        "crowd": max(1.0, photos / PHOTOS_OF_ONE_COST),
        "pixels": photos * size.megapixels,
        "pixels_at_once": threads * size.megapixels,
        "searched": photos * searched * SIFT_WORK[extractor],  # pixels, for keypoints
        "searched_at_once": threads * searched * SIFT_MEMORY[extractor],
        "keypoints": photos * photo_keypoints,
        "pairs": pairs,
        "compared": pairs * photo_keypoints,
        "doubt": 1.0 if size.positions else WITHOUT_POSITIONS,
        "retried_at_once": max(1, threads // 2) * min(size.megapixels, RETRIED_MEGAPIXELS),
        "control_pixels": size.control * photos * size.megapixels,
        "tiles_at_once": size.control * threads * min(size.megapixels, TARGETS_TILE),
        "dataset": photos * dataset,  # pixels
        "dense_photos": photos if config.initialize.dense else 0.0,
        **_training_sizes(training, costs.flat),
        "seen": photos * min(dataset, SEEN_MEGAPIXELS),  # pixels, by `clean`
        "judged": _judged_photos(size, config) * min(dataset, JUDGED_MEGAPIXELS),  # pixels
        "filmed": _film_megapixels(config, training.megapixels),
        "depths": photos * min(dataset, config.depths.max_megapixels),  # pixels
        "exported": training.gaussians * (1.0 + sum(work for work, _bytes in each)),
        "format_bytes": training.gaussians * sum(size for _work, size in each),
        "exported_dataset": photos * dataset if WITH_PHOTOS & formats else 0.0,
    }


def _training_sizes(training: Training, flat: float) -> Sizes:
    """Sizes of the training of the whole scene, or of the coarse pass and the blocks; memory is an upper bound."""
    config, division, gaussians = training.config, training.division, training.gaussians
    trained, frozen, coarse = gaussians, 0, 0.0
    if division is not None:
        trained, coarse = training.block_gaussians(division), min(float(division.coarse_cap), gaussians)
        frozen = min(division.need.frozen, int(coarse))
    ends_flat = config.stop_when_flat and not config.time_budget_s and division is None
    iterations = sum(count for _level, count in training.finer) * (flat if ends_flat else 1.0)
    of_one = training.of_process(iterations, int(trained), frozen, training.share)
    of_coarse = training.of_process(sum(count for _level, count in training.coarse), int(coarse))
    return {
        **of_one,
        "training_bytes": of_one["training_bytes"] if division is None else division.need.memory_bytes,
        "gaussians": gaussians,
        "written": gaussians + (0.0 if division is None else division.blocks * trained),  # Gaussians
        "cached": training.photos_per_block * training.megapixels,  # pixels of decoded photos on disk
        "coarse": coarse,  # Gaussians
        "coarse_work": of_coarse["work"],
        "coarse_bytes": of_coarse["training_bytes"],
        "coarse_cached": sum(training.size.photos * training.megapixels / 4**level for level, _ in training.coarse),
    }


def _pairs(size: CaptureSize, config: LineConfig, per_photo: float) -> float:
    """Number of photo pairs that are matched."""
    photos, options = size.photos, config.matches
    every = photos * (photos - 1) / 2
    small = photos <= options.exhaustive_up_to and not size.positions
    if options.pairing == "exhaustive" or (options.pairing == "auto" and small):
        return every
    return min(every, per_photo * photos * options.neighbours / NEIGHBOURS)


def _judged_photos(size: CaptureSize, config: LineConfig) -> int:
    """Number of held-out photos that are judged."""
    split, most = config.split, config.evaluate.most_views
    named = sum(bool(name.strip()) for name in split.views.split(","))
    held_out = named or (-(-size.photos // split.every) if split.every else 0)
    return min(held_out, most) if most else held_out


def _film_megapixels(config: LineConfig, megapixels: float) -> float:
    """Megapixels of all frames of the film, by those of a training photo."""
    film = config.flythrough
    if 0.0 < config.train.time_budget_s < FILM_FROM_BUDGET_S:
        return 0.0
    size = film.film_size
    return film.seconds * film.fps * (size[0] * size[1] / MEGA if size else min(megapixels, MAX_FILM_MEGAPIXELS))
