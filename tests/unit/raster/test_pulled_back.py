"""Gradients of weighted sums of a picture."""

import torch

from splatpipe.pipeline.raster.pulled_back import pulled_back


def test_weights_are_passed_back_to_the_leaf():
    leaf, weights = torch.rand(4, 5, 3).requires_grad_(), torch.rand(4, 5, 3)
    torch.testing.assert_close(pulled_back(2.0 * leaf, weights, leaf), 2.0 * weights, rtol=0.0, atol=0.0)
