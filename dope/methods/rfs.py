"""RFS (Tian et al., ECCV 2020): a classifier of the base classes, then logistic regression in every episode."""

from __future__ import annotations

from torch import nn

from dope.methods.pooled import PooledEmbedder
from dope.methods.supervised import ClassifierNetwork, Supervised


class Rfs(Supervised):
    """SimpleShot's training; logistic regression on unit features. Without the paper's self-distillation."""

    name = "rfs"
    own_classifier = "logistic"

    def embedder(self, network: nn.Module) -> PooledEmbedder:
        assert isinstance(network, ClassifierNetwork)
        return PooledEmbedder(network.encoder, self.name, self.own_classifier, self.config.data.image_size)
