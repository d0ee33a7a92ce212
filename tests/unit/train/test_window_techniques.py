"""Techniques on windows: a photo's windows, weighted by their shares, give the same as the whole photo."""

import cv2
import numpy as np
import pytest
import skies
import tiny_scene
import torch
from torch import Tensor

from splatpipe.pipeline.geometry.camera import Camera
from splatpipe.pipeline.raster import rasterizer
from splatpipe.pipeline.raster.loss import photo_loss
from splatpipe.pipeline.raster.rasterizer import RenderOptions
from splatpipe.pipeline.splat.model.gaussians import Gaussians
from splatpipe.pipeline.splat.model.sh import rgb_to_dc
from splatpipe.pipeline.splat.sky.panorama import COLUMNS, ROWS, STEP_PX
from splatpipe.pipeline.splat.sky.sky_mask import SkyMask
from splatpipe.pipeline.train.appearance.exposure import Exposure
from splatpipe.pipeline.train.appearance.photo_cells import PhotoCells
from splatpipe.pipeline.train.appearance.photo_sky import photo_sky_on_cpu, photo_sky_on_device
from splatpipe.pipeline.train.appearance.robust import GRID, UNKNOWN, RobustMask
from splatpipe.pipeline.train.appearance.sky import SkyModel
from splatpipe.pipeline.train.hooks import RenderedView
from splatpipe.pipeline.train.iteration import SSIM_WEIGHT
from splatpipe.pipeline.train.options import TrainConfig
from splatpipe.pipeline.train.photos.stream import TrainingPhoto
from splatpipe.pipeline.train.plan.schedule import ScheduleStep, resolve_schedule
from splatpipe.pipeline.train.plan.windows import windows_of
from splatpipe.pipeline.train.state.density import Density
from splatpipe.pipeline.train.techniques.distortion_loss import DistortionLoss
from splatpipe.pipeline.train.techniques.techniques import Techniques

LOOK = skies.aimed_camera(12.0, roll_deg=4.0)
CAMERA = LOOK.scaled(331, 247)
WINDOW_PIXELS = 16_000  # six windows of it
FLOAT32 = 2e-4  # relative error of a sum over a picture, added up in another order
LATE = resolve_schedule(TrainConfig(iterations=100)).at(60)  # every technique takes part


def gaussians(count: int = 400) -> Gaussians:
    """Blobs in front of the camera, from the ground to the sky."""
    drawn = torch.Generator().manual_seed(3)
    found = Gaussians.empty(count, 0)
    pixels = torch.rand(count, 2, generator=drawn).double().numpy() * [CAMERA.width, CAMERA.height]
    depths = 6.0 + 14.0 * torch.rand(count, generator=drawn).double().numpy()
    found.means = torch.from_numpy(CAMERA.unproject(pixels, depths)).float()
    found.log_scales = -1.2 + 0.5 * torch.randn(count, 3, generator=drawn)
    found.quats = torch.randn(count, 4, generator=drawn)
    found.opacity_logits = torch.randn(count, generator=drawn)
    found.sh = rgb_to_dc(torch.rand(count, 3, generator=drawn))[:, None]
    return found.requires_grad_()


def windows(whole: TrainingPhoto, pixels: int = WINDOW_PIXELS) -> list[TrainingPhoto]:
    """A photo's windows, as the stream makes them."""
    width, height = whole.camera.width, whole.camera.height
    counts = torch.ones(height, width, dtype=torch.bool) if whole.mask is None else whole.mask
    found = []
    for window in windows_of(width, height, pixels):
        cut = window.grown(width, height)
        rows, columns = slice(cut.top, cut.bottom), slice(cut.left, cut.right)
        inner = window.within(cut)
        here = counts[window.top : window.bottom, window.left : window.right].sum()
        camera = whole.camera.crop(cut.left, cut.top, cut.width, cut.height)
        mask = None if whole.mask is None else whole.mask[rows, columns]
        share = float(here / counts.sum())
        found.append(TrainingPhoto(camera, whole.colour[rows, columns], mask, bool(here == 0), inner, share))
    assert len(found) > 3
    return found


def the_photo(mask: Tensor | None = None) -> TrainingPhoto:
    pixels = cv2.resize(skies.trace(LOOK)[0].pixels, (CAMERA.width, CAMERA.height), interpolation=cv2.INTER_CUBIC)
    return TrainingPhoto(CAMERA, torch.from_numpy(pixels).float() / 255.0, mask)


def the_sky() -> SkyModel:
    _, sky = skies.trace(LOOK)
    colours = torch.rand(ROWS * COLUMNS, 3, generator=torch.Generator().manual_seed(8)).numpy()
    return SkyModel(skies.UP, colours, {CAMERA.name: SkyMask.packed(sky)})


def said(photos: list[TrainingPhoto], weights: list[float], penalties: bool) -> dict[str, Tensor]:
    """The weighted loss of some photos with its gradients by all that is trained."""
    model, sky, exposure = gaussians(), the_sky(), Exposure([CAMERA.name, "another"])
    each = (sky, exposure, DistortionLoss(0.5, 20)) if penalties else (exposure,)
    techniques = Techniques(each)
    total = torch.zeros(())
    for photo, weight in zip(photos, weights, strict=True):
        given = RenderOptions(0, background=LATE.background, near=0.5, depth=False)
        settings = techniques.settings(given, model, photo.camera, LATE)
        rendered = rasterizer.render(model, photo.camera, settings)
        rendered_view = RenderedView(photo, rendered, settings, LATE)
        loss = photo_loss(
            techniques.apply_appearance(rendered_view), photo.colour, SSIM_WEIGHT, photo.mask, photo.inner
        )
        total = total + weight * techniques.with_penalties(loss, rendered_view)
    total.backward()  # type: ignore[no-untyped-call]
    found = {name: tensor.grad for name, tensor in model.tensors().items()}
    found |= {"exposure": exposure.tensors["deviations"].grad, "loss": total.detach()}
    if penalties:
        found["sky"] = sky.tensors["colours"].grad
    return found


@pytest.mark.parametrize("masked", [False, True])
def test_windows_weighted_by_their_shares_give_the_whole_photos_loss(masked: bool) -> None:
    mask = torch.rand(CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(5)) > 0.3 if masked else None
    if mask is not None:
        mask[:60, 100:] = False  # a window with few unmasked pixels
    whole = the_photo(mask)
    parts = windows(whole)
    assert sum(part.share for part in parts) == pytest.approx(1.0)
    expected = said([whole], [1.0], penalties=not masked)  # penalties are means over all pixels, masked or not
    found = said(parts, [part.share for part in parts], penalties=not masked)
    assert set(found) == set(expected) and all(float(value.norm()) > 0.0 for value in expected.values())
    for name, value in expected.items():
        assert float((found[name] - value).norm()) < FLOAT32 * float(value.norm()), name


def test_the_background_of_a_window_is_that_of_the_whole_there() -> None:
    sky = the_sky()
    whole = sky.panorama.behind(CAMERA, LATE.background).detach()
    for part in windows(the_photo()):
        place, camera = part.camera.window, part.camera
        assert place is not None and place.left % STEP_PX == 0 == place.top % STEP_PX
        seen = sky.panorama.behind(camera, LATE.background).detach()
        expected = whole[place.top : place.top + camera.height, place.left : place.left + camera.width]
        torch.testing.assert_close(seen, expected, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("size", [(331, 247), (320, 240), (900, 680), (201, 150)])
def test_the_sky_of_a_window_is_the_whole_photos_there(size: tuple[int, int]) -> None:
    _, sky = skies.trace(skies.aimed_camera())
    found, camera = SkyMask.packed(sky), skies.aimed_camera().scaled(*size)
    bits = torch.from_numpy(found.bits)
    wholes = photo_sky_on_cpu(found, camera), photo_sky_on_device(bits, found.shape, camera)
    for window in windows_of(*size, size[0] * size[1] // 5):
        part = camera.crop(window.left, window.top, window.width, window.height)
        rows, columns = slice(window.top, window.bottom), slice(window.left, window.right)
        parts = photo_sky_on_cpu(found, part), photo_sky_on_device(bits, found.shape, part)
        for seen, whole in zip(parts, wholes, strict=True):
            for ours, expected in ((seen.mask, whole.mask), (seen.around, whole.around)):
                assert ours.shape == (part.height, part.width)
                assert (ours != expected[rows, columns]).float().mean() < 1e-3  # shares of SURE but for rounding


def scores(photos: list[TrainingPhoto], magnitudes: bool) -> tuple[Tensor, Tensor]:
    """The density statistic's sum after some photos, and how many of them saw each Gaussian."""
    model = gaussians()
    density = Density(len(model))
    schedule = resolve_schedule(TrainConfig(iterations=100)).density
    for photo in photos:
        probe = torch.zeros(len(model), 2, requires_grad=True)
        options = RenderOptions(0, near=0.5, depth=False, magnitudes=magnitudes)
        rendered = rasterizer.render(model, photo.camera, options, means2d_probe=probe)
        photo_loss(rendered.colour, photo.colour, SSIM_WEIGHT, photo.mask, photo.inner).backward()
        assert probe.grad is not None
        density.observe(rendered, probe.grad, schedule, photo)
    return density.score_sum, density.seen


@pytest.mark.parametrize("magnitudes", [True, False])
def test_a_gaussian_in_one_window_has_the_score_that_the_whole_photo_gives_it(magnitudes: bool) -> None:
    whole, _ = scores([the_photo()], magnitudes)
    parts, seen = scores(windows(the_photo()), magnitudes)
    alone = seen == 1.0
    assert int(alone.sum()) > 100
    torch.testing.assert_close(parts[alone], whole[alone], rtol=1e-3, atol=1e-3 * float(whole.max()))


def halves(photo: TrainingPhoto, level: int) -> TrainingPhoto:
    """Return the photo at another size."""
    size = (photo.camera.width * level, photo.camera.height * level)
    colour = photo.colour.repeat_interleave(level, 0).repeat_interleave(level, 1)
    return TrainingPhoto(photo.camera.scaled(*size), colour, None)


def test_the_score_means_the_same_at_every_level() -> None:
    ones, _ = scores([the_photo()], True)
    threes, _ = scores([halves(the_photo(), 3)], True)
    large = ones > ones.quantile(0.5)
    assert float((threes[large] / ones[large]).median()) == pytest.approx(1.0, abs=0.1)


def test_cells_of_windows_are_those_of_the_whole_photo() -> None:
    planes = torch.rand(2, CAMERA.height, CAMERA.width, generator=torch.Generator().manual_seed(1))
    cells = torch.rand(GRID, GRID, generator=torch.Generator().manual_seed(2)) > 0.5
    whole = PhotoCells(CAMERA, 61, GRID)
    judged = torch.zeros(61, GRID, dtype=torch.bool)
    for part in windows(TrainingPhoto(CAMERA, torch.zeros(CAMERA.height, CAMERA.width, 3), None)):
        place, camera = part.camera.window, part.camera
        assert place is not None
        rows, columns = slice(place.top, place.top + camera.height), slice(place.left, place.left + camera.width)
        ours = PhotoCells(camera, 61, GRID)
        expected = PhotoCells(CAMERA, GRID, GRID).spread(cells)[rows, columns]
        assert torch.equal(PhotoCells(camera, GRID, GRID).spread(cells), expected)
        visible_share = ours.means(torch.ones(1, camera.height, camera.width))[0]
        inside = torch.zeros(1, CAMERA.height, CAMERA.width)
        inside[0, rows, columns] = 1.0
        of_whole = whole.means(inside)[0]  # how much of each cell the window shows
        assert torch.equal(visible_share > 0.0, of_whole > 0.0)
        full = of_whole > 0.999
        torch.testing.assert_close(ours.means(planes[:, rows, columns])[:, full], whole.means(planes)[:, full])
        found = ours.judged(planes)
        assert found is not None and bool(found[full].all()) and not bool(found[of_whole < 0.24].any())
        judged |= found
    assert bool(judged.all()) and whole.judged(planes) is None


CAR = (40, 60, 80, 120)  # top, left, bottom, right in the photo that shows it, pixels
CAR_PIXELS = 11_000  # size of a window: their borders go through the car


def cameras() -> list[Camera]:
    return [camera.scaled(4 * camera.width, 4 * camera.height) for camera in tiny_scene.cameras()]


def with_a_car(number: int) -> TrainingPhoto:
    """A photo of the tiny scene; of the third with a block painted into it that no other shows."""
    camera = cameras()[number]
    colour = torch.from_numpy(tiny_scene.photograph(tiny_scene.true_model(), camera)).float() / 255.0
    if number == 2:
        colour[CAR[0] : CAR[2], CAR[1] : CAR[3]] = torch.tensor([0.9, 0.86, 0.12])
    return TrainingPhoto(camera, colour, None)


def visited(robust: RobustMask, photos: list[TrainingPhoto]) -> list[TrainingPhoto]:
    """Return what each visit keeps of a photo, for a model that equals the truth."""
    found = []
    for photo in photos:
        with torch.no_grad():
            rendered = rasterizer.render(tiny_scene.true_model(), photo.camera, RenderOptions(3))
        found.append(robust.leave_out_contradicted(photo, rendered, rendered.colour))
    return found


def left_out(photos: list[TrainingPhoto]) -> Tensor:
    """Return the pixels inside each window that are left out of the loss."""
    whole = photos[0].camera.uncropped()
    found = torch.zeros(whole.height, whole.width, dtype=torch.bool)
    for photo in photos:
        place, camera = photo.camera.window, photo.camera
        top, first = (0, 0) if place is None else (place.top, place.left)
        if photo.mask is not None:
            there = found[top : top + camera.height, first : first + camera.width]
            there[photo.inside] = ~photo.mask[photo.inside]
    return found


def test_moving_objects_are_left_out_of_windows_as_of_the_whole_photo() -> None:
    outs, scores = [], []
    for divided in (False, True):
        robust = RobustMask([camera.name for camera in cameras()])
        robust.watch(cameras())
        photos = [with_a_car(number) for number in range(len(cameras()))]
        given = [windows(photo, CAR_PIXELS) if divided else [photo] for photo in photos]
        for parts in given:
            visited(robust, parts)
        robust.end_epoch(0.05)
        scores.append(robust.scores.clone())
        outs.append(left_out(visited(robust, given[2])))
    block = torch.zeros_like(outs[0])
    block[CAR[0] : CAR[2], CAR[1] : CAR[3]] = True
    for out in outs:
        assert float((out & block).sum() / block.sum()) > 0.85
        assert float((out & ~block).float().mean()) < 0.015
    assert float((outs[0] ^ outs[1]).float().mean()) < 0.01
    known = (scores[0] >= 0.0) & (scores[1] >= 0.0)
    assert torch.equal(scores[0] >= 0.0, known)
    assert float(((scores[0] - scores[1]).abs() < 0.02)[known].float().mean()) > 0.98


def test_a_window_that_does_not_show_a_cell_keeps_its_state() -> None:
    robust = RobustMask([cameras()[2].name])
    first, *_, last = windows(with_a_car(2), CAR_PIXELS)
    visited(robust, [first])
    after_one = robust.scores.clone()
    known = after_one[0] != UNKNOWN
    assert 0.05 < float(known.float().mean()) < 0.4
    visited(robust, [last])
    assert torch.equal(robust.scores[0][known], after_one[0][known])


def test_in_the_tested_iteration_every_technique_takes_part() -> None:
    assert isinstance(LATE, ScheduleStep) and DistortionLoss(0.5, 20).is_counted(LATE.place)
    assert np.isfinite(gaussians().means.detach().numpy()).all()
