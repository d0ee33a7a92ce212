"""Streams one picture under many names, and prints the peak memory of few photos and of many; for test_stream.py.

Arguments: a picture, a folder for the cache, few, many, epochs.
"""

import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.engine.runs.peak_memory import peak_memory_bytes
from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.windows import TrainingSize


def main(picture: str, cache: str, few: str, many: str, epochs: str) -> None:
    height, width = cv2.imread(picture).shape[:2]
    camera = Camera("photo", width, height, width, width, width / 2, height / 2, np.eye(4))
    for count in (int(few), int(many)):
        views = [View(replace(camera, name=str(number)), Path(picture), None) for number in range(count)]
        with PhotoStream.over(views, [TrainingSize()] * (count * int(epochs)), 0, 1, Path(cache)) as photos:
            assert sum(float(photo.colour[0, 0, 0]) >= 0.0 for photo in photos) == count * int(epochs)
        print(peak_memory_bytes())


if __name__ == "__main__":
    main(*sys.argv[1:])
