"""The protocol: draw all episodes, encode each needed view once, classify, and give accuracy with its interval.

Paper section 4: mean accuracy over 2,500 episodes, 95% confidence interval = 1.96 * std / sqrt(episodes).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from dope.common import settings
from dope.common.errors import UsageError
from dope.common.progress import Progress
from dope.lowshot.classifiers import Classifier, classify, resolve
from dope.lowshot.embedding import Embedder
from dope.lowshot.encoding import to_tensor
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.matching import MatchingConfig
from dope.lowshot.results import ResultRow
from dope.lowshot.splits import SplitTable
from dope.lowshot.subjects import Subject, refuse_trained_classes, seen_among, subjects, trained_among
from dope.lowshot.support_copies import SupportCopies
from dope.lowshot.tasks import Part, Task, split_tasks
from dope.lowshot.views import ViewShards
from dope.lowshot.work import Spill, Work
from dope.networks import NetworkConfig
from dope.networks.untrained import settle_batchnorm
from dope.storage import Shards

SETTLING_VIEWS = 64
"""Views from which a network of random weights gets its BatchNorm statistics."""


@dataclass(frozen=True)
class EvaluationConfig:
    """What is measured, and how."""

    protocols: tuple[EpisodeConfig, ...] = (EpisodeConfig(),)
    """Evaluated together: views and pairs of views that they share are computed once."""
    classifier: Classifier = "auto"
    """auto: the method's own. local: 1-NN by local matching (the paper). Of pooled features: centroid (nearest class
    mean by cosine), nearest (1-NN by cosine) or logistic (regression)."""
    matching: MatchingConfig = field(default_factory=MatchingConfig)
    """How two views are compared."""
    split: Literal["all", "train", "val"] = "all"
    """Views of which objects: all, those trained on, or those held out."""
    categories: tuple[str, ...] = ()
    """Only these categories; none given: all."""
    table_splits: tuple[int, ...] = ()
    """With a table: only these of its splits; none given: all."""
    part: Part = "test"
    """With a table: the test or the validation classes of each split."""
    compare_untrained: bool = False
    """Run the same episodes with the same network with random weights as well."""
    support_copies: int = 1
    """With logistic regression: how often each shot is learnt from; beyond the first, augmented as in training."""
    image_size: int | None = None
    """Side in pixels that views are resized to; None: that of the training run (random weights: as they are)."""
    batch: int = 16
    """Views encoded at a time."""
    memory_gib: float = 4.0
    """Descriptors kept in memory (on the device); those beyond it wait on the disk."""
    cache: Path | None = None
    """Folder on whose disk; None: the system's temporary folder."""
    spill: Spill = "auto"
    """What becomes of descriptors beyond the memory: on disk, encoded again ("never"), or what takes less time."""


@dataclass(frozen=True)
class EvaluationResult:
    """Rows of every embedder, in the order of the tasks; what it took is not part of a row.

    Attributes:
        rows: one a task and embedder.
        accuracies: for each row, the accuracies (E,) of its episodes.
        encode_ms_per_view: wall time, mean over embedders.
        match_ms_per_episode: wall time, mean over protocols and embedders.
        notes: what the reader of the rows should know: what was left out, which checkpoint was chosen, ...
    """

    rows: tuple[ResultRow, ...]
    accuracies: tuple[NDArray[np.float64], ...]
    encode_ms_per_view: float
    match_ms_per_episode: float
    notes: tuple[str, ...] = ()


def evaluate(
    checkpoint: Path | None,
    shards: Shards,
    config: EvaluationConfig | None = None,
    *,
    table: SplitTable | None = None,
    network: NetworkConfig | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> EvaluationResult:
    """Low-shot accuracy of a checkpoint on the single views of SHARDS.

    Args:
        checkpoint: a checkpoint file; None evaluates random weights.
        shards: a folder of shards.
        config: the protocols and settings; the paper's 5-way 1-shot where None.
        table: splits, each evaluated for itself; None: all classes together.
        network: sizes of the network of random weights where `checkpoint` is None.
        device: where the network runs and the descriptors are kept.
        progress: told what is done.

    Raises:
        BadInput: checkpoint or shards cannot be used.
        UsageError: the views do not suffice for a protocol.
    """
    config = config or EvaluationConfig()
    evaluation = Evaluation(shards, config, table=table, device=device, progress=progress)
    seed = config.protocols[0].seed
    return evaluation.run(
        subjects(checkpoint, device, network=network, compare_untrained=config.compare_untrained, seed=seed)
    )


def evaluate_embedders(
    embedders: Iterable[Subject | tuple[Embedder, Any]],
    shards: Shards,
    config: EvaluationConfig | None = None,
    *,
    table: SplitTable | None = None,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> EvaluationResult:
    """The same of any embedders, each with the columns of its rows (see `Subject`)."""
    evaluation = Evaluation(shards, config or EvaluationConfig(), table=table, device=device, progress=progress)
    return evaluation.run(item if isinstance(item, Subject) else Subject(*item) for item in embedders)


class Evaluation:
    """Views and episodes, drawn once, under which any number of embedders are measured.

    Raises:
        BadInput: the shards cannot be used.
        UsageError: the settings contradict each other, or the views do not suffice for a protocol.
    """

    def __init__(
        self,
        shards: Shards | ViewShards,
        config: EvaluationConfig,
        *,
        table: SplitTable | None = None,
        device: torch.device | str = "cpu",
        progress: Progress | None = None,
    ) -> None:
        _check(config, table)
        self.config, self.table, self.progress = config, table, progress
        self.device = torch.device(device)
        self.views = shards if isinstance(shards, ViewShards) else ViewShards(shards)
        self.chosen = self.views.select(config.split, config.categories)
        self.notes: list[str] = []
        self.tasks = self._tasks()
        self._dataset = self.views.fingerprint
        self._took = [0.0, 0, 0.0, 0]  # seconds and views of encoding, seconds and episodes of matching

    def run(self, embedders: Iterable[Subject]) -> EvaluationResult:
        """Measure every embedder in turn."""
        rows: list[ResultRow] = []
        accuracies: list[NDArray[np.float64]] = []
        for subject in embedders:
            more = self.measure(subject)
            rows += more[0]
            accuracies += more[1]
        return self.result(rows, accuracies)

    def result(self, rows: Sequence[ResultRow], accuracies: Sequence[NDArray[np.float64]]) -> EvaluationResult:
        """Rows with what they took."""
        encode, views, match, episodes = self._took
        notes = tuple(dict.fromkeys(self.notes))
        per_view, per_episode = 1e3 * encode / max(1, views), 1e3 * match / max(1, episodes)
        return EvaluationResult(tuple(rows), tuple(accuracies), per_view, per_episode, notes)

    def measure(
        self, subject: Subject, tasks: Sequence[Task] | None = None
    ) -> tuple[list[ResultRow], list[NDArray[np.float64]]]:
        """Rows of one embedder and the accuracies (E,) of their episodes; of some of the tasks, or of all.

        Raises:
            DopeError: its features are not finite.
            UsageError: it has no dense features for local matching, or was trained with labels of tested classes.
        """
        tasks = self.tasks if tasks is None else tasks
        config, classifier = self.config, resolve(self.config.classifier, subject.embedder)
        if self.table is not None:
            tested = {name: task.columns["table_split"] for task in reversed(tasks) for name in task.categories}
            refuse_trained_classes(subject, self.table.name, tested)
        elif config.protocols[0].classes == "category":
            known = trained_among(subject, {name for task in tasks for name in task.drawn.names})
            if known:
                self.notes.append(
                    f"{subject.source} learnt with the labels of {', '.join(known)}: these are not new to it"
                )
        self._tell_seen(subject)
        work = Work(
            self.views, config.matching, self.device, config.batch, config.memory_gib, config.cache, config.spill,
            config.image_size, self.progress, subject.source,
        )  # fmt: skip
        if subject.unsettled is not None:
            settle_on(
                subject.unsettled,
                self.views,
                self.chosen,
                config.image_size or subject.embedder.image_size,
                self.device,
            )
        copies = None
        if config.support_copies > 1:
            if classifier != "logistic":
                what = f"is for --classifier logistic, not {classifier}"
                raise UsageError(what, where="--support-copies", remedy="Leave one of them out")
            copies = SupportCopies(config.support_copies - 1, config.protocols[0].seed, subject.augmentation)
        predictions = classify(classifier, subject.embedder, [task.drawn for task in tasks], work, copies)
        rows, accuracies = [], []
        for task, predicted in zip(tasks, predictions, strict=True):
            truth = np.arange(task.drawn.config.ways)[None, :, None]
            accuracies.append((predicted == truth).mean((1, 2)))
            accuracy, ci95 = mean_and_ci95(accuracies[-1])
            columns = {**subject.columns, **task.counts, **task.columns, **self._settings_of(task, classifier)}
            rows.append(ResultRow(accuracy=accuracy, ci95=ci95, dataset=self._dataset, **columns))
        self.notes += work.notes
        took = (work.encode_seconds, work.encoded, work.match_seconds, sum(len(task.drawn) for task in tasks))
        self._took = [old + new for old, new in zip(self._took, took, strict=True)]
        return rows, accuracies

    def _tell_seen(self, subject: Subject) -> None:
        """Note what a network learnt from without labels, and is tested on: with a table its classes are to be new."""
        config = self.config
        if self.table is not None:
            names = {name for task in self.tasks for name in task.categories}
            end = f"are not to be tested by {self.table.name}; --set data.categories of `dope train` leaves them out"
        elif config.protocols[0].classes == "category" and config.split != "val":
            names = {name for task in self.tasks for name in task.drawn.names}
            end = "are not new to it; --split val tests those held out"
        else:
            return
        seen = seen_among(subject, self.views, names)
        if seen:
            told = f"{', '.join(seen[:8])}{' ...' if len(seen) > 8 else ''}"
            who = subject.columns["run"]
            self.notes.append(f"{who} learnt from pairs of these shards, without labels: objects of {told} {end}")

    def _tasks(self) -> list[Task]:
        config = self.config
        if self.table is None:
            tasks = [Task.draw(self.views, self.chosen, p, part="all") for p in config.protocols]
        else:
            tasks = split_tasks(
                self.views, self.chosen, config.protocols, self.table,
                part=config.part, only=config.table_splits, notes=self.notes,
            )  # fmt: skip
        for task in tasks:
            if task.drawn.left_out:
                few = ", ".join(task.drawn.left_out)
                self.notes.append(f"{task.asked.name}: left out {few}, which have too few objects")
        return tasks

    def _settings_of(self, task: Task, classifier: str) -> dict[str, Any]:
        """The columns that say what was measured; those of all splits of a table have one hash."""
        config, used = self.config, task.drawn.config
        kept = ("classes", "ways", "shots", "shot_mode", "queries", "episodes", "seed")
        other: dict[str, Any] = {"categories": config.categories, "image_size": config.image_size}
        if self.table is not None:
            other["table"] = settings.config_hash(self.table)
        return {
            **{name: getattr(used, name) for name in kept},
            "asked_ways": task.asked.ways,
            "asked_queries": task.asked.queries,
            "chance": task.drawn.chance,
            "classifier": classifier,
            "support_copies": config.support_copies,
            "split": config.split,
            "evaluation_hash": settings.config_hash({**other, "matching": settings.to_dict(config.matching)}),
        }


def mean_and_ci95(accuracies: NDArray[np.float64]) -> tuple[float, float]:
    """Mean over episodes (E,) and half the 95% confidence interval (standard deviation with ddof 0)."""
    return float(accuracies.mean()), float(1.96 * accuracies.std() / np.sqrt(len(accuracies)))


def settle_on(
    network: nn.Module, views: ViewShards, chosen: NDArray[np.int64], size: int | None, device: torch.device
) -> None:
    """Give a network of random weights the BatchNorm statistics of views spread over those that are evaluated."""
    some = chosen[:: max(1, len(chosen) // SETTLING_VIEWS)][:SETTLING_VIEWS]
    batches = views.batches(some, 32, image_size=size)  # not the batch of the settings: results must not depend on it
    settle_batchnorm(network, (to_tensor(images, device) for images in batches))


def _check(config: EvaluationConfig, table: SplitTable | None) -> None:
    if not config.protocols:
        raise UsageError("no protocol to evaluate", where="--ways, --shots")
    settings.require_at_least(config, support_copies=1, batch=1, memory_gib=0)
    if config.matching.points < 1:
        raise UsageError(f"must be 1 or more, not {config.matching.points}", where="--points")
    if not 0 <= config.matching.foreground <= 1:
        raise UsageError(f"must be from 0 to 1, not {config.matching.foreground}", where="--foreground")
    if table is None and config.table_splits:
        raise UsageError("is for --table or --split-file", where="--table-split")
    if table is None and config.part != "test":
        raise UsageError("is for --table or --split-file", where=f"--part {config.part}")
    if table is not None and config.categories:
        what = f"{table.name} says which categories are tested"
        raise UsageError(what, where="--category", remedy="Leave it or the table out")
