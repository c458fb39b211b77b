"""What goes into which tar: column operations against the plain loops that they stand for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dope.common import files, seeds
from pipeline.correspond.outline import Outline
from pipeline.sequence import Sequence
from pipeline.shards.catalogue import Catalogue, make_catalogue, read_catalogue
from pipeline.shards.holdout import held_out_arc, held_out_objects
from pipeline.shards.plan import ShardsConfig, plan_tars, rounds
from pipeline.shards.writer import SequenceContents


def random_catalogue(seed: int, n: int) -> Catalogue:
    """Sequences of unequal length, some without a pair, frames with gaps."""
    rng = np.random.default_rng(seed)
    entries = []
    for k in range(n):
        frames = np.sort(rng.choice(90, rng.integers(2, 25), replace=False)).astype(np.int32)
        every = np.argwhere(np.triu(np.ones((len(frames), len(frames))), 1))
        chosen = every[np.sort(rng.choice(len(every), rng.integers(0, min(30, len(every)) + 1), replace=False))]
        outline = Outline(frames, frames[chosen].reshape(-1, 2))
        category = [None, "cup", "pan"][rng.integers(3)]
        entries.append((Sequence(Path(f"work/s{k:04d}")), f"object{rng.integers(n)}", category, outline))
    return make_catalogue(entries)


def plan_by_loops(catalogue: Catalogue, config: ShardsConfig) -> tuple[dict[str, list], dict[str, list]]:
    """Samples of each kind in order as (sequence, row, held), and the counts."""
    objects = {
        s.id: (c, i) for s, c, i in zip(catalogue.sequences, catalogue.categories, catalogue.instances, strict=True)
    }
    by_sequence = config.holdout == "sequences"
    val_ids = held_out_objects(objects, config.val_fraction, config.seed) if by_sequence else set()
    waiting: dict[str, list[list]] = {"train": [], "val": []}
    views, without = [], []
    for k, sequence in enumerate(catalogue.sequences):
        frames = catalogue.frames[catalogue.views_of(k)].tolist()
        pairs = catalogue.pairs[catalogue.pairs_of(k)]
        held = np.full(len(frames), sequence.id in val_ids)
        if config.holdout == "frames":
            held = held_out_arc(np.array(frames), pairs, config.val_fraction, config.seed, sequence.id)
            if not held.any():
                without.append(sequence.id)
        views += [(k, row, bool(h)) for row, h in enumerate(held)]
        sides = [(held[frames.index(a)], held[frames.index(b)]) for a, b in pairs.tolist()]
        order = seeds.generator("pairs of", config.seed, sequence.id).permutation(len(pairs)).tolist()
        waiting["train"].append([(k, row, False) for row in order if not any(sides[row])])
        waiting["val"].append([(k, row, True) for row in order if all(sides[row])])
    samples = {}
    for split, of_object in waiting.items():
        samples[split] = []
        for n in range(max(map(len, of_object), default=0)):
            there = [of[n] for of in of_object if len(of) > n]
            shuffled = seeds.generator("round", config.seed, split, n).permutation(len(there))
            samples[split] += [there[k] for k in shuffled]
    return {**samples, "views": views}, {"without": without, "val_ids": sorted(val_ids)}


@pytest.mark.parametrize("holdout", ["frames", "sequences", "none"])
@pytest.mark.parametrize("n", [1, 2, 17])
def test_the_plan_is_that_of_the_plain_loops(holdout: str, n: int) -> None:
    for seed in range(4):
        catalogue = random_catalogue(seed, n)
        config = ShardsConfig(samples_per_shard=13, holdout=holdout, val_fraction=0.3, seed=seed)  # type: ignore[arg-type]
        expected, facts = plan_by_loops(catalogue, config)
        plan, details = plan_tars(catalogue, config)
        for kind, samples in expected.items():
            tars = [tar for tar in plan if tar.name.startswith(f"{kind}-")]
            assert [tar.name for tar in tars] == [f"{kind}-{k:06d}.tar" for k in range(len(tars))]
            planned = [
                sample
                for tar in tars
                for sample in zip(tar.sequence.tolist(), tar.row.tolist(), tar.held.tolist(), strict=True)
            ]
            assert planned == samples
            sizes = [len(tar) for tar in tars]
            assert not sizes or (max(sizes) <= 13 and max(sizes) - min(sizes) <= 1)
        assert details["pairs"] == {split: len(expected[split]) for split in ("train", "val")}
        assert sum(details["pairs"].values()) + details["mixed_pairs_not_written"] == len(catalogue.pairs)
        assert details["without_val_pairs"] == facts["without"]
        assert details.get("val_sequences", []) == facts["val_ids"]


def test_rounds_with_objects_of_unequal_length() -> None:
    samples = np.array(["a1", "a2", "a3", "b1", "c1", "c2"])
    order = samples[rounds(np.array([3, 0, 1, 2]), 0, "train")].tolist()
    assert [sorted(order[:3]), sorted(order[3:5]), order[5:]] == [["a1", "b1", "c1"], ["a2", "c2"], ["a3"]]
    assert len(rounds(np.zeros(3, int), 0, "train")) == 0


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Sequence:
    from synthetic import orbit, write_sequence

    from pipeline.correspond.match import CorrespondConfig, correspond
    from pipeline.correspond.views import ViewsConfig
    from pipeline.stages import run_stage

    sequence = write_sequence(tmp_path_factory.mktemp("work") / "one", orbit(8, width=80, height=60, focal=95))
    config = CorrespondConfig(ViewsConfig(every=1))
    assert run_stage(sequence, "correspond", config, "", lambda: correspond(sequence, config)).ok
    return sequence


def columns(catalogue: Catalogue) -> list[list]:
    return [catalogue.frames.tolist(), catalogue.view_starts.tolist(), catalogue.pairs.tolist()]


def test_the_marker_says_what_the_tables_say(prepared: Sequence, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = SequenceContents.read(prepared)
    with monkeypatch.context() as patch:
        patch.delattr(SequenceContents, "read")  # no table is opened
        catalogue, marks, left_out = read_catalogue([prepared])
    assert catalogue.frames.tolist() == tables.frames.tolist() and not left_out
    assert catalogue.pairs.tolist() == tables.pair_frames.tolist() and len(catalogue.pairs) > 5
    assert catalogue.categories == ["thing"] and marks[0][0] == "one"


def test_a_marker_without_an_outline_or_with_a_damaged_one_is_made_up_for_by_the_tables(
    prepared: Sequence, tmp_path: Path
) -> None:
    marker = prepared.stages / "correspond.json"
    values, whole = files.read_json(marker), read_catalogue([prepared])
    try:
        for outline in (None, "", [], {"frames": "1 2 x"}, {**values["details"]["outline"], "pairs": "1 2 3"}):
            files.write_json(marker, {**values, "details": {**values["details"], "outline": outline}})
            again = read_catalogue([prepared])
            assert columns(again[0]) == columns(whole[0]) and again[1] == whole[1]
    finally:
        files.write_json(marker, values)


def test_no_pair_of_views_rendered_together_is_lost_to_the_holdout() -> None:
    frames, pairs = np.arange(20), np.arange(20).reshape(10, 2)
    for object in range(30):
        held = held_out_arc(frames, pairs, 0.2, 0, f"object {object}")
        assert held.sum() == 4 and (held[pairs[:, 0]] == held[pairs[:, 1]]).all()
    fewer = np.delete(pairs, 4, axis=0)  # a pair was dropped, its views are there
    held = held_out_arc(frames, fewer, 0.25, 0, "object")
    assert (held[fewer[:, 0]] == held[fewer[:, 1]]).all() and held.any()
