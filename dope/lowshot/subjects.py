"""What is evaluated: trained checkpoints, the same networks with random weights, or any other embedder."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch

from dope.augmentation import AugmentationConfig
from dope.common import settings
from dope.common.errors import UsageError
from dope.common.seeds import derive_seed
from dope.lowshot.embedding import DopeEmbedder, Embedder
from dope.networks import NetworkConfig
from dope.networks.untrained import untrained_network

if TYPE_CHECKING:
    from torch import nn

    from dope.lowshot.views import ViewShards

NO_CHECKPOINT = {"checkpoint": None, "checkpoint_sha256": None, "step": None}


class Subject(NamedTuple):
    """An embedder, the columns of its result rows, and what else evaluation must know of it."""

    embedder: Embedder
    columns: Mapping[str, Any]
    """network, method, run, checkpoint, checkpoint_sha256, step, config_hash (see `dope.lowshot.results.ResultRow`)."""
    unsettled: nn.Module | None = None
    """A network of random weights that needs BatchNorm statistics of the views; None where there is none."""
    augmentation: AugmentationConfig = AugmentationConfig()
    """The transform that it was trained with."""
    trained_classes: tuple[str, ...] = ()
    """Classes whose labels it was trained with."""
    pairs: str = ""
    """Fingerprint of the pairs that it was trained on without labels; empty where there are none."""
    pair_categories: tuple[str, ...] = ()
    """Only the pairs of these categories; none given: all."""
    source: str = "the encoder"
    """What it is, for errors."""


def subjects(
    checkpoint: Path | None,
    device: torch.device | str = "cpu",
    *,
    network: NetworkConfig | None = None,
    compare_untrained: bool = False,
    seed: int = 0,
    run: Path | None = None,
) -> Iterator[Subject]:
    """A checkpoint, and with `compare_untrained` (or without a checkpoint) random weights.

    Args:
        checkpoint: a file or a run (its newest one); None: random weights of DOPE's network alone.
        network: sizes of that network.
        seed: of the random weights.
        run: its folder, where `checkpoint` does not tell.

    Raises:
        BadInput: the checkpoint cannot be read.
    """
    if checkpoint is None:
        sizes = network or NetworkConfig()
        net = untrained_network(sizes, seed).to(device)
        columns = {"network": "untrained", "method": "dope", "run": "", "config_hash": settings.config_hash(sizes)}
        embedder = DopeEmbedder(net, None)
        yield Subject(embedder, {**columns, **NO_CHECKPOINT}, unsettled=net, source="random weights")
        return
    from dope.checkpoints import load_method

    method, trained, meta = load_method(checkpoint, device)
    path = Path(meta["path"])
    columns = {"method": method.name, "run": (run or run_of(path)).resolve().name, "config_hash": meta["config_hash"]}
    weights = {"checkpoint": path.name, "checkpoint_sha256": meta["sha256"], "step": meta["step"]}
    classes = meta["facts"].get("classes", ())
    subject = Subject(
        method.embedder(trained),
        {"network": "trained", **columns, **weights},
        augmentation=method.config.augmentation,
        trained_classes=tuple(classes) if isinstance(classes, list | tuple) else (),
        pairs=meta["dataset"] if method.pairs else "",
        pair_categories=method.config.data.categories,
        source=str(path),
    )
    yield subject
    if compare_untrained:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(derive_seed(seed, "untrained network"))
            random = method.new_network(meta["facts"]).to(device).eval()
        network_columns = {"network": "untrained", "config_hash": _network_hash(random, meta)}
        yield subject._replace(
            embedder=method.embedder(random),
            columns={**columns, **NO_CHECKPOINT, **network_columns},
            unsettled=random,
            trained_classes=(),
            pairs="",
            source="random weights",
        )


def run_of(checkpoint: Path) -> Path:
    """The run's folder of RUN/checkpoints/NAME; of a file that lies elsewhere its own folder."""
    folder = checkpoint.absolute().parent
    return folder.parent if folder.name == "checkpoints" else folder


def encoder_subject(embedder: Embedder, *, label: str, sha256: str | None, config_hash: str) -> Subject:
    """An encoder that was not trained here.

    Args:
        embedder: its features; its `name` is the column `method`.
        label: what stands for the weights' file name in the column `checkpoint`.
        sha256: of its weights or its source.
        config_hash: of its settings.
    """
    columns = {"network": "trained", "method": embedder.name, "run": "", "config_hash": config_hash}
    weights = {"checkpoint": label, "checkpoint_sha256": sha256, "step": None}
    return Subject(embedder, {**columns, **weights}, source=f"--encoder {label}")


def trained_among(subject: Subject, names: Iterable[str]) -> list[str]:
    """Which of these categories a network was trained with the labels of, sorted."""
    from dope.lowshot.splits import normalised

    known = {normalised(name) for name in subject.trained_classes}
    return sorted(name for name in names if normalised(name) in known)


def seen_among(subject: Subject, views: ViewShards, names: Iterable[str]) -> list[str]:
    """Which of these categories a network saw objects of, without their labels, in the pairs beside `views`; sorted."""
    seen = views.categories_of_pairs(subject.pairs) if subject.pairs else frozenset()
    return sorted(seen.intersection(names).intersection(subject.pair_categories or seen))


def refuse_trained_classes(subject: Subject, table: str, tested: Mapping[str, int]) -> None:
    """Raise `UsageError` where classes whose labels a network was trained with are tested.

    Args:
        tested: class, as the shards name it -> the first split that tests it.
    """
    both = trained_among(subject, tested)
    if both:
        what = f"was trained with the labels of {', '.join(both)}, which split {tested[both[0]]} of {table} tests"
        raise UsageError(what, where=subject.source, remedy="Train on the base classes of the table alone")


def _network_hash(network: nn.Module, meta: Mapping[str, Any]) -> str:
    """Of the settings that decide what a network of random weights is."""
    config = getattr(network, "config", None)
    return settings.config_hash(config if isinstance(config, NetworkConfig) else meta["config"]["network"])
