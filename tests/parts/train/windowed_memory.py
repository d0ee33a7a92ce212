"""Streams windows of one picture under three names within a limit of memory; for test_windows.py.

What decodes them may take what a photo takes; afterwards only so many bytes more can be had.

Arguments: a picture, a folder for the cache, pixels of a window (0: whole photos), bytes.
"""

import resource
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.photos.pixels.dataset import View
from splatpipe.pipeline.train.photos.stream import PhotoStream
from splatpipe.pipeline.train.plan.windows import TrainingSize

FIRST = 6  # photos, halved often, without a limit: threads and allocators take what they need once
MORE = 30


def main(picture: str, cache: str, window_pixels: str, more_bytes: str) -> None:
    height, width = cv2.imread(picture).shape[:2]
    camera = Camera("photo", width, height, width, width, width / 2, height / 2, np.eye(4))
    views = [View(replace(camera, name=str(number)), Path(picture), None) for number in range(3)]
    warm_up = [TrainingSize(3)] * FIRST
    with PhotoStream.over(views, warm_up + [TrainingSize(0, int(window_pixels))] * MORE, 0, 1, Path(cache)) as photos:
        for _ in views:  # by then each is decoded and stored
            next(photos)
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + int(more_bytes), resource.RLIM_INFINITY))
        print(sum(float(photo.colour[0, 0, 0]) >= 0.0 for photo in photos))


if __name__ == "__main__":
    main(*sys.argv[1:])
