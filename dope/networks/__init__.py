"""The dense descriptor network and its momentum copy."""

from dope.networks.batchnorm import synchronise_batchnorm
from dope.networks.dope import STRIDE, DopeNetwork, NetworkConfig, NetworkOutput
from dope.networks.momentum import MomentumEncoder

__all__ = ["STRIDE", "DopeNetwork", "MomentumEncoder", "NetworkConfig", "NetworkOutput", "synchronise_batchnorm"]
