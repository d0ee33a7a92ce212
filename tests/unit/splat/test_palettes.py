"""Codebooks and palettes, against known optima."""

from __future__ import annotations

import numpy as np
import torch

from splatpipe.pipeline.splat.containers.codebooks import fit_codebook, nearest_codes
from splatpipe.pipeline.splat.containers.palettes import fit_palette


def test_a_codebook_of_evenly_spread_numbers_is_even() -> None:
    values = np.random.default_rng(1).permutation(np.linspace(-1.0, 1.0, 51_200).astype(np.float32))
    codebook = fit_codebook(values)
    assert np.allclose(codebook, (np.arange(256) + 0.5) / 128 - 1.0, atol=2e-4)
    errors = codebook[nearest_codes(values, codebook)] - values
    assert np.abs(errors).max() <= 1.05 / 256


def test_a_codebook_of_normal_numbers_is_as_good_as_the_theory_predicts() -> None:
    """Panter and Dite: √3 π / 2 over the square of the number of levels, of the variance."""
    values = np.random.default_rng(1).normal(size=200_000).astype(np.float32)
    errors = fit_codebook(values)[nearest_codes(values, fit_codebook(values))] - values
    assert np.mean(errors**2) < 1.1 * np.sqrt(3.0) * np.pi / 2 / 256**2


def test_weights_move_a_codebook() -> None:
    values = np.random.default_rng(1).uniform(0.0, 2.0, 50_000).astype(np.float32)
    codebook = fit_codebook(values, np.where(values < 1.0, 1000.0, 1.0).astype(np.float32))
    assert 200 < int((codebook < 1.0).sum()) < 256  # the cube root of the weights: 10 to 1


def test_few_distinct_numbers_are_kept() -> None:
    values = np.array([3.0, -1.0, 3.0, 0.25], np.float32)
    assert np.array_equal(fit_codebook(values)[nearest_codes(values, fit_codebook(values))], values)
    assert np.array_equal(fit_codebook(np.zeros(0, np.float32)), np.zeros(256, np.float32))


def test_a_palette_finds_clusters_and_nearly_the_nearest_entry() -> None:
    generator = torch.Generator().manual_seed(2)
    centres = torch.randn(64, 24, generator=generator)
    rows = centres[torch.arange(6000) % 64] + 0.01 * torch.randn(6000, 24, generator=generator)
    palette, labels = fit_palette(rows, 512)
    assert ((rows - palette[labels]) ** 2).sum(1).mean() < 24 * 0.01**2
    noise = torch.randn(6000, 24, generator=generator)
    palette, labels = fit_palette(noise, 2048)
    found = ((noise - palette[labels]) ** 2).sum(1)
    best = torch.cdist(noise, palette).square().amin(1)
    assert found.mean() < 1.05 * best.mean()


def test_every_round_improves_and_heavy_entries_are_kept() -> None:
    generator = torch.Generator().manual_seed(3)
    rows = torch.randn(4000, 24, generator=generator)
    weights = torch.ones(4000)
    weights[::8] = 1000.0
    errors = []
    for iterations in range(4):
        palette, labels = fit_palette(rows, 1024, weights, iterations)
        squares = ((rows - palette[labels]) ** 2).sum(1)
        errors.append(float((weights * squares).mean()))
        assert squares[::8].mean() < 0.01
    assert errors == sorted(errors, reverse=True)
