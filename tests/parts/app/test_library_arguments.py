"""Arguments of other types than the library's: converted, or refused with a sentence."""

from __future__ import annotations

import subprocess
import sys

UNCHECKED = """
import numpy as np, torch
import splatpipe
from splatpipe import Splat, SplatpipeError

arrays = [torch.full((5, 3), 0.5), torch.zeros(5, 3), torch.ones(5, 4), torch.zeros(5), torch.zeros(5, 1, 3)]
trained = [array.clone().requires_grad_() for array in arrays]
splat = Splat(*trained)
assert np.array_equal(splat.means, arrays[0].numpy())
means, log_scales, quats, logits, sh = trained
assert len(Splat.of_activated(means, log_scales.exp(), quats, logits.sigmoid(), sh)) == 5
far = Splat([[4e5 + 0.125, 5e6, 0.0]] * 5, *trained[1:])
assert far.means[0, 0] + far.origin[0] == 4e5 + 0.125
assert np.isfinite(splatpipe.look_at((0, 0, 0), (0, 5, 0), up=(0, 1, 0)).cam_from_world).all()
assert splatpipe.Similarity.identity() == splatpipe.Similarity.identity() != None
camera = splatpipe.look_at((0, 0, 9), (0, 0, 0))
assert camera == splatpipe.look_at((0, 0, 9), (0, 0, 0)) != splatpipe.look_at((0, 0, 8), (0, 0, 0))
for call, said in (
    (lambda: splatpipe.look_at((0, 0, 9), (0, 0, 0), up=(0, 0, 0)), "up is not zero"),
    (lambda: splatpipe.look_at((0, 0, 9), (0, 0, float("nan"))), "finite"),
    (lambda: splatpipe.look_at((0, 0, 9), (0, 0, 0), width=64.5), "cannot be drawn"),
    (lambda: Splat(*trained[:4], "sh"), "sh is not an array"),
    (lambda: splat.turned("sideways"), "no axes"),
    (lambda: splatpipe.read_splat("missing.ply", axes="sideways"), "no axes"),
    (lambda: splatpipe.fit_similarity(np.eye(3), np.eye(3), 1.0, max_error="x"), "max_error"),
    (lambda: splatpipe.open_run("a\\0b"), "character 0"),
    (lambda: splatpipe.run_capture(".", "a\\0b"), "character 0"),
    (lambda: splatpipe.run_capture(".", "out", rerun="train"), "not several stages"),
):
    try:
        call()
    except SplatpipeError as error:
        assert said in str(error) and error.hint, error
    else:
        raise AssertionError(said)
"""


def test_what_has_another_type_is_converted_or_refused() -> None:
    done = subprocess.run([sys.executable, "-c", UNCHECKED], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr  # in a process of its own: without the tests' checks of types
