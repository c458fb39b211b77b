"""`dope eval SHARDS --encoder ...` from the command line to the table of `dope results`."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_views import write_views
from torch import Tensor, nn
from typer.testing import CliRunner

from cli import _explain, app
from dope.common.errors import BadInput, UsageError
from dope.encoders.embedder import EncoderEmbedder
from dope.encoders.load import LoadedEncoder
from dope.encoders.on_shards import encoder_on_shards
from dope.lowshot.encoding import to_tensor
from dope.lowshot.episodes import EpisodeConfig
from dope.lowshot.evaluate import EvaluationConfig, evaluate_embedders
from dope.lowshot.results import ResultRow, read_rows
from dope.lowshot.subjects import encoder_subject
from dope.lowshot.views import ViewShards

SOURCE = """
from torch.nn import functional

def dense(images):
    return functional.avg_pool2d(images, 8) - 0.5

def with_mask(images):
    return dense(images), functional.avg_pool2d(images[:, 0], 8)

def pooled(images):
    return images.mean((2, 3))

def nan(images):
    return dense(images) / 0
"""
FEW = ("--ways", "3", "--queries", "2", "--episodes", "6", "--device", "cpu")


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"))


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    name = f"features_{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:8]}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield name
    sys.modules.pop(name, None)


def command(*arguments: object) -> str:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def test_an_encoders_rows_say_which_and_stand_in_one_table(module: str, shards: Path) -> None:
    command("eval", shards, "--encoder", f"{module}:dense", *FEW)
    command("eval", shards, "--encoder", f"{module}:dense", "--encoder-mask", "given", *FEW)
    command("eval", shards, "--encoder", f"{module}:pooled", *FEW, "--out", "pooled")
    folders = [Path("eval") / f"{module}_dense", Path("eval") / f"{module}_dense_+_given_masks", Path("pooled")]
    rows = [read_rows(folder / "results.parquet")[0] for folder in folders]
    assert [row.method for row in rows] == [
        f"{module}:dense", f"{module}:dense + given masks", f"{module}:pooled"
    ]  # fmt: skip
    assert [row.classifier for row in rows] == ["local", "local", "nearest"]
    sha256 = hashlib.sha256(Path(f"{module}.py").read_bytes()).hexdigest()
    assert {(row.checkpoint_sha256, row.run, row.step) for row in rows} == {(sha256, "", None)}
    said = command("results", *folders, "--label", f"{module}:pooled=mean colour")
    assert f"{module}:dense + given masks" in said and "mean colour" in said and "1-NN" in said


def test_local_matching_is_the_papers_unless_asked_otherwise(module: str, shards: Path) -> None:
    asked: dict[str, tuple[object, ...]] = {
        "usual": (), "paper": ("--points", 20, "--foreground", 0.9),
        "fewer": ("--points", 3), "more": ("--foreground", 0.5),
    }  # fmt: skip
    for name, options in asked.items():
        command("eval", shards, "--encoder", f"{module}:dense", *FEW, *options, "--out", name)
    hashes = [read_rows(Path(name) / "results.parquet")[0].evaluation_hash for name in asked]
    assert hashes[0] == hashes[1] and len(set(hashes)) == 3  # tables refuse the others beside it


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("SHARDS",), "RUN and SHARDS are needed, here is one of them"),
        (("run", "SHARDS", "--encoder", "m:f"), "a run and an encoder are given"),
        (("run", "SHARDS", "--encoder-mask", "given"), "--encoder-mask given: is for --encoder"),
        (("SHARDS", "--encoder", "m:f", "--encoder-mask", "drawn"), "'drawn' is not one of none, given"),
        (("SHARDS", "--encoder", "m:f", "--select"), "--select: is for runs"),
        (("SHARDS", "--encoder", "m:f", "--compare-untrained"), "--compare-untrained: is for runs"),
        (("SHARDS", "--encoder", "no_such_module:f"), "no module 'no_such_module'"),
        (("SHARDS", "--encoder", "MODULE:pooled", "--classifier", "local"), "has no dense features"),
        (("SHARDS", "--encoder", "MODULE:dense", "--points", "0"), "--points: must be 1 or more"),
        (("SHARDS", "--encoder", "MODULE:dense", "--foreground", "1.5"), "--foreground: must be from 0 to 1"),
    ],
)
def test_wrong_combinations_are_explained(module: str, shards: Path, arguments: tuple[str, ...], message: str) -> None:
    places = {"SHARDS": str(shards)}
    with pytest.raises(UsageError, match=message):
        command("eval", *(places.get(a, a.replace("MODULE", module)) for a in arguments), *FEW)
    assert not Path("eval").exists()


def test_features_that_are_not_finite_stop_it(module: str, shards: Path) -> None:
    with pytest.raises(BadInput, match=f"--encoder {module}:nan: dense has values that are not finite"):
        command("eval", shards, "--encoder", f"{module}:nan", *FEW)


def test_an_encoders_name_is_printed_as_it_is(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And not ":zero:" and ":fire:" as pictures."""
    (tmp_path / "signs.py").write_text("def zero(images):\n    return images.new_zeros(len(images), 4, 8, 8)\n")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["eval", str(shards), "--encoder", "signs:zero", *FEW, "--out", "out"])
    assert done.exit_code == 0 and "--encoder signs:zero: " in done.output, done.output
    _explain(BadInput("fails", where="--encoder signs:fire"))
    assert "--encoder signs:fire: fails" in capsys.readouterr().err


def rows_of(subject: Any, shards: Path, **options: Any) -> tuple[ResultRow, ...]:
    protocols = tuple(EpisodeConfig(ways=3, shots=shots, queries=2, episodes=20) for shots in (1, 2))
    return evaluate_embedders([subject], shards, EvaluationConfig(protocols=protocols, **options)).rows


@pytest.mark.parametrize(("function", "mask"), [("dense", "given"), ("with_mask", "none"), ("pooled", "none")])
def test_results_do_not_depend_on_batches_or_memory(module: str, shards: Path, function: str, mask: Any) -> None:
    subject = encoder_on_shards(f"{module}:{function}", shards, mask=mask)
    whole = rows_of(subject, shards)
    assert whole == rows_of(subject, shards, batch=3, memory_gib=0.0) == rows_of(subject, shards, batch=1)
    assert {row.classifier for row in whole} == {"nearest" if function == "pooled" else "local"}


def test_given_masks_are_those_of_the_views(shards: Path) -> None:
    views = ViewShards(shards)
    (images,) = views.batches([0, 9], 2)
    tensor = to_tensor(images)
    seen: list[Tensor] = []

    class Watching(EncoderEmbedder):
        def cells(self, images: Tensor, masks: Tensor | None = None) -> Any:
            assert masks is not None
            seen.append(masks)
            return super().cells(images, masks)

    encoder = LoadedEncoder(lambda images: nn.functional.avg_pool2d(images, 8), "m:f", "", "")
    embedder = Watching(encoder, tensor, mask="given")
    rows_of(encoder_subject(embedder, label="m:f", sha256=None, config_hash=""), shards)
    given = np.concatenate([masks.cpu().numpy() for masks in seen])
    stored = {views.read(i).mask.tobytes() for i in range(len(views))}
    assert 0 < given.mean() < 1 and {mask.astype(bool).tobytes() for mask in given} <= stored
