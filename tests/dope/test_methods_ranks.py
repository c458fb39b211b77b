"""The methods that contrast whole views: two ranks learn what one process learns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import method_ranks
import pytest
import torch
from test_distributed import torchrun
from tiny_shards import write_shards
from tiny_views import write_views

from dope.distributed import Ranks

ALONE = Ranks(0, 1, torch.device("cpu"))
pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_shards(tmp_path_factory.mktemp("shards"), n_objects=16, pairs=1, size=32, n_points=10)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_views(tmp_path_factory.mktemp("views"), categories=4, objects=5, size=32)
    shard = folder / "views-000000.tar"
    facts = {"bytes": shard.stat().st_size, "sha256": "0" * 64}
    (folder / "dataset.json").write_text(json.dumps({"shards": {shard.name: facts}}))
    return folder


@pytest.fixture(scope="module")
def outcomes(shards: Path, views: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[dict[str, Any]]]:
    out = tmp_path_factory.mktemp("outcomes")
    torchrun(2, str(Path(method_ranks.__file__)), str(shards), str(views), str(out))
    return {v: [torch.load(out / f"{v}-{rank}.pt") for rank in (0, 1)] for v in method_ranks.VARIANTS}


@pytest.mark.parametrize("variant", method_ranks.VARIANTS)
def test_losses_gradients_and_queues_do_not_depend_on_the_number_of_ranks(
    shards: Path, views: Path, outcomes: dict[str, list[dict[str, Any]]], variant: str
) -> None:
    torch.set_num_threads(1)
    alone = method_ranks.outcome(views if variant.startswith("supmoco") else shards, variant, ALONE)
    for found in outcomes[variant]:
        assert found["stop"] and not alone["stop"]
        for ours, theirs in zip(found["reports"], alone["reports"], strict=True):
            assert ours == pytest.approx(theirs, abs=1e-8)
        for name, gradient in alone["gradients"].items():
            torch.testing.assert_close(found["gradients"][name], gradient, atol=1e-7, rtol=1e-6, msg=name)
        for name, value in alone["companion"].items():
            torch.testing.assert_close(found["companion"][name], value, atol=1e-7, rtol=1e-6, msg=name)
        for ours, theirs in zip(found["statistics"], alone["statistics"], strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-7, rtol=1e-6)
