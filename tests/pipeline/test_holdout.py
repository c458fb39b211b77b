"""What is held out: a fair share, never both sides of one instance, and pairs left on either side."""

import numpy as np

from pipeline.shards.holdout import held_out_arc, held_out_objects


def test_held_out_objects_are_a_fair_share() -> None:
    objects: dict[str, tuple[str | None, str]] = {}
    for category, n in (("a", 20), ("b", 40), ("c", 8)):
        objects |= {f"{category}{i}": (category, f"{category}{i // 2}") for i in range(n)}
    chosen = held_out_objects(objects, 0.2, 0)
    assert {c: sum(id.startswith(c) for id in chosen) for c in "abc"} == {"a": 4, "b": 8, "c": 2}
    assert {objects[id] for id in chosen}.isdisjoint({objects[id] for id in objects if id not in chosen})
    assert held_out_objects(dict(reversed(objects.items())), 0.2, 0) == chosen != held_out_objects(objects, 0.2, 1)
    singles: dict[str, tuple[str | None, str]] = {name: (name, name) for name in "abcdefgh"}
    assert len(held_out_objects(singles, 0.25, 0)) == 2
    assert len(held_out_objects({"a": (None, "a"), "b": (None, "b")}, 0.01, 0)) == 1
    assert len(held_out_objects({"a": (None, "a"), "b": (None, "b")}, 0.99, 0)) == 1
    assert held_out_objects({"a": (None, "a")}, 0.5, 0) == set()


def test_the_arc_is_where_pairs_are() -> None:
    frames = np.arange(0, 60, 3)
    pairs = np.array([[0, 3], [0, 6], [3, 9], [30, 33], [30, 57]])
    for seed in range(10):
        held = held_out_arc(frames, pairs, 0.25, seed)
        inside = set(frames[held].tolist())
        assert len(inside) == 5 and np.ptp(frames[held]) == 12
        assert any({*pair} <= inside for pair in pairs.tolist())
        assert any(inside.isdisjoint(pair) for pair in pairs.tolist())
    assert not held_out_arc(frames, np.array([[0, 57]]), 0.25, 0).any()  # no arc holds this pair
    assert not held_out_arc(frames, np.array([[0, 3]]), 0.25, 0).any()  # nothing would be left to train on
    assert not held_out_arc(frames[:3], np.array([[0, 3], [3, 6]]), 0.25, 0).any()
