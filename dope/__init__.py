"""DOPE: dense object descriptors from multiple views, and low-shot recognition with them (arXiv 2211.15059).

Shards in, weights, scores and figures out. This package knows nothing of videos, COLMAP or renderers: that is
`pipeline`, and the shards are all that passes between the two.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("dope-descriptors")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
