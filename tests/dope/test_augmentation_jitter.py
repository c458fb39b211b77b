"""SimSiam's colours: jitter as a whole, loss of colour, blur; the same view by view and in batches; off by default."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
import torch.nn.functional as F
from test_augmentation import PLAIN, make_batch, seeded
from torch import Tensor

from dope.augmentation import AugmentationConfig, augment, augment_images, on_cpu, views
from dope.augmentation.colour import adjust_brightness, adjust_contrast, adjust_hue, adjust_saturation
from dope.augmentation.draws import Draws
from dope.augmentation.jitter import COLUMNS, JitterPlan, blur, change_colours, draw_jitter, is_on
from dope.common.errors import UsageError
from dope.config import load_config

SIMSIAM = AugmentationConfig(colour_p=0.0, jitter_p=0.8, grey_p=0.2, blur_p=0.5)
N = 4000


def drawn(config: AugmentationConfig, unit: float = 1.0) -> JitterPlan:
    return draw_jitter(Draws(torch.rand(N, COLUMNS, generator=seeded())), config, unit)


def smooth(n: int, height: int, width: int) -> Tensor:
    noise = torch.rand(n, 3, height // 8, width // 8, generator=seeded(2))
    return (255 * F.interpolate(noise, (height, width), mode="bicubic").clamp(0, 1)).to(torch.uint8)


def test_probabilities_and_ranges_are_simsiams() -> None:
    plan = drawn(SIMSIAM)
    for flags, p in ((plan.chosen, 0.8), (plan.grey, 0.2), (plan.blurred, 0.5)):
        assert flags.float().mean().item() == pytest.approx(p, abs=0.03)
    together = (plan.chosen & plan.grey).float().mean().item()
    assert together == pytest.approx(0.16, abs=0.03), "each drawn for itself"
    for column, (low, high) in enumerate([(0.6, 1.4)] * 3 + [(-0.1, 0.1)]):
        amounts = plan.amounts[:, column]
        assert low <= amounts.min() < low + 0.02 and high - 0.02 < amounts.max() <= high
    orders = {tuple(order) for order in plan.order.tolist()}
    assert orders == set(itertools.permutations(range(4)))
    strong = drawn(replace(SIMSIAM, jitter=(1.0, 0.0, 0.0, 0.5))).amounts
    assert strong[:, 0].min() >= 0 and (strong[:, 1] == 1).all() and strong[:, 3].abs().max() > 0.45


def test_blur_has_the_drawn_width_and_keeps_the_sum() -> None:
    plan = drawn(replace(SIMSIAM, blur_px=(0.5, 2.0)), unit=0.5)
    radius = plan.kernels.shape[1] // 2
    torch.testing.assert_close(plan.kernels.sum(1), torch.ones(N))
    deviation = (plan.kernels * torch.arange(-radius, radius + 1).square()).sum(1).sqrt()
    assert deviation.max().item() == pytest.approx(1.0, abs=0.03), "2 px at 224 are 1 px at 112"
    assert deviation.median().item() == pytest.approx(0.625, abs=0.1)
    image = torch.zeros(2, 3, 9, 11)
    image[:, :, 4, 5] = 1
    kernels = torch.tensor([[0.25, 0.5, 0.25], [0.0, 1.0, 0.0]])
    result = blur(image, kernels)
    assert torch.equal(result[0, 0, 3:6, 4:7], kernels[0].outer(kernels[0])) and result[0].sum() == 3
    assert torch.equal(result[1], image[1])


def test_changes_come_in_the_drawn_order() -> None:
    functions = (adjust_brightness, adjust_contrast, adjust_saturation, adjust_hue)
    images = torch.rand(24, 3, 6, 7, generator=seeded())
    orders = torch.tensor(list(itertools.permutations(range(4))))
    amounts = torch.tensor([1.4, 0.6, 1.3, 0.1]).repeat(24, 1)
    off = torch.zeros(24, dtype=torch.bool)
    plan = JitterPlan(torch.arange(24) != 5, orders, amounts, off, off, torch.ones(24, 1))
    result = images.clone()
    change_colours(result, plan)
    for i, order in enumerate(orders.tolist()):
        expected = images[i : i + 1].clone()
        for number in order if i != 5 else ():
            functions[number](expected, amounts[:1, number])
        torch.testing.assert_close(result[i : i + 1], expected)
    assert not torch.allclose(result[0], images[0]) and torch.equal(result[5], images[5])


def test_grey_views_have_no_colour() -> None:
    result = augment(make_batch(4), replace(PLAIN, grey_p=1.0, jitter_p=1.0), seeded()).images1
    torch.testing.assert_close(result[:, 0], result[:, 2], atol=1e-6, rtol=0)


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 80)])
def test_view_by_view_gives_what_all_at_a_time_give(height: int, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    batch = make_batch(48, height, width)
    batch = replace(batch, images1=smooth(48, height, width), images2=smooth(48, height, width).flip(0))
    for config in (SIMSIAM, replace(SIMSIAM, colour_p=0.5, geometry=False, jitter=(0.8, 0.8, 0.8, 0.4))):
        single = augment(batch, config, seeded())
        alone, _ = augment_images(batch.images1, batch.masks1, config, seeded())
        with monkeypatch.context() as patch:
            patch.setattr(on_cpu, "change_views", views.change_views)
            whole = augment(batch, config, seeded())
            alone_whole, _ = augment_images(batch.images1, batch.masks1, config, seeded())
        atol = 0.02 if config.geometry else 2e-4  # OpenCV before version 5 rounds places to 1/32 px
        for name in ("images1", "images2"):
            torch.testing.assert_close(getattr(single, name), getattr(whole, name), atol=atol, rtol=0)
        torch.testing.assert_close(alone, alone_whole, atol=atol, rtol=0)
        assert single.images1.min() >= 0 and single.images1.max() <= 1


def test_blur_is_opencvs() -> None:
    batch = make_batch(2, 64, 64)
    batch = replace(batch, images1=smooth(2, 64, 64))
    result = augment(batch, replace(PLAIN, blur_p=1.0, blur_px=(7.0, 7.0)), seeded()).images1
    sigma = 7.0 * 64 / 224
    expected = [
        cv2.GaussianBlur(i.permute(1, 2, 0).numpy().astype(np.float32) / 255, (0, 0), sigma) for i in batch.images1
    ]
    torch.testing.assert_close(result, torch.from_numpy(np.stack(expected)).permute(0, 3, 1, 2), atol=3e-3, rtol=0)


def test_what_is_off_takes_no_numbers_from_the_rest() -> None:
    off = replace(AugmentationConfig(), jitter=(1, 1, 1, 0.5))
    assert not is_on(off) and views.columns(off) == views.COLUMNS
    for name in ("jitter_p", "grey_p", "blur_p"):
        on = replace(off, **{name: 0.1})
        assert is_on(on) and views.columns(on) == views.COLUMNS + COLUMNS


@pytest.mark.parametrize(
    "wrong", ["jitter_p=2", "grey_p=-1", "blur_p=1.5", "jitter=[2, 0, 0, 0]", "jitter=[0, 0, 0, 0.7]", "blur_px=[0, 1]"]
)
def test_settings_that_make_no_sense_are_refused(wrong: str) -> None:
    with pytest.raises(UsageError, match=f"^augmentation.{wrong.split('=')[0]}: "):
        load_config("nano", None, [f"augmentation.{wrong}"])
