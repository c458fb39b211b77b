"""Figures of sequences: evenly spaced views of them out of a folder of shards."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from dope.figures.colouring import Colours, correspondence_colouring
from dope.figures.heatmap import Point, similarity_heatmap
from dope.lowshot.views import ViewShards
from dope.networks import DopeNetwork, NetworkConfig
from dope.networks.untrained import untrained_network
from dope.storage import Shards

Kind = Literal["colouring", "heatmap"]


def draw_figures(
    checkpoint: Path | None,
    shards: Shards,
    out: Path,
    *,
    kind: Kind = "colouring",
    sequences: Sequence[str] | None = None,
    views: int = 6,
    limit: int = 3,
    masks: Literal["predicted", "given"] = "predicted",
    colours: Colours = "position",
    point: Point | None = None,
    device: torch.device | str = "cpu",
) -> Iterator[Path]:
    """Write a figure of each sequence and yield its path.

    Args:
        checkpoint: a checkpoint or a run's folder; None shows random weights, for comparison.
        shards: a folder of shards, or an fsspec URL of it.
        out: the folder for `<sequence>-<kind>.png`.
        kind: colours carried from the first view, or where a point of it is found again.
        sequences: their ids; None takes the first `limit`, held-out ones first.
        views: at most so many of each sequence, at even distances.
        limit: number of sequences where none is named.
        masks: the network's soft masks, or those of the shards.
        colours: of a colouring's reference view.
        point: x, y in pixels of the first view (heatmap); None takes the object's innermost pixel.
        device: where the network runs.

    Raises:
        UsageError: an unknown sequence (close ones are named), fewer than two views, a limit below 1, or a point
            outside the view.
        BadInput: shards or checkpoint cannot be used; or, once all others are drawn, a sequence shows no object.
    """
    if views < 2:
        raise UsageError(f"a figure needs at least 2 views, not {views}", where="--views")
    if limit < 1:
        raise UsageError(f"must be at least 1, not {limit}", where="--limit")
    found = ViewShards(shards)
    chosen = [(name, found.of_sequence(name)) for name in sequences or _first_sequences(found, limit)]
    for sequence, indices in chosen:
        if len(indices) < 2:
            raise UsageError(f"sequence '{sequence}' has only one view", where=shards)
    network, image_size, weights = _network(checkpoint, device)
    failed: list[BadInput] = []
    for sequence, indices in chosen:
        indices = evenly_spaced(indices, views)
        read = [found.read(i) for i in indices.tolist()]
        photos = [view.image for view in read]
        given = [view.mask for view in read] if masks == "given" else None
        names = [f"frame {found.columns['frame'][i]}" for i in indices]
        subtitle = f"{sequence}, {weights}, {masks} masks"
        path = out / f"{sequence}-{kind}.png"
        try:
            if kind == "colouring":
                correspondence_colouring(
                    network, photos, path, masks=given, colours=colours, names=names, subtitle=subtitle,
                    image_size=image_size, device=device,
                )  # fmt: skip
            else:
                similarity_heatmap(
                    network, photos, point, path, masks=given, names=names, subtitle=subtitle,
                    image_size=image_size, device=device,
                )  # fmt: skip
        except BadInput as error:  # one sequence without a visible object does not cost the others their figures
            failed.append(BadInput(error.what, where=f"{sequence}, {error.where}", remedy=error.remedy))
            continue
        yield path
    if failed:
        raise failed[0]


def figure_for(shards: Shards, checkpoint: Path | None, sequence: str, kind: Kind, out: Path, **options: Any) -> Path:
    """Write the figure of one sequence into the folder `out` and return its path (options as in `draw_figures`)."""
    return next(draw_figures(checkpoint, shards, out, kind=kind, sequences=[sequence], **options))


def evenly_spaced(indices: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """At most `n` of the indices, the first included, at even distances."""
    if len(indices) <= n:
        return indices
    return indices[np.arange(n) * len(indices) // n]


def _first_sequences(views: ViewShards, n: int) -> list[str]:
    """Those with two views or more, held-out ones first, else in the order of the shards."""
    names, splits = views.columns["sequence"], views.columns["split"]
    counts = Counter(names)
    rank = {name: split != "val" for name, split in zip(names, splits, strict=True) if counts[name] > 1}
    if not rank:
        raise UsageError("no sequence has two views", where=views.folder)
    return sorted(rank, key=lambda name: rank[name])[:n]


def _network(checkpoint: Path | None, device: torch.device | str) -> tuple[DopeNetwork, int | None, str]:
    """The network, the side in pixels that it was trained with, and what it is called in the figure."""
    if checkpoint is None:
        return untrained_network(NetworkConfig(), seed=0).to(device), None, "random weights"
    from dope.checkpoints import load_network

    network, meta = load_network(checkpoint, device)
    return network, meta["config"]["data"]["image_size"], f"step {meta['step']}"
