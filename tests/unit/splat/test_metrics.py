"""Image metrics: known answers, and definitions reimplemented in numpy."""

import math

import cv2
import kornia
import numpy as np
import pytest
import torch

from splatpipe.pipeline.splat.quality.metrics import METRICS, gmsd, ms_ssim, psnr, psnr_cc, sharpness, ssim

ATOL = 1e-10  # float64 on both sides; sums of some 1e5 terms


def image(height: int, width: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Coloured bumps and noise, in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    phase = torch.rand(6, generator=generator) * 6
    base = [torch.sin(x / (3 + 2 * phase[i])) * torch.cos(y / (4 + phase[i + 3]) + phase[i]) for i in range(3)]
    noise = torch.rand(height, width, 3, generator=generator)
    return (0.5 + 0.3 * torch.stack(base, dim=-1) + 0.2 * (noise - 0.5)).to(dtype)


def noisy(photo: torch.Tensor, sigma: float = 0.05, seed: int = 9) -> torch.Tensor:
    noise = torch.randn(photo.shape, generator=torch.Generator().manual_seed(seed), dtype=photo.dtype)
    return (photo + sigma * noise).clamp(0, 1)


def blurred(photo: torch.Tensor, sigma: float) -> torch.Tensor:
    chw = photo.permute(2, 0, 1)[None]
    return kornia.filters.gaussian_blur2d(chw, (21, 21), (sigma, sigma))[0].permute(1, 2, 0)


def half_mask(height: int, width: int) -> torch.Tensor:
    mask = torch.ones(height, width, dtype=torch.bool)
    mask[:, : width // 2] = False
    return mask


def numpy_ssim_map(x: np.ndarray, y: np.ndarray, padding: bool) -> tuple[np.ndarray, np.ndarray]:
    """SSIM and its contrast-structure factor of one channel, window by window."""
    offset = np.arange(-5, 6)
    window = np.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    if padding:
        x, y = np.pad(x, 5, mode="reflect"), np.pad(y, 5, mode="reflect")
    patches_x, patches_y = (np.lib.stride_tricks.sliding_window_view(a, (11, 11)) for a in (x, y))

    def mean(patches: np.ndarray) -> np.ndarray:
        return np.einsum("ijkl,kl->ij", patches, window)

    mx, my = mean(patches_x), mean(patches_y)
    dx, dy = patches_x - mx[..., None, None], patches_y - my[..., None, None]
    structure = (2 * mean(dx * dy) + 9e-4) / (mean(dx * dx) + mean(dy * dy) + 9e-4)
    return (2 * mx * my + 1e-4) / (mx**2 + my**2 + 1e-4) * structure, structure


def test_psnr_of_a_known_error():
    photo = torch.full((4, 5, 3), 0.5)
    assert psnr(photo + 0.1, photo) == pytest.approx(20.0, abs=1e-5)  # 0.1 is not exact in float32
    assert psnr(photo, photo) == math.inf
    render, photo = noisy(image(9, 7)), image(9, 7)
    expected = -10 * np.log10(np.mean((render.numpy() - photo.numpy()) ** 2))
    assert psnr(render, photo) == pytest.approx(expected, abs=ATOL)


def test_masked_psnr_is_that_of_the_unmasked_pixels():
    photo, mask = image(12, 20), half_mask(12, 20)
    render = noisy(photo)
    assert psnr(render, photo, mask) == pytest.approx(psnr(render[:, 10:], photo[:, 10:]), abs=ATOL)


def test_psnr_after_colour_fit_forgives_exactly_an_affine_colour_change():
    render = 0.3 + 0.4 * image(20, 30)
    mixing = torch.tensor([[0.8, 0.1, 0.0], [0.05, 0.7, 0.1], [0.0, 0.1, 0.6]], dtype=torch.float64)
    photo = render @ mixing + torch.tensor([0.05, 0.0, 0.1], dtype=torch.float64)
    assert psnr(render, photo) < 30
    assert psnr_cc(render, photo) > 200
    mask = half_mask(20, 30)
    spoilt = torch.where(mask[..., None], photo, 1 - photo)  # what is masked does not spoil the fit
    assert psnr_cc(render, spoilt, mask) > 200


def chessboard(height: int, width: int) -> np.ndarray:
    """Fields of a 32nd of the longer side, the first one True."""
    side = -(-max(height, width) // 32)
    rows, columns = np.mgrid[:height, :width] // side
    return (rows + columns) % 2 == 0


def numpy_psnr_cc(render: np.ndarray, photo: np.ndarray, counts: np.ndarray) -> float:
    """Fitted on the fields of one colour, scored on the other's, and swapped."""
    a = np.concatenate([render, np.ones((*render.shape[:2], 1))], axis=2)
    board, errors = chessboard(*photo.shape[:2]), []
    for scored in (board & counts, ~board & counts):
        fitted = counts & ~scored
        colour = np.linalg.lstsq(a[fitted], photo[fitted], rcond=None)[0]
        errors.append(np.clip(a[scored] @ colour, 0, 1) - photo[scored])
    return float(-10 * np.log10(np.mean(np.concatenate(errors) ** 2)))


@pytest.mark.parametrize("size", [(15, 18), (70, 101)])
def test_psnr_after_colour_fit_fits_each_half_on_the_other(size):
    photo, mask = 0.2 + 0.5 * image(*size), half_mask(*size)
    render = noisy(0.9 * photo, 0.02)
    everything = np.ones(size, bool)
    assert psnr_cc(render, photo) == pytest.approx(numpy_psnr_cc(render.numpy(), photo.numpy(), everything), abs=1e-8)
    expected = numpy_psnr_cc(render.numpy(), photo.numpy(), mask.numpy())
    assert psnr_cc(render, photo, mask) == pytest.approx(expected, abs=1e-8)


def test_colour_fit_is_independent_of_the_pixels_that_it_is_scored_on():
    """A map fitted to all pixels fits some of the noise; separate halves cannot."""
    generator = torch.Generator().manual_seed(3)
    render, photo = (torch.rand(32, 32, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    spread = photo.reshape(-1, 3).std(dim=0, correction=0).square().mean()
    assert psnr_cc(render, photo) < -10 * math.log10(float(spread))  # worse than the photo's mean colour


def test_vignetting_does_not_affect_the_colour_fit():
    """Both halves contain the same share of the corners: the fit is as good as one to all pixels."""
    y, x = np.mgrid[:300, :400]
    fall = 1 - 0.5 * ((x - 200) ** 2 + (y - 150) ** 2) / 250**2
    photo = image(300, 400) * torch.from_numpy(fall)[..., None]
    render = 0.8 * image(300, 400) + 0.05
    a = np.concatenate([render.reshape(-1, 3).numpy(), np.ones((300 * 400, 1))], axis=1)
    fit = a @ np.linalg.lstsq(a, photo.reshape(-1, 3).numpy(), rcond=None)[0]
    on_everything = -10 * np.log10(np.mean((fit - photo.reshape(-1, 3).numpy()) ** 2))
    assert psnr_cc(render, photo) == pytest.approx(on_everything, abs=0.01)


def test_colour_fit_needs_pixels_in_both_halves():
    photo = image(64, 64)
    one_field = torch.zeros(64, 64, dtype=torch.bool)
    one_field[:2, :2] = True
    with pytest.raises(ValueError, match="no pixel"):
        psnr_cc(photo, photo, one_field)


@pytest.mark.parametrize("value", [0.0, 0.7])
def test_colour_fit_of_a_flat_render_gives_the_other_halfs_mean_colour(value):
    photo, board = image(8, 8), torch.from_numpy(chessboard(8, 8))
    flat = torch.full_like(photo, value)
    means = torch.where(board[..., None], photo[~board].mean(dim=0), photo[board].mean(dim=0))
    expected = -10 * math.log10(float((photo - means).square().mean()))
    assert psnr_cc(flat, photo) == pytest.approx(expected, abs=1e-8)


@pytest.mark.parametrize("size", [(6, 6), (7, 31), (24, 17)])
def test_ssim_is_its_definition_and_kornia(size):
    photo = image(*size)
    render = noisy(photo, 0.1)
    maps = [numpy_ssim_map(render[..., c].numpy(), photo[..., c].numpy(), padding=True)[0] for c in range(3)]
    assert ssim(render, photo) == pytest.approx(np.mean(maps), abs=1e-9)  # kornia's 1e-12 in the denominator
    chw = [i.permute(2, 0, 1)[None] for i in (render, photo)]
    assert ssim(render, photo) == pytest.approx(float(kornia.metrics.ssim(*chw, 11).mean()), abs=ATOL)


def test_masked_ssim_replaces_before_windowing_and_averages_what_counts():
    photo, mask = image(20, 30), half_mask(20, 30)
    render = noisy(photo, 0.1)
    replaced = torch.where(mask[..., None], render, photo)
    chw = [i.permute(2, 0, 1)[None] for i in (replaced, photo)]
    expected = kornia.metrics.ssim(*chw, 11)[0][:, mask].mean()
    assert ssim(render, photo, mask) == pytest.approx(float(expected), abs=ATOL)


def test_ms_ssim_is_the_published_product():
    photo = image(176, 181)
    render = noisy(blurred(photo, 1.0), 0.05)
    weights, channels = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333), []
    for c in range(3):
        x, y, value = render[..., c].numpy(), photo[..., c].numpy(), 1.0
        for scale, weight in enumerate(weights):
            full, structure = numpy_ssim_map(x, y, padding=False)
            value *= np.mean(full if scale == 4 else structure) ** weight
            h, w = x.shape[0] // 2 * 2, x.shape[1] // 2 * 2
            x, y = (a[:h, :w].reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3)) for a in (x, y))
        channels.append(value)
    assert ms_ssim(render, photo) == pytest.approx(np.mean(channels), abs=1e-8)


def test_ms_ssim_of_a_small_image_takes_the_scales_that_fit():
    photo = image(11, 13)
    render = noisy(photo)
    maps = [numpy_ssim_map(render[..., c].numpy(), photo[..., c].numpy(), padding=False)[0] for c in range(3)]
    assert ms_ssim(render, photo) == pytest.approx(np.mean(maps), abs=1e-8)


def numpy_gmsd(x: np.ndarray, y: np.ndarray) -> float:
    """Return GMSD like the authors' code, which uses values from 0 to 255."""

    def magnitude(rgb: np.ndarray) -> np.ndarray:
        grey = 255 * (rgb @ np.array([0.299, 0.587, 0.114]))
        h, w = grey.shape[0] // 2 * 2, grey.shape[1] // 2 * 2
        small = np.pad(grey[:h, :w].reshape(h // 2, 2, w // 2, 2).mean(axis=(1, 3)), 1)
        patches = np.lib.stride_tricks.sliding_window_view(small, (3, 3))
        kernel = np.array([[1, 0, -1]] * 3) / 3
        return np.hypot((patches * kernel).sum(axis=(2, 3)), (patches * kernel.T).sum(axis=(2, 3)))

    a, b = magnitude(x), magnitude(y)
    return float(np.std((2 * a * b + 170) / (a * a + b * b + 170)))


@pytest.mark.parametrize("size", [(2, 2), (16, 16), (21, 34)])
def test_gmsd_is_its_definition(size):
    photo = image(*size)
    render = noisy(photo, 0.1)
    assert gmsd(render, photo) == pytest.approx(numpy_gmsd(render.numpy(), photo.numpy()), abs=ATOL)


def test_sharpness_distinguishes_blur_from_overshoot():
    photo = image(64, 64)
    assert sharpness(photo, photo) == 1.0
    softer = [sharpness(blurred(photo, sigma), photo) for sigma in (0.5, 1.0, 2.0)]
    assert 1.0 > softer[0] > softer[1] > softer[2] > 0.0
    assert sharpness(1.5 * photo, photo) == pytest.approx(1.5, rel=0.03)  # the floor of one grey level
    assert sharpness(torch.zeros(5, 5, 3), torch.ones(5, 5, 3)) == 1.0


def test_every_metric_has_its_best_value_for_equal_images():
    photo = image(40, 50)
    best = {"psnr": math.inf, "ssim": 1.0, "ms_ssim": 1.0, "gmsd": 0.0, "sharpness": 1.0}
    for name, value in best.items():
        assert METRICS[name](photo, photo) == pytest.approx(value, abs=1e-8)
    assert psnr_cc(photo, photo) > 200


@pytest.mark.parametrize("name", sorted(METRICS))
def test_no_metric_depends_on_masked_pixels(name):
    photo, mask = image(40, 50), half_mask(40, 50)
    render = noisy(photo)
    other = torch.where(mask[..., None], render, 1 - render)
    other[0, 0] = torch.nan
    assert METRICS[name](other, photo, mask) == METRICS[name](render, photo, mask)


@pytest.mark.parametrize("name", sorted(METRICS))
def test_metrics_are_bit_identical_for_any_number_of_threads(name):
    photo = image(230, 310, dtype=torch.float32)
    render, threads = noisy(photo), (torch.get_num_threads(), cv2.getNumThreads())
    values = []
    try:
        for n in (1, 2, 5):
            torch.set_num_threads(n), cv2.setNumThreads(n)
            values.append(METRICS[name](render, photo, half_mask(230, 310)))
    finally:
        torch.set_num_threads(threads[0]), cv2.setNumThreads(threads[1])
    assert len(set(values)) == 1


@pytest.mark.parametrize("name", sorted(METRICS))
def test_photos_of_eight_bits_are_measured_in_single_precision_to_six_digits(name):
    """Rounding to 8 bits leaves flat and saturated places, where a variance is a small difference of large means."""
    levels = [
        (255 * (1.3 * picture - 0.1).clamp(0, 1)).round() for picture in (noisy(image(230, 310)), image(230, 310))
    ]
    single, double = ([(picture / 255).to(dtype) for picture in levels] for dtype in (torch.float32, torch.float64))
    assert METRICS[name](*single) == pytest.approx(METRICS[name](*double), abs=5e-7)


@pytest.mark.parametrize("name", sorted(METRICS))
def test_metrics_refuse_invalid_images(name):
    measure, photo = METRICS[name], image(12, 12)
    with pytest.raises(ValueError, match="no pixel"):
        measure(photo, photo, torch.zeros(12, 12, dtype=torch.bool))
    with pytest.raises(ValueError, match="not finite"):
        measure(photo * torch.nan, photo)
    with pytest.raises((ValueError, TypeError)):
        measure(photo[:5], photo)


def test_windowed_metrics_name_the_size_that_they_need():
    with pytest.raises(ValueError, match="6 pixels"):
        ssim(image(5, 40), image(5, 40))
    with pytest.raises(ValueError, match="11 pixels"):
        ms_ssim(image(10, 40), image(10, 40))
    with pytest.raises(ValueError, match="2 pixels"):
        gmsd(image(1, 40), image(1, 40))
