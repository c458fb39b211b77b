"""One training step of DOPE (section 3 of the paper): two views in, losses and new weights out."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from dope.augmentation import augment, duplicate_view
from dope.batch import PairBatch
from dope.common.seeds import derive_seed
from dope.config import TrainConfig
from dope.distributed import Ranks
from dope.farthest_points import farthest_points
from dope.losses import contrastive_loss, mask_loss
from dope.networks import STRIDE, DopeNetwork, MomentumEncoder


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
        backward: scalar with gradient, scaled so that averaging gradients over ranks gives the global loss's.
        report: `loss`, `contrastive`, `mask` and `points`, of all ranks together.
        stop: whether any rank was asked to stop.
    """

    backward: Tensor
    report: dict[str, float]
    stop: bool


class OnlineEncoder(nn.Module):
    """Image to descriptors at cells and mask logits, in one forward, which is what DistributedDataParallel wraps."""

    def __init__(self, network: DopeNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, images: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
        """(B, 3, H, W), (B, P, 2) to descriptors (B, P, D) and mask logits (B, 1, h, w)."""
        output = self.network(images)
        return self.network.sample(output, cells), output.mask_logits


def sample_batch(batch: PairBatch, config: TrainConfig, step: int, rank: int) -> SampledBatch:
    """Draw which view is first, augment both, choose points; random numbers depend on (seed, step, rank) alone."""
    generator = torch.Generator(batch.images1.device)
    generator.manual_seed(derive_seed(config.seed, "step", step, "rank", rank))
    swap = torch.rand(len(batch), generator=generator, device=generator.device) < 0.5
    batch = batch.swapped(swap)
    if config.pairs == "one_view_twice":
        batch = duplicate_view(batch)
    return choose_cells(augment(batch, config.augmentation, generator), config.data.points, generator)


def choose_cells(views: PairBatch, points: int, generator: torch.Generator) -> SampledBatch:
    """Farthest point sampling on view 1; the feature cell of a pixel is floor(pixel / 4)."""
    index, ok = farthest_points(views.points[..., :2], views.valid, points, generator)
    chosen = views.points.gather(1, index[..., None].expand(-1, -1, 4))  # (B, P, 4)
    height, width = (side // STRIDE for side in views.images1.shape[-2:])
    last = torch.tensor([width - 1, height - 1] * 2, device=chosen.device)
    cells = (chosen / STRIDE).floor().long().clamp(min=0).minimum(last)  # what is not ok may lie anywhere
    return SampledBatch(views, cells[..., [1, 0]], cells[..., [3, 2]], ok)


def momentum_keys(momentum: MomentumEncoder, sampled: SampledBatch, ranks: Ranks, shuffle_seed: int | None) -> Tensor:
    """Keys (world * B, P, D) of view 2 of all ranks.

    With a seed, images are shuffled over the ranks before the momentum encoder and its keys unshuffled after, so that
    a key's BatchNorm statistics say nothing of its pair (MoCo, section 3.3).
    """
    images, cells = sampled.views.images2, sampled.cells2
    if ranks.world == 1 or shuffle_seed is None:
        return ranks.gather(momentum.sample(momentum(images), cells))
    order = torch.randperm(len(images) * ranks.world, generator=torch.Generator().manual_seed(shuffle_seed))
    order = order.to(images.device)
    images, cells = (ranks.share(ranks.gather(tensor)[order]) for tensor in (images, cells))
    return ranks.gather(momentum.sample(momentum(images), cells))[order.argsort()]


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
    shuffle_seed = derive_seed(config.seed, "shuffle", step) if config.distributed.shuffle_batchnorm else None
    with torch.autocast(device.type, torch.bfloat16, enabled=config.precision == "bf16"):
        keys = momentum_keys(momentum, sampled, ranks, shuffle_seed)
        queries, mask_logits = online(sampled.views.images1, sampled.cells1)
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
        queries[sampled.ok].float(),
        keys[usable].float(),
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
    # without a mask head the logits are constant: they have no gradient and their loss says nothing
    with_mask = config.network.predict_mask and config.loss.mask_weight > 0
    mask = mask_loss(mask_logits, sampled.views.masks1) if with_mask else torch.zeros((), device=device)
    count = all_ok.sum().clamp(min=1)
    backward = contrastive * ranks.world / count + config.loss.mask_weight * mask
    parts = [contrastive.detach(), sampled.ok.sum(), mask.detach(), torch.tensor(float(stop), device=device)]
    total, points, masks, stops = ranks.sum(torch.stack([part.double() for part in parts])).tolist()
    report = {"contrastive": total / max(1.0, points), "mask": masks / ranks.world, "points": points}
    loss = report["contrastive"] + config.loss.mask_weight * report["mask"]
    return StepLosses(backward, {"loss": loss, **report}, stops > 0)
