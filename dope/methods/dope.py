"""DOPE itself: corresponding cells of two views get the same descriptor, all others different ones (section 3)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor, nn

from dope.augmentation import WHOLE, Share
from dope.batch import PairBatch
from dope.distributed import Ranks
from dope.methods.base import Facts, Method
from dope.methods.data import pair_dataset, pair_order
from dope.networks import DopeNetwork, MomentumEncoder
from dope.queries import OnlineEncoder
from dope.step import SampledBatch, StepLosses, compute_losses, sample_batch
from dope.streaming import PairDataset
from dope.validation import pck

if TYPE_CHECKING:
    from dope.lowshot.embedding import Embedder
    from dope.order import SampleOrder
    from dope.storage import Shards


class Dope(Method):
    """Dense object descriptors."""

    name = "dope"
    sections = ("loss",)
    own_classifier = "local"
    has_dense = True
    score = "pck"

    def dataset(self, shards: Shards, split: str) -> PairDataset:
        data, training = self.config.data, split == "train"
        points = data.max_points if training else data.points
        return pair_dataset(self.config, shards, split, max_points=points, min_correspondences=training)

    def order(self, dataset: PairDataset) -> SampleOrder:
        return pair_order(self.config, dataset)

    def new_network(self, facts: Facts) -> DopeNetwork:
        return DopeNetwork(self.config.network)

    def new_companion(self, network: nn.Module) -> MomentumEncoder:
        assert isinstance(network, DopeNetwork)
        return MomentumEncoder(network, self.config.momentum, compiled=self.config.compile)

    def companion_state(self, companion: nn.Module) -> dict[str, Tensor]:
        assert isinstance(companion, MomentumEncoder)
        return companion.network.state_dict()

    def load_companion(self, companion: nn.Module, state: dict[str, Tensor]) -> None:
        assert isinstance(companion, MomentumEncoder)
        companion.network.load_state_dict(state)

    def online(self, network: nn.Module) -> OnlineEncoder:
        assert isinstance(network, DopeNetwork)
        return OnlineEncoder(network, compiled=self.config.compile)

    def prepare(self, batch: PairBatch, step: int, share: Share = WHOLE) -> SampledBatch:
        return sample_batch(batch, self.config, step, share)

    def losses(
        self,
        online: nn.Module,
        companion: MomentumEncoder,
        batch: SampledBatch,
        ranks: Ranks,
        *,
        step: int = 0,
        stop: bool = False,
    ) -> StepLosses:
        return compute_losses(online, companion, batch, self.config, ranks, step=step, stop=stop)

    def after_step(self, network: nn.Module, companion: Any) -> None:
        companion.update(network)

    def validate(self, network: nn.Module, held_out: list[PairBatch], ranks: Ranks) -> dict[str, Any]:
        assert isinstance(network, DopeNetwork)
        return pck(network, held_out, points=self.config.data.points, ranks=ranks)

    def embedder(self, network: nn.Module) -> Embedder:
        from dope.lowshot.embedding import DopeEmbedder

        assert isinstance(network, DopeNetwork)
        return DopeEmbedder(network, self.config.data.image_size)
