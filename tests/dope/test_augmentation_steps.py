"""The steps of the augmentation one by one: closed forms and distributions."""

from __future__ import annotations

import colorsys
import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from dope.augmentation import AugmentationConfig
from dope.augmentation.background import COLUMNS as BACKGROUND_COLUMNS
from dope.augmentation.background import BackgroundPlan, draw_backgrounds, noise_field, paint
from dope.augmentation.colour import COLUMNS as COLOUR_COLUMNS
from dope.augmentation.colour import (
    OPERATIONS,
    ColourPlan,
    adjust_brightness,
    adjust_contrast,
    adjust_gamma,
    adjust_hue,
    adjust_saturation,
    change_colours,
    draw_colour,
)
from dope.augmentation.draws import Draws
from dope.augmentation.geometry import COLUMNS as GEOMETRY_COLUMNS
from dope.augmentation.geometry import bounding_boxes, draw_moves, transform_points, warp

N = 4000
CONFIG = AugmentationConfig()


def draws(columns: int, n: int = N) -> Draws:
    return Draws(torch.rand(n, columns, generator=torch.Generator().manual_seed(0)))


def some_images(n: int) -> Tensor:
    images = torch.rand(n, 3, 4, 5, generator=torch.Generator().manual_seed(1))
    images[:, :, 0, 0] = 0.5  # grey: no hue
    images[:, :, 0, 1] = 0.0
    images[:, :, 0, 2] = torch.tensor([1.0, 0.0, 0.0])
    images[:, :, 0, 3] = torch.tensor([0.7, 0.7, 0.2])  # two channels share the maximum
    return images


def grey(red: float, green: float, blue: float) -> float:
    return 0.2989 * red + 0.587 * green + 0.114 * blue


@pytest.mark.parametrize("turns", [-0.5, -0.2, 0.0, 0.1, 1 / 3, 0.5])
def test_hue_turns_in_hsv(turns: float) -> None:
    images = some_images(1)
    result = images.clone()
    adjust_hue(result, torch.tensor([turns]))
    for before, after in zip(images[0].flatten(1).T.tolist(), result[0].flatten(1).T.tolist(), strict=True):
        hue, saturation, value = colorsys.rgb_to_hsv(*before)
        assert after == pytest.approx(colorsys.hsv_to_rgb((hue + turns) % 1, saturation, value), abs=2e-6)


def test_saturation_brightness_gamma_contrast_closed_forms() -> None:
    images = some_images(3)
    amounts = torch.tensor([0.0, 0.7, 1.6])
    for operation, formula in [
        (adjust_saturation, lambda v, rgb, mean, a: a * v + (1 - a) * grey(*rgb)),
        (adjust_brightness, lambda v, rgb, mean, a: a * v),
        (adjust_gamma, lambda v, rgb, mean, a: v**a),
        (adjust_contrast, lambda v, rgb, mean, a: a * v + (1 - a) * mean),
    ]:
        used = amounts.clamp(min=0.5) if operation is adjust_gamma else amounts
        result = images.clone()
        operation(result, used)
        for image, after, amount in zip(images, result, used.tolist(), strict=True):
            pixels = image.flatten(1).T.tolist()
            mean = sum(grey(*rgb) for rgb in pixels) / len(pixels)
            expected = [[min(max(formula(v, rgb, mean, amount), 0.0), 1.0) for v in rgb] for rgb in pixels]
            torch.testing.assert_close(after.flatten(1).T, torch.tensor(expected), atol=2e-6, rtol=0)


def test_colour_changes_are_applied_in_order_to_the_chosen_views_only() -> None:
    images = some_images(3)
    amount = torch.tensor([[0.3] * 3, [1.8] * 3, [1.5] * 3, [0.6] * 3, [1.4] * 3])
    chosen = torch.tensor([[True, False, False], [True, False, False], [True, False, True], [True, False, False]])
    result, expected = images.clone(), images[:1].clone()
    change_colours(result, ColourPlan(torch.cat([chosen, chosen[:1]]), amount))
    for operation, value in zip(
        (adjust_hue, adjust_saturation, adjust_brightness, adjust_gamma, adjust_contrast), amount[:, 0], strict=True
    ):
        operation(expected, value[None])
    torch.testing.assert_close(result[:1], expected)
    assert torch.equal(result[1], images[1])
    torch.testing.assert_close(result[2], (images[2] * 1.5).clamp(max=1))


def test_colour_draws_have_the_configured_probabilities_and_ranges() -> None:
    plan = draw_colour(draws(COLOUR_COLUMNS), CONFIG)
    assert plan.chosen.float().mean(1).tolist() == pytest.approx([0.5] * 5, abs=0.03)
    correlation = torch.corrcoef(plan.chosen.float()) - torch.eye(5)
    assert correlation.abs().max() < 0.06  # each draw is its own
    for name, amount in zip(OPERATIONS, plan.amount, strict=True):
        low, high = getattr(CONFIG, name)
        assert low <= amount.min() and amount.max() <= high
        assert amount.mean().item() == pytest.approx((low + high) / 2, abs=0.03 * (high - low))
        assert amount.std().item() == pytest.approx((high - low) / math.sqrt(12), rel=0.05)


def test_background_draws_have_the_configured_probabilities() -> None:
    plan = draw_backgrounds(draws(BACKGROUND_COLUMNS), CONFIG)
    one_colour = (plan.first == plan.second).all(1)
    shares = [x.float().mean().item() for x in (one_colour, plan.horizontal[~one_colour], plan.noisy)]
    assert shares == pytest.approx([0.5, 0.5, 0.5], abs=0.03)
    assert plan.corner.mean(0).tolist() == pytest.approx([0.5, 0.5], abs=0.03)
    for colours in (plan.first, plan.second):
        assert colours.min() == 0 and colours.max() == 255
        assert colours.mean().item() == pytest.approx(127.5, abs=3)


def test_gradients_run_from_one_colour_to_the_other() -> None:
    first, second = torch.tensor([[0.0, 250.0, 9.0]] * 2), torch.tensor([[200.0, 50.0, 9.0]] * 2)
    plan = BackgroundPlan(first, second, torch.tensor([True, False]), torch.tensor([False, False]), torch.zeros(2, 2))
    along_x, along_y = paint(plan, 11, 11, None)
    assert along_x[0, 5].tolist() == list(range(0, 201, 20))
    assert along_x[1, 0].tolist() == list(range(250, 49, -20))
    assert (along_x[2] == 9).all() and (along_x == along_x[:, :1]).all()
    assert torch.equal(along_y, along_x.transpose(1, 2))


def test_noise_is_the_difference_of_two_uniform_numbers_with_wrap_around() -> None:
    field = noise_field(50, 200, 200, torch.Generator().manual_seed(0), torch.device("cpu"))
    assert field.shape == (3, 200, 200)
    signed = field.flatten().to(torch.int8).long()  # 8-bit wrap-around: 255 is -1
    assert signed.min() == -49 and signed.max() == 49
    share = torch.bincount(signed + 49) / signed.numel()
    triangle = (50 - torch.arange(-49, 50).abs()) / 2500
    torch.testing.assert_close(share, triangle, atol=1.5e-3, rtol=0)
    largest = noise_field(256, 50, 50, torch.Generator().manual_seed(0), torch.device("cpu"))
    assert largest.float().mean().item() == pytest.approx(127.5, abs=3)  # uniform again, once it has wrapped around


def test_each_noisy_view_begins_somewhere_else_in_the_noise() -> None:
    field = torch.arange(3 * 4 * 6).view(3, 4, 6).to(torch.uint8)
    colour = torch.full((3, 3), 200.0)
    corner = torch.tensor([[0.0, 0.0], [0.999, 0.5], [0.5, 0.5]])
    noisy = torch.tensor([True, True, False])
    views = paint(BackgroundPlan(colour, colour, noisy, noisy, corner), 4, 6, field)
    assert torch.equal(views[0], field + 200)  # in 8 bits
    assert torch.equal(views[1], field.roll((-3, -3), (1, 2)) + 200)
    assert (views[2] == 200).all()


def test_bounding_boxes_are_pixel_edges() -> None:
    masks = torch.zeros(3, 1, 6, 8, dtype=torch.bool)
    masks[0, 0, 2:4, 1:7] = True
    masks[1, 0, 5, 7] = True
    boxes, present = bounding_boxes(masks)
    assert boxes[:2].tolist() == [[1, 2, 7, 4], [7, 5, 8, 6]] and present.tolist() == [True, True, False]


@pytest.mark.parametrize("size", [224, 112])
def test_moves_follow_the_papers_ranges(size: int) -> None:
    unit = size / 224
    masks = torch.zeros(1, 1, size, size, dtype=torch.bool)
    masks[..., size // 4 : size // 2, size // 4 : size * 3 // 4] = True
    matrices, moved, scales = draw_moves(
        draws(GEOMETRY_COLUMNS),
        masks.expand(N, 1, size, size),
        bounding_boxes(masks)[0].expand(N, 4),
        torch.ones(N, dtype=torch.bool),
        CONFIG,
    )
    assert moved.float().mean().item() == pytest.approx(0.5, abs=0.03)
    assert torch.equal(matrices[~moved], torch.eye(3).expand(int((~moved).sum()), 3, 3)) and (scales[~moved] == 1).all()
    matrices, scales = matrices[moved], scales[moved]
    torch.testing.assert_close(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0], scales**2)
    assert scales.max() <= CONFIG.largest_scale

    degrees = torch.rad2deg(torch.atan2(matrices[:, 1, 0], matrices[:, 0, 0])) % 360
    assert (degrees - degrees.round()).abs().max() < 1e-3
    assert torch.histc(degrees, 4, 0, 360).div(len(degrees)).tolist() == pytest.approx([0.25] * 4, abs=0.04)

    left, top, right, bottom = size / 4 - 2 * unit, size / 4 - 2 * unit, size * 3 / 4 + 2 * unit, size / 2 + 2 * unit
    corners = torch.tensor([[left, top], [right, top], [left, bottom], [right, bottom]])
    new = transform_points(corners.expand(len(matrices), 4, 2), matrices)
    low, high = new.amin(1), new.amax(1)
    assert low.min() >= 10 * unit - 1e-3 and high.max() <= size - 10 * unit + 1e-3
    longest = (high - low).amax(1) / unit
    free = scales < CONFIG.largest_scale - 1e-6
    assert longest.min() >= 56 - 1e-3 and longest.max() <= 195 + 1e-3
    assert (longest[free] - longest[free].round()).abs().max() < 1e-3
    assert longest.mean().item() == pytest.approx((56 + 195) / 2, abs=4)
    room = (size - 20 * unit - (high - low)).clamp(min=1e-3)
    offset = (low - 10 * unit) / room
    assert offset.mean(0).tolist() == pytest.approx([0.5, 0.5], abs=0.03)


def test_objects_are_never_enlarged_beyond_the_limit() -> None:
    masks = torch.zeros(1, 1, 224, 224, dtype=torch.bool)
    masks[..., 100:110, 100:110] = True
    _, moved, scales = draw_moves(
        draws(GEOMETRY_COLUMNS, 200),
        masks.expand(200, 1, 224, 224),
        bounding_boxes(masks)[0].expand(200, 4),
        torch.ones(200, dtype=torch.bool),
        CONFIG,
    )
    assert (scales[moved] == CONFIG.largest_scale).all()


def test_warp_by_whole_pixels_and_quarter_turns_is_exact() -> None:
    images = torch.rand(2, 3, 8, 8)
    masks = torch.ones(2, 1, 8, 8, dtype=torch.bool)
    shift = torch.tensor([[1.0, 0, 2], [0, 1, -1], [0, 0, 1]])
    turn = torch.tensor([[0.0, -1, 8], [1, 0, 0], [0, 0, 1]])
    new, alpha = warp(images, masks, torch.stack([shift, turn]), torch.ones(2))
    torch.testing.assert_close(new[0, :, :7, 2:], images[0, :, 1:, :6])
    assert not alpha[0, :, 7].any() and not alpha[0, :, :, :2].any() and alpha[0, :, :7, 2:].all()
    torch.testing.assert_close(new[1], images[1].transpose(1, 2).flip(2))


def test_small_objects_are_averaged_not_aliased() -> None:
    images = torch.rand(1, 3, 64, 64)
    masks = torch.ones(1, 1, 64, 64, dtype=torch.bool)
    quarter = torch.diag(torch.tensor([0.25, 0.25, 1.0]))[None]
    new, alpha = warp(images, masks, quarter, torch.tensor([0.25]))
    assert alpha.sum() == 16 * 16
    torch.testing.assert_close(new[:, :, :16, :16], F.avg_pool2d(images, 4))
