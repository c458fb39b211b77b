"""Low-shot evaluation by local matching: what it costs, beside the authors' code and their algorithm in the same run.

    OMP_NUM_THREADS=1 python -m benchmarks.lowshot

Prints one JSON line a figure, in CPU seconds (user + system) of one thread:

- `matching`: one episode of each setting, features at hand as encoding leaves them: choosing the k query cells,
  scoring, predictions; the median over episodes.
- `encoding`: one view of 224 px by the full-size network, decoded from JPEG, descriptors included; the median over
  batches.
- `evaluation`: all four settings x 2,500 episodes over 1,500 objects x 20 views. The episodes are drawn for real;
  views and shots are measured on a sample and scaled by their numbers, which the line shows.

`naive` is the authors' algorithm, reimplemented and measured in the same run: every episode encodes its views anew, one
at a time, with the projector on the whole grid; every query is compared with every shot by itself, over all cells.
`peer` is what their own code took on two shared x86-64 cores (CPU seconds). `equal` says how many predictions of ours
and of the naive algorithm are the same.

The network has random weights (it takes as long with any) and masks that are given: discs of a third of the view with a
soft border. Descriptors of the matching figures are synthetic, since what matching costs depends on them: smooth fields
that objects of a category share, with noise, most cells finding a match of cosine 0.3 to 0.9. They are measured twice:
in a subspace of `--directions` directions but for 0.5% of their squared length, as those of trained networks are
(`--run RUN --shards SHARDS` measures how many a run's have), and of full rank, where the search for the best match can
leave out nothing but the background.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import statistics
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from dope.heap import keep_heap
from dope.lowshot.encoding import ViewCells, encode, to_tensor
from dope.lowshot.episodes import EpisodeConfig, Episodes, sample_episodes
from dope.lowshot.matching import BestShots, MatchingConfig, QueryDescriptors, query_cells
from dope.lowshot.subjects import subjects
from dope.lowshot.views import ViewShards
from dope.lowshot.work import Work
from dope.networks import NetworkConfig, NetworkOutput
from dope.networks.untrained import untrained_network

SETTINGS = ((5, 1), (5, 5), (10, 1), (10, 5))
PEER_MATCHING = {(5, 1): 0.72, (5, 5): 2.4, (10, 1): 2.5, (10, 5): 9.2}
GOAL_MATCHING = {(5, 1): 0.09, (10, 1): 0.35, (10, 5): 1.3}
PEER_ENCODING, GOAL_ENCODING = 0.178 + 0.335, 0.2
PEER_HOURS, GOAL_TIMES = 220.0, 60.0
QUERIES, EPISODES, GRID, DIM, SIZE, CLASSES = 15, 2500, 56, 256, 224, 10
OBJECTS, VIEWS = 1500, 20
OUTSIDE = 0.005  # share of the squared length of descriptors outside of the subspace
CONFIG = MatchingConfig()


def cpu_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def measured(work: Callable[[], Any]) -> tuple[float, Any]:
    """CPU seconds of a call, and what it returned."""
    started = cpu_seconds()
    result = work()
    return cpu_seconds() - started, result


def say(figure: str, **values: Any) -> None:
    rounded = {k: float(f"{v:.4g}") if isinstance(v, float) else v for k, v in values.items()}
    print(json.dumps({"figure": figure, **rounded}), flush=True)


def soft_disc(generator: np.random.Generator) -> NDArray[np.float32]:
    """Mask logits (GRID, GRID) of a disc that covers about a third of the view, its border a few cells wide."""
    y, x = np.mgrid[:GRID, :GRID] + 0.5
    radius = GRID * np.sqrt(generator.uniform(0.28, 0.38) / np.pi)
    centre = GRID / 2 + generator.uniform(-4, 4, 2)
    return ((radius - np.hypot(y - centre[0], x - centre[1])) * 2.5).astype(np.float32)


class MaskedNetwork(nn.Module):
    """The full-size network with masks that are given in place of those that it predicts."""

    def __init__(self) -> None:
        super().__init__()
        self.network = untrained_network(NetworkConfig(), 0).to(memory_format=torch.channels_last)
        discs = [soft_disc(np.random.default_rng(i)) for i in range(16)]
        self.masks = torch.from_numpy(np.stack(discs))[:, None]

    def forward(self, images: Tensor) -> NetworkOutput:
        output = self.network(images)
        return NetworkOutput(output.features, self.masks[: len(images)])

    def project(self, cell_features: Tensor) -> Tensor:
        return self.network.project(cell_features)

    def descriptors(self, images: Tensor) -> Tensor:
        return self.network.dense(self(images))


def synthetic_view(category: int, seed: int, directions: int) -> Tensor:
    """Descriptors (GRID, GRID, DIM) of a view of an object of a category, in a subspace but for 0.5%."""
    shared = torch.Generator().manual_seed(1000 + category)
    own = torch.Generator().manual_seed(seed)
    field = torch.randn(1, DIM, 6, 6, generator=shared) + 0.5 * torch.randn(1, DIM, 1, 1, generator=shared)
    field = field + 0.6 * torch.randn(1, DIM, 6, 6, generator=own)
    # what all objects have in common lets a cell find a fair match in any of them
    field = field + 0.8 * torch.randn(1, DIM, 1, 1, generator=torch.Generator().manual_seed(1))
    grid = functional.interpolate(field, (GRID, GRID), mode="bicubic")[0].permute(1, 2, 0)
    grid = grid + 0.3 * torch.randn(GRID, GRID, DIM, generator=own)
    if directions < DIM:
        basis, _ = torch.linalg.qr(torch.randn(DIM, directions, generator=torch.Generator().manual_seed(2)))
        grid = functional.normalize(grid @ basis @ basis.T, dim=-1)
        outside = functional.normalize(torch.randn(GRID, GRID, DIM, generator=own), dim=-1)
        grid = (1 - OUTSIDE) ** 0.5 * grid + OUTSIDE**0.5 * outside
    mask = torch.from_numpy(soft_disc(np.random.default_rng(seed))).sigmoid()
    return functional.normalize(grid, dim=-1) * mask[..., None]


def match(cells: dict[int, ViewCells], drawn: Episodes) -> NDArray[np.int64]:
    """Our matching of some episodes, features at hand."""
    best = BestShots([drawn])
    views = np.unique(drawn.query)
    queries = torch.empty(len(views), CONFIG.points, DIM)
    norms = torch.empty(len(views), CONFIG.points)
    for row, view in enumerate(views.tolist()):
        norm_map = cells[view].norm_map
        chosen = query_cells(norm_map, str(view), CONFIG)
        queries[row] = cells[view].at(chosen)
        norms[row] = torch.from_numpy(norm_map.ravel()[chosen])
    ready = QueryDescriptors(queries, norms)
    for view in best.support_views.tolist():
        needing = best.queries_of(view)
        best.add(view, needing, ready.scores(cells[view], np.searchsorted(views, needing)))
    return best.predictions()[0]


def match_naively(grids: dict[int, Tensor], drawn: Episodes) -> NDArray[np.int64]:
    """The authors' algorithm: query by query, shot by shot, all cells."""
    predicted = np.empty(drawn.query.shape, np.int64)
    for e, way, i in np.ndindex(*predicted.shape):
        view = int(drawn.query[e, way, i])
        chosen = _naive_query_cells(grids[view], str(view))
        descriptors = grids[view].reshape(-1, DIM)[chosen]
        scores = [
            float((descriptors @ grids[int(shot)].reshape(-1, DIM).T).amax(1).sum())
            for shot in drawn.support[e].ravel()
        ]
        predicted[e, way, i] = int(np.argmax(scores)) // drawn.config.shots
    return predicted


def _naive_query_cells(grid: Tensor, key: str) -> NDArray[np.int64]:
    """Farthest points of the foreground, one at a time, all distances anew; the first one drawn as ours is."""
    norms = grid.norm(dim=-1).numpy()
    foreground = np.argwhere(norms >= CONFIG.foreground)
    first = query_cells(norms, key, CONFIG)[0]
    chosen = [np.array(divmod(int(first), GRID))]
    while len(chosen) < CONFIG.points:
        distances = ((foreground[:, None] - np.stack(chosen)[None]) ** 2).sum(-1).min(1)
        chosen.append(foreground[int(distances.argmax())])
    return np.array([row * GRID + column for row, column in chosen])


def population(n_views: int) -> dict[str, dict[str, list[int]]]:
    """`n_views` views of each object, the objects spread over the classes; views are numbered class by class."""
    of_class = OBJECTS // CLASSES
    return {
        f"c{c}": {f"o{o}": [(c * of_class + o) * n_views + v for v in range(n_views)] for o in range(of_class)}
        for c in range(CLASSES)
    }


def matching_figures(repeats: int, directions: int) -> dict[tuple[int, int], float]:
    """Print the cost of matching an episode; returns that of the naive one."""
    kind = f"{directions} directions" if directions < DIM else "full rank"
    naive: dict[tuple[int, int], float] = {}
    for ways, shots in SETTINGS:
        config = EpisodeConfig(ways=ways, shots=shots, queries=QUERIES, episodes=repeats)
        drawn = sample_episodes(population(1), config)
        ours, theirs, equal, total = [], [], 0, 0
        for e in range(repeats):
            one = slice(e, e + 1)
            episode = Episodes(drawn.support[one], drawn.query[one], drawn.classes[one], drawn.names, drawn.config)
            views = np.unique(np.concatenate([episode.support.ravel(), episode.query.ravel()])).tolist()
            grids = {view: synthetic_view(view // (OBJECTS // CLASSES), view, directions) for view in views}
            cells = {view: ViewCells.of_grid(grid) for view, grid in grids.items()}
            seconds, predicted = measured(lambda cells=cells, episode=episode: match(cells, episode))
            ours.append(seconds)
            if e < 2:  # the slow one twice is enough
                seconds, expected = measured(lambda grids=grids, episode=episode: match_naively(grids, episode))
                theirs.append(seconds)
                equal, total = equal + int((predicted == expected).sum()), total + predicted.size
        value, naive[ways, shots] = statistics.median(ours), statistics.median(theirs)
        say(
            f"matching {ways}-way {shots}-shot, {kind}", value=value, unit="CPU s an episode",
            goal=GOAL_MATCHING.get((ways, shots)), peer=PEER_MATCHING[ways, shots],
            times_faster_than_peer=PEER_MATCHING[ways, shots] / value, naive=naive[ways, shots],
            times_faster_than_naive=naive[ways, shots] / value, equal=f"{equal} of {total}",
        )  # fmt: skip
    return naive


def encoding_figures(repeats: int) -> tuple[float, float]:
    """Print the cost of encoding a view; returns ours and the naive one."""
    network = MaskedNetwork()
    rng = np.random.default_rng(0)
    blobs = [cv2.resize(rng.integers(0, 255, (9, 9, 3), np.uint8), (SIZE, SIZE)) for _ in range(16)]
    jpegs = [cv2.imencode(".jpg", blob)[1] for blob in blobs]

    def decoded(n: int) -> Tensor:
        return to_tensor(np.stack([cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1] for data in jpegs[:n]]))

    encode(network, decoded(16))
    ours = [measured(lambda: encode(network, decoded(16)))[0] / 16 for _ in range(repeats)]
    with torch.inference_mode():
        network.descriptors(decoded(1))
        theirs = [measured(lambda: network.descriptors(decoded(1)))[0] for _ in range(2 * repeats)]
        encoder_alone = [measured(lambda: network(decoded(16)))[0] / 16 for _ in range(repeats)]
    value, naive = statistics.median(ours), statistics.median(theirs)
    say(
        "encoding a view", value=1e3 * value, unit="CPU ms, descriptors included", goal=1e3 * GOAL_ENCODING,
        peer=1e3 * PEER_ENCODING, times_faster_than_peer=PEER_ENCODING / value, naive=1e3 * naive,
        times_faster_than_naive=naive / value, of_it_encoder=1e3 * statistics.median(encoder_alone),
        share_of_cells_projected=float((network.masks.sigmoid() >= 0.3).float().mean()),
    )  # fmt: skip
    return value, naive


def evaluation_figure(
    encoding: tuple[float, float], naive_matching: dict[tuple[int, int], float], sample: int, directions: int
) -> None:
    """Print the cost of the whole evaluation, scaled from a sample of its support views."""
    views = population(VIEWS)
    configs = [EpisodeConfig(ways=w, shots=s, queries=QUERIES, episodes=EPISODES) for w, s in SETTINGS]
    drawing, episodes = measured(lambda: [sample_episodes(views, config) for config in configs])
    building, best = measured(lambda: BestShots(episodes))
    query_views = np.unique(np.concatenate([drawn.query.ravel() for drawn in episodes]))
    needed = len(np.union1d(query_views, best.support_views))

    some = [synthetic_view(i % CLASSES, i, directions) for i in range(32)]
    cells = [ViewCells.of_grid(view) for view in some]
    choosing, chosen = measured(lambda: [query_cells(view.norm_map, str(i), CONFIG) for i, view in enumerate(cells)])
    # rows of as many views as there are, but of few different ones, so that memory is read as it would be
    rows = torch.stack([view.at(places) for view, places in zip(cells, chosen, strict=True)])
    queries = rows[torch.arange(len(query_views)) % len(rows)]
    preparing, ready = measured(lambda: QueryDescriptors(queries, queries.norm(dim=-1)))
    spread = best.support_views[:: max(1, len(best.support_views) // sample)][:sample].tolist()
    pairs = 0

    def score() -> None:
        nonlocal pairs
        for view, support in zip(spread, itertools.cycle(cells)):
            needing = best.queries_of(view)
            pairs += len(needing)
            best.add(view, needing, ready.scores(support, np.searchsorted(query_views, needing)))

    scoring, _ = measured(score)
    n_shots = len(best.support_views)
    predicting, _ = measured(best.predictions)
    parts = {
        "draw_episodes_h": (drawing + building) / 3600,
        "encode_h": needed * encoding[0] / 3600,
        "choose_cells_h": len(query_views) * choosing / len(cells) / 3600,
        "score_h": (preparing + n_shots * scoring / len(spread)) / 3600,
        "predict_h": predicting / 3600,
    }
    value = sum(parts.values())
    naive = sum(
        EPISODES * (w * (s + QUERIES) * encoding[1] + naive_matching[w, s]) for w, s in SETTINGS
    ) / 3600  # fmt: skip
    say(
        f"evaluation, four settings x 2,500 episodes, {directions} directions", value=value, unit="CPU h",
        peer=PEER_HOURS,
        times_less_than_peer=PEER_HOURS / value, goal=GOAL_TIMES, naive=naive, times_less_than_naive=naive / value,
        scaled_from={
            "views_encoded_once": needed, "support_views": n_shots, "of_them_measured": len(spread),
            "pairs_measured": pairs, **{name: float(f"{hours:.4g}") for name, hours in parts.items()},
        },
    )  # fmt: skip


def directions_of(run: Path, shards: str, n: int = 64) -> None:
    """Print in how many directions the descriptors of a run lie, on some views of shards."""
    embedder = next(subjects(run)).embedder
    views = ViewShards(shards)
    work = Work(views, CONFIG, torch.device("cpu"))
    chosen = np.linspace(0, len(views) - 1, n).astype(np.int64)
    cells = [view.descriptors(0, max(1, int((view.norms >= 0.3).sum()))) for _, view in work.cells(embedder, chosen)]
    energies = torch.linalg.eigvalsh(torch.cat([part.T @ part for part in cells]).unflatten(0, (n, -1)).sum(0)).flip(0)
    shares = (energies.cumsum(0) / energies.sum()).tolist()
    inside = {f"within_{share}": 1 + sum(s < share for s in shares) for share in (0.9, 0.99, 0.995)}
    say(f"directions of the descriptors of {run}", of=len(shares), **inside)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=5, help="episodes of a setting, batches of views")
    parser.add_argument("--sample", type=int, default=40, help="support views of the whole evaluation that are scored")
    parser.add_argument("--directions", type=int, default=30, help="in which synthetic descriptors lie")
    parser.add_argument("--run", type=Path, help="with --shards: only count the directions of a run's descriptors")
    parser.add_argument("--shards")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    keep_heap()  # as `dope eval` does
    if arguments.run is not None:
        directions_of(arguments.run, arguments.shards)
        return
    encoding = encoding_figures(arguments.repeats)
    for directions in (arguments.directions, DIM):
        naive_matching = matching_figures(arguments.repeats, directions)
        evaluation_figure(encoding, naive_matching, arguments.sample, directions)


if __name__ == "__main__":
    main()
