"""Checkpoint selection: of all checkpoints of a run, each split is tested with the one that its validation classes like
best (5-way 1-shot; of equal ones the later)."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from dope.common.errors import BadInput, UsageError
from dope.common.progress import Progress
from dope.lowshot.evaluate import Evaluation, EvaluationConfig, EvaluationResult
from dope.lowshot.results import ResultRow
from dope.lowshot.splits import SplitTable
from dope.lowshot.subjects import subjects
from dope.lowshot.tasks import validation_protocol
from dope.lowshot.views import ViewShards
from dope.lowshot.work import NotFinite
from dope.storage import Shards


def evaluate_best(
    run: Path,
    shards: Shards,
    config: EvaluationConfig,
    table: SplitTable,
    *,
    device: torch.device | str = "cpu",
    progress: Progress | None = None,
) -> EvaluationResult:
    """Test each split of a table with the checkpoint of a run that is best on the split's validation classes.

    Rows: of every checkpoint on the validation classes of each split (part "val"), then the tests (part "test"), whose
    column `checkpoint` says which one was chosen, and `chosen_by` that it was.

    Args:
        run: a run's folder; all of its checkpoints are tried. One that is damaged (or was deleted by the training that
            goes on), or whose features are not finite, is passed over, which the notes say.
        config: the protocols of the test.

    Raises:
        UsageError: not a run's folder, or the settings contradict a selection, or views do not suffice.
        BadInput: the run has no checkpoint, or none that can be used.
    """
    checkpoints = _checkpoints(run)
    if config.part != "test" or config.compare_untrained:
        flag = "--part val" if config.part != "test" else "--compare-untrained"
        raise UsageError("cannot be had with --select", where=flag, remedy="Leave one of them out")
    protocol = validation_protocol(config.protocols[0])
    views = ViewShards(shards)
    test = Evaluation(views, config, table=table, device=device, progress=progress)  # too few views? before any work
    choosing = replace(config, protocols=(protocol,), part="val")
    validation = Evaluation(views, choosing, table=table, device=device, progress=progress)

    rows: list[ResultRow] = []
    accuracies: list[NDArray[np.float64]] = []
    passed_over: dict[str, str] = {}
    for number, path in enumerate(checkpoints):
        if progress is not None:
            progress("checkpoints", number, len(checkpoints))
        try:
            (subject,) = subjects(path, device, run=run)
        except BadInput as error:
            passed_over[path.name] = error.what
            continue
        try:
            more = validation.measure(subject)
        except NotFinite as error:
            passed_over[path.name] = error.what
            continue
        rows += more[0]
        accuracies += more[1]
    if len(passed_over) == len(checkpoints):
        name, reason = next(iter(passed_over.items()))
        what = f"none of its {len(checkpoints)} checkpoints can be used; {name}: {reason}"
        raise BadInput(what, where=run, remedy="Train again into another folder")
    test.notes += [f"{name} was passed over: {reason}" for name, reason in passed_over.items()]
    chosen = best_checkpoints(rows)
    usable = len(checkpoints) - len(passed_over)

    splits_of: defaultdict[str, list[int]] = defaultdict(list)
    for split, row in chosen.items():
        assert row.checkpoint is not None
        splits_of[row.checkpoint].append(split)
        fewer = f", since {row.asked_ways}-way needs more classes" if row.ways < row.asked_ways else ""
        test.notes.append(
            f"split {split}: {row.checkpoint}, the best of {usable} with {100 * row.accuracy:.2f} ± "
            f"{100 * row.ci95:.2f} % on {row.n_classes} validation classes ({row.protocol}{fewer})"
        )
    tested: list[tuple[ResultRow, NDArray[np.float64]]] = []
    for path in checkpoints:
        if not splits_of[path.name]:
            continue
        tasks = [task for task in test.tasks if task.columns["table_split"] in splits_of[path.name]]
        for subject in subjects(path, device, run=run):
            measured, values = test.measure(subject, tasks)
            tested += zip((replace(row, chosen_by="validation") for row in measured), values, strict=True)
    tested.sort(key=lambda item: item[0].table_split)
    test.notes[:0] = validation.notes
    return test.result([*rows, *(row for row, _ in tested)], [*accuracies, *(values for _, values in tested)])


def best_checkpoints(rows: list[ResultRow]) -> dict[int, ResultRow]:
    """The row of the highest accuracy for each split; of equal ones the last. `rows` are in the order of training."""
    best: dict[int, ResultRow] = {}
    for row in rows:
        if row.table_split not in best or row.accuracy >= best[row.table_split].accuracy:
            best[row.table_split] = row
    return dict(sorted(best.items()))


def _checkpoints(run: Path) -> list[Path]:
    from dope.checkpoints import list_checkpoints

    if not run.is_dir():
        what = "chooses among the checkpoints of a run, and this is no run's folder"
        raise UsageError(what, where=f"--select {run}", remedy="Name the folder that `dope train --out` wrote")
    found = list_checkpoints(run)
    if not found:
        raise BadInput("has no checkpoint", where=run, remedy="`dope train` writes them: see checkpoint.every")
    return found
