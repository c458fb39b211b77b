"""Augmentation of whole batches: points follow pixels, objects stay, backgrounds go, draws have their probabilities."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from dope.augmentation import (
    AugmentationConfig,
    Share,
    augment,
    augment_images,
    duplicate_view,
    no_augmentation,
    on_cpu,
    views,
)
from dope.augmentation.colour import ColourPlan, change_colours
from dope.augmentation.geometry import bounding_boxes
from dope.batch import TENSORS, PairBatch

PLAIN = AugmentationConfig(colour_p=0.0, flip_p=0.0, background_removal="off", geometry=False)
OBJECT, GROUND = 200, 10  # grey values; no background is compared with them where noise could hit them


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def ellipses(n: int, height: int, width: int) -> Tensor:
    y = (torch.arange(height)[:, None] + 0.5) / height - 0.5
    x = (torch.arange(width) + 0.5) / width - 0.45
    return ((x / 0.35) ** 2 + (y / 0.22) ** 2 < 1).expand(n, 1, height, width).clone()


def make_batch(n: int, height: int = 32, width: int = 32, points: int = 5) -> PairBatch:
    masks = ellipses(n, height, width)
    images = torch.where(masks, OBJECT, GROUND).to(torch.uint8).expand(n, 3, height, width).clone()
    spread = torch.rand(n, points, 4, generator=seeded(1)) * 0.2 + 0.35
    return PairBatch(
        images1=images,
        images2=images.clone(),
        masks1=masks,
        masks2=masks.clone(),
        points=spread * torch.tensor([width, height, width, height]),
        valid=torch.ones(n, points, dtype=torch.bool),
        objects=torch.arange(n),
        keys=tuple(str(i) for i in range(n)),
    )


@pytest.mark.parametrize(("height", "width"), [(224, 224), (96, 160)])
@pytest.mark.parametrize("view", [1, 2])
def test_points_and_pixels_move_together(height: int, width: int, view: int) -> None:
    n, sigma = 24, min(height, width) / 50  # small enough not to be cut off by the object's rim
    batch = make_batch(n, height, width, points=1)
    x, y = (batch.points[:, 0, 2 * view - 2 + i, None, None] for i in (0, 1))
    rows, columns = torch.arange(height)[:, None] + 0.5, torch.arange(width) + 0.5
    dot = (255 * torch.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))).round()  # centroid at the point
    images = dot[:, None].expand(n, 3, height, width).to(torch.uint8)
    batch = replace(batch, **{f"images{view}": images})
    config = AugmentationConfig(colour_p=0.0, geometry_p=1.0)
    result = augment(batch, config, seeded())
    new = getattr(result, f"images{view}")[:, 0] * getattr(result, f"masks{view}")[:, 0]
    moved = (getattr(result, f"masks{view}") != getattr(batch, f"masks{view}")).flatten(1).any(1)
    assert moved.sum() > n / 2 and result.valid.all()
    centroid = torch.stack([(new * columns).sum((1, 2)), (new * rows).sum((1, 2))], 1) / new.sum((1, 2))[:, None]
    torch.testing.assert_close(centroid, result.points[:, 0, 2 * view - 2 : 2 * view], atol=0.15, rtol=0)


def test_flip_mirrors_pixels_masks_and_points_exactly() -> None:
    batch = make_batch(4)
    batch.images1[:, :, 12, 14] = 77
    batch.points[:, 0, :2] = torch.tensor([14.5, 12.5])
    result = augment(batch, replace(PLAIN, flip_p=1.0), seeded())
    assert torch.equal(result.images1, batch.images1.flip(-1).float().div(255))
    assert torch.equal(result.masks2, batch.masks2.flip(-1))
    assert result.points[0, 0, :2].tolist() == [32 - 14.5, 12.5]
    assert torch.equal(result.points[..., 3], batch.points[..., 3])


def test_background_is_replaced_and_the_object_untouched() -> None:
    batch = make_batch(64)
    config = AugmentationConfig(colour_p=0.0, geometry=False, flip_p=0.0, noise_p=0.0)
    result = augment(batch, config, seeded())
    for images, masks, before in [
        (result.images1, result.masks1, batch.images1.float().div(255)),
        (result.images2, result.masks2, batch.images2.float().div(255)),
    ]:
        inside = masks.expand_as(images)
        assert torch.equal(images[inside], before[inside])
        touched = (images != before).any(1)
        changed = touched.flatten(1).any(1)
        ground = ~masks[:, 0]
        # a gradient may pass through the old grey value in a few pixels
        assert touched[changed][ground[changed]].float().mean() > 0.98


def test_rim_of_a_moved_object_keeps_the_objects_colour() -> None:
    batch = make_batch(32, 112, 112)
    config = AugmentationConfig(colour_p=0.0, geometry_p=1.0)
    result = augment(batch, config, seeded())
    for images, masks in [(result.images1, result.masks1), (result.images2, result.masks2)]:
        values = images[masks.expand_as(images)]
        torch.testing.assert_close(values, torch.full_like(values, OBJECT / 255))


def test_each_pair_loses_at_least_one_background_in_the_papers_proportions() -> None:
    batch = make_batch(4000)
    batch = replace(batch, images1=batch.images1[:, :, ::4, ::4], images2=batch.images2[:, :, ::4, ::4])
    batch = replace(batch, masks1=batch.masks1[:, :, ::4, ::4], masks2=batch.masks2[:, :, ::4, ::4])
    config = replace(PLAIN, background_removal="paired")
    result = augment(batch, config, seeded())
    first = (result.images1 != batch.images1.float().div(255)).flatten(1).any(1)
    second = (result.images2 != batch.images2.float().div(255)).flatten(1).any(1)
    assert (first | second).all()
    shares = [(first & ~second), (~first & second), (first & second)]
    assert [s.float().mean().item() for s in shares] == pytest.approx([0.25, 0.25, 0.5], abs=0.03)
    off = augment(batch, PLAIN, seeded())
    assert torch.equal(off.images1, no_augmentation(batch).images1)


def test_geometric_step_happens_half_of_the_time_and_keeps_the_object_inside() -> None:
    batch = make_batch(600, 56, 56)
    config = replace(PLAIN, background_removal="paired", geometry=True)
    result = augment(batch, config, seeded())
    moved = (result.masks1 != batch.masks1).flatten(1).any(1)
    assert moved.float().mean().item() == pytest.approx(0.75 * 0.5, abs=0.06)
    boxes, present = bounding_boxes(result.masks1)
    assert present.all()
    margin = 10 * 56 / 224
    assert (boxes[moved, :2] >= margin - 1).all() and (boxes[moved, 2:] <= 56 - margin + 1).all()
    assert result.valid.float().mean() > 0.99
    still = augment(batch, replace(config, geometry=False), seeded())
    assert torch.equal(still.masks1, batch.masks1) and torch.equal(still.points, batch.points)


def test_objects_near_the_border_stay_where_they_are() -> None:
    batch = make_batch(40, 224, 224)
    config = replace(PLAIN, background_removal="paired", geometry=True, geometry_p=1.0)
    for row, moves in ((4, False), (5, True), (218, True), (219, False)):
        masks = batch.masks1.clone()
        masks[:, :, row, 100] = True
        result = augment(replace(batch, masks1=masks), config, seeded())
        assert (result.masks1 != masks).any().item() is moves, row


def test_points_off_the_object_or_the_image_become_invalid() -> None:
    batch = make_batch(3, points=6)
    inside, outside = [16.0, 16.0], [1.0, 1.0]
    rows = [inside + inside, outside + inside, inside + outside, [-1.0, 16.0, *inside], [*inside, 16.0, 32.0]]
    batch.points[:] = torch.tensor([*rows, [float("nan")] * 4])
    result = augment(batch, PLAIN, seeded())
    assert result.valid.tolist() == [[True] + [False] * 5] * 3
    batch.valid[:, 0] = False
    assert not augment(batch, PLAIN, seeded()).valid.any()


def test_empty_masks_keep_their_background_and_make_no_nan() -> None:
    batch = make_batch(16)
    batch.masks1[:] = False
    config = replace(PLAIN, background_removal="paired", geometry=True, geometry_p=1.0)
    result = augment(batch, config, seeded())
    assert torch.equal(result.images1, batch.images1.float().div(255))
    full = augment(batch, AugmentationConfig(), seeded())
    for tensor in (full.images1, full.images2, full.points):
        assert torch.isfinite(tensor).all()
    assert not full.valid.any()


def test_results_stay_in_range_and_the_batch_is_not_changed() -> None:
    batch = make_batch(64)
    before = {name: getattr(batch, name).clone() for name in ("images1", "masks1", "masks2", "points", "valid")}
    result = augment(batch, AugmentationConfig(), seeded())
    for images in (result.images1, result.images2):
        assert images.dtype == torch.float32 and images.min() >= 0 and images.max() <= 1
    assert result.masks1.dtype == torch.bool
    assert result.objects is batch.objects and result.keys == batch.keys
    for name, value in before.items():
        assert torch.equal(getattr(batch, name), value)


def test_result_is_a_function_of_the_generator() -> None:
    batch = make_batch(8)
    first, again = (augment(batch, AugmentationConfig(), seeded(3)) for _ in range(2))
    other = augment(batch, AugmentationConfig(), seeded(4))
    for name in ("images1", "images2", "masks1", "points", "valid"):
        assert torch.equal(getattr(first, name), getattr(again, name))
    assert not torch.equal(first.images1, other.images1)


def test_float_images_give_what_bytes_give() -> None:
    batch = make_batch(8)
    first = augment(batch, AugmentationConfig(), seeded())
    second = augment(no_augmentation(batch), AugmentationConfig(), seeded())
    torch.testing.assert_close(first.images1, second.images1)


SMALL = (10, 30)  # objects that are averaged down once and twice before they are resampled


@pytest.mark.parametrize(("height", "width"), [(64, 64), (48, 80), (50, 71)])
@pytest.mark.parametrize("longest_side_px", [(56, 195), SMALL])
def test_view_by_view_gives_what_all_at_a_time_give(
    height: int, width: int, longest_side_px: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    batch = make_batch(48, height, width)
    noise = torch.rand(2, 48, 3, height // 8, width // 8, generator=seeded(2))
    smooth = (255 * F.interpolate(noise.flatten(0, 1), (height, width), mode="bicubic").clamp(0, 1)).to(torch.uint8)
    batch = replace(batch, images1=smooth[:48], images2=smooth[48:])
    config = AugmentationConfig(longest_side_px=longest_side_px)
    for given in (batch, no_augmentation(batch)):
        with monkeypatch.context() as patch:
            single = augment(given, config, seeded())
            patch.setattr(on_cpu, "change_views", views.change_views)
            whole = augment(given, config, seeded())
        for name in ("images1", "images2"):  # OpenCV before version 5 rounds places to 1/32 px
            torch.testing.assert_close(getattr(single, name), getattr(whole, name), atol=0.02, rtol=0)
        for name in ("masks1", "masks2"):
            assert (getattr(single, name) != getattr(whole, name)).float().mean() < 1e-3
        assert torch.equal(single.points, whole.points)


@pytest.mark.parametrize("chosen", list(itertools.product([False, True], repeat=5)))
@pytest.mark.parametrize("amount", [(0.3, 0.4, 0.7, 0.6, 0.6), (-0.4, 1.9, 1.5, 1.4, 1.5)])
def test_colours_view_by_view_are_those_of_the_batch(chosen: tuple[bool, ...], amount: tuple[float, ...]) -> None:
    image = torch.randint(256, (1, 3, 9, 12), generator=seeded(), dtype=torch.uint8)
    image[..., 0, :4] = torch.tensor([0, 255, 77, 0], dtype=torch.uint8)  # black, white, grey
    expected = views.to_float(image)
    change_colours(expected, ColourPlan(torch.tensor(chosen)[:, None], torch.tensor(amount)[:, None]))
    window = (slice(2, 7), slice(3, 11))
    for pixels in (image, views.to_float(image)):
        interleaved = pixels[0].permute(1, 2, 0).numpy().copy()
        whole = on_cpu.coloured(interleaved, chosen, amount)
        part = on_cpu.coloured(interleaved, chosen, amount, window)
        torch.testing.assert_close(torch.from_numpy(whole).permute(2, 0, 1), expected[0], atol=1e-4, rtol=0)
        torch.testing.assert_close(torch.from_numpy(part), torch.from_numpy(whole[window]), atol=1e-6, rtol=0)


def test_views_beside_it_change_nothing_of_a_view() -> None:
    batch, config = make_batch(9), AugmentationConfig(noise_p=0.0)
    whole = augment(batch, config, seeded())
    alone = [
        augment(replace(batch, **{n: getattr(batch, n)[i : i + 1] for n in TENSORS}), config, seeded(), Share(i, 9))
        for i in range(9)
    ]
    assert torch.equal(torch.cat([part.images2 for part in alone]), whole.images2)
    assert torch.equal(torch.cat([part.masks2 for part in alone]), whole.masks2)


def test_single_views_lose_half_of_their_backgrounds() -> None:
    batch = make_batch(2000)
    images, masks = batch.images1[:, :, ::4, ::4], batch.masks1[:, :, ::4, ::4]
    result, new_masks = augment_images(images, masks, replace(PLAIN, background_removal="paired"), seeded())
    changed = (result != images.float().div(255)).flatten(1).any(1)
    assert changed.float().mean().item() == pytest.approx(0.5, abs=0.04)
    assert torch.equal(new_masks, masks)
    result, _ = augment_images(images, masks, PLAIN, seeded())
    assert torch.equal(result, images.float().div(255))


def test_duplicate_view_pairs_each_view_with_itself() -> None:
    batch = make_batch(2)
    batch.images2[:] = 0
    twice = duplicate_view(batch)
    assert torch.equal(twice.images2, batch.images1) and torch.equal(twice.masks2, batch.masks1)
    assert torch.equal(twice.points, batch.points[..., [0, 1, 0, 1]])


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_gpu_gives_what_the_cpu_gives(device: str) -> None:
    batch, config = make_batch(8, 64, 64), AugmentationConfig(noise_p=0.0)
    expected = augment(batch, config, seeded())
    on_gpu = augment(batch.to("cuda"), config, seeded()).to("cpu")
    torch.testing.assert_close(on_gpu.images1, expected.images1, atol=1e-3, rtol=0)
    torch.testing.assert_close(on_gpu.points, expected.points, atol=1e-3, rtol=0)
    noisy = augment(batch.to("cuda"), AugmentationConfig(), torch.Generator(device).manual_seed(0))
    assert noisy.images1.is_cuda and torch.isfinite(noisy.images1).all()
