"""A video as a real browser decodes it: Chromium's decoder shares no code with the encoder."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser

SCRIPT = """async ([bytes, type, times]) => {
  const data = Uint8Array.from(atob(bytes), letter => letter.charCodeAt(0));
  const video = document.createElement('video');
  video.muted = true;
  const loaded = new Promise((done, failed) => {
    video.onloadeddata = done;
    video.onerror = () => failed(new Error(video.error.message));
  });
  video.src = URL.createObjectURL(new Blob([data], {type}));
  await loaded;
  document.body.append(video);
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [video.videoWidth, video.videoHeight];
  const pen = canvas.getContext('2d', {willReadFrequently: true});
  const pictures = [];
  for (const time of times) {
    const there = new Promise(done => { video.onseeked = done; });
    const shown = new Promise(done => video.requestVideoFrameCallback(done));
    video.currentTime = time;
    await there;
    await Promise.race([shown, new Promise(done => setTimeout(done, 3000))]);  // no callback where it was shown before
    pen.drawImage(video, 0, 0);
    const pixels = pen.getImageData(0, 0, canvas.width, canvas.height).data;
    let text = '';
    for (let at = 0; at < pixels.length; at += 32768) text += String.fromCharCode(...pixels.subarray(at, at + 32768));
    pictures.push(btoa(text));
  }
  return {width: video.videoWidth, height: video.videoHeight, duration: video.duration, pictures};
}"""


def decoded(browser: Browser, film: Path, times_s: list[float]) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Return Chromium's facts about a video (width, height, duration), and its frames at some times, (h, w, 3) RGB."""
    page = browser.new_page()
    try:
        kind = {".webm": "video/webm", ".mp4": "video/mp4"}[film.suffix]
        video = page.evaluate(SCRIPT, [base64.b64encode(film.read_bytes()).decode(), kind, times_s])
    finally:
        page.close()
    shape = (video["height"], video["width"], 4)
    pictures = [np.frombuffer(base64.b64decode(text), np.uint8).reshape(shape)[:, :, :3] for text in video["pictures"]]
    return video, pictures


def psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return the PSNR of 8-bit images, decibels."""
    return float(20.0 * np.log10(255.0) - 10.0 * np.log10(np.mean((one.astype(float) - other) ** 2)))
