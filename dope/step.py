"""One training step of DOPE (section 3 of the paper): two views in, losses and new weights out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dope.augmentation import WHOLE, Share, augment, duplicate_view, uniform_rows
from dope.batch import PairBatch
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.farthest_points import farthest_points
from dope.losses import contrastive_loss
from dope.networks import STRIDE, MomentumEncoder
from dope.networks.batchnorm import moving_statistics_once
from dope.queries import Queries, autocast, micro_batches


@dataclass(frozen=True)
class SampledBatch:
    """An augmented batch with P corresponding feature cells a pair.

    Attributes:
        views: images float in [0, 1].
        cells1, cells2: (B, P, 2) long, row and column of the feature grid.
        ok: (B, P) bool, False where a pair has fewer than P valid points.
    """

    views: PairBatch
    cells1: Tensor
    cells2: Tensor
    ok: Tensor


@dataclass(frozen=True)
class StepLosses:
    """What a step computes.

    Attributes:
        queries: the descriptors of view 1, and their way back to the weights.
        contrastive: scalar with gradient, scaled so that averaging gradients over ranks gives the global loss's.
        report: `loss`, `contrastive`, `mask` and `points`, of all ranks together.
        stop: whether any rank was asked to stop.
    """

    queries: Queries
    contrastive: Tensor
    report: dict[str, float]
    stop: bool

    def backward(self) -> None:
        """Add the gradients of the global loss to the weights', the same on every rank."""
        self.queries.backward(self.contrastive)


def sample_batch(batch: PairBatch, config: TrainConfig, step: int, share: Share = WHOLE) -> SampledBatch:
    """Draw which view is first, augment both, choose points.

    Random numbers are a function of (seed, step) and of the pair's place in the global batch, of which this rank holds
    `share`. They are drawn on the CPU, so that they are the same on any device and nothing waits for a GPU.
    """
    generator = torch.Generator().manual_seed(derive_seed(config.seed, "step", step))
    swap, start = uniform_rows(len(batch), 2, generator, batch.points.device, share).unbind(1)
    batch = batch.swapped(swap < 0.5)
    if config.pairs == "one_view_twice":
        batch = duplicate_view(batch)
    views = augment(batch, config.augmentation, generator, share).laid_out(channels_last=config.channels_last)
    return choose_cells(views, config.data.points, start)


def choose_cells(views: PairBatch, points: int, start: Tensor | None = None) -> SampledBatch:
    """Farthest point sampling on view 1, from `start` (B,) in [0, 1); the cell of a pixel is floor(pixel / 4)."""
    index, ok = farthest_points(views.points[..., :2], views.valid, points, start)
    chosen = views.points.gather(1, index[..., None].expand(-1, -1, 4))  # (B, P, 4)
    height, width = (side // STRIDE for side in views.images1.shape[-2:])
    last = torch.tensor([width - 1, height - 1] * 2, device=chosen.device)
    cells = (chosen / STRIDE).floor().long().clamp(min=0).minimum(last)  # what is not ok may lie anywhere
    return SampledBatch(views, cells[..., [1, 0]], cells[..., [3, 2]], ok)


def momentum_keys(
    momentum: MomentumEncoder, sampled: SampledBatch, ranks: Ranks, shuffle_seed: int | None, parts: list[slice]
) -> Tensor:
    """Keys (world * B, P, D) of view 2 of all ranks, encoded part by part of each rank's B images.

    With a seed, images are shuffled over the ranks before the momentum encoder and its keys unshuffled after, so that
    a key's BatchNorm statistics say nothing of its pair (MoCo, section 3.3).
    """
    images, cells = sampled.views.images2, sampled.cells2
    order: Tensor | None = None
    if ranks.world > 1 and shuffle_seed is not None:
        order = torch.randperm(len(images) * ranks.world, generator=torch.Generator().manual_seed(shuffle_seed))
        order = order.to(images.device)
        images, cells = (ranks.share(ranks.gather(tensor)[order]) for tensor in (images, cells))
    encoded = [
        momentum.sample(momentum(images[rows]), cells[rows]) for rows in moving_statistics_once(momentum.network, parts)
    ]
    keys = ranks.gather(torch.cat(encoded))
    return keys if order is None else keys[order.argsort()]


def compute_losses(
    online: nn.Module,
    momentum: MomentumEncoder,
    sampled: SampledBatch,
    config: TrainConfig,
    ranks: Ranks,
    *,
    step: int = 0,
    stop: bool = False,
) -> StepLosses:
    """Contrast view 1 of this rank with view 2 of all ranks, and view 1's predicted mask with its mask.

    The contrastive loss is the mean over all points of all ranks, so it does not depend on the number of ranks unless
    `distributed.local_negatives`. A batch without a single valid point has contrastive loss 0.
    """
    device, size = sampled.ok.device, len(sampled.ok)
    shuffles = config.distributed.shuffle_batchnorm and not config.distributed.sync_batchnorm
    shuffle_seed = derive_seed(config.seed, "shuffle", step) if shuffles else None
    parts = micro_batches(size, config.data.micro_batch)
    with autocast(config.precision, device):
        keys = momentum_keys(momentum, sampled, ranks, shuffle_seed, parts)
    queries = Queries(online, sampled.views.images1, sampled.cells1, sampled.views.masks1, config, parts)
    all_ok, objects = ranks.gather(sampled.ok), ranks.gather(sampled.views.objects)
    n_points = sampled.ok.shape[1]
    pairs = torch.arange(len(all_ok), device=device)
    usable = all_ok.clone()
    mine = slice(ranks.rank * size, (ranks.rank + 1) * size)
    if config.distributed.local_negatives:
        usable[: mine.start] = usable[mine.stop :] = False
    key_of_point = usable.flatten().cumsum(0).reshape(usable.shape) - 1  # place among the usable keys
    pair_of_key = pairs[:, None].expand(-1, n_points)[usable]
    query_pair = pairs[mine, None].expand(-1, n_points)[sampled.ok]
    contrastive = contrastive_loss(
        queries.descriptors[sampled.ok],
        keys[usable],
        key_of_point[mine][sampled.ok],
        query_pair,
        pair_of_key,
        objects[query_pair],
        objects[pair_of_key],
        temperature=config.loss.temperature,
        negatives=config.loss.negatives,
        chunk=config.loss.chunk,
        reduction="sum",
    )
    count = all_ok.sum().clamp(min=1)
    sums = [contrastive.detach(), sampled.ok.sum(), queries.mask.detach(), torch.tensor(float(stop), device=device)]
    total, points, masks, stops = ranks.sum(torch.stack([value.double() for value in sums])).tolist()
    report = {"contrastive": total / max(1.0, points), "mask": masks / ranks.world, "points": points}
    loss = report["contrastive"] + config.loss.mask_weight * report["mask"]
    return StepLosses(queries, contrastive * ranks.world / count, {"loss": loss, **report}, stops > 0)
