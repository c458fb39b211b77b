from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tiny_views import write_views
from torch import Tensor, nn

from dope.commands.places import run_and_shards
from dope.common.errors import BadInput, UsageError
from dope.encoders.embedder import EncoderEmbedder
from dope.encoders.features import read_features
from dope.encoders.load import LoadedEncoder, load_encoder
from dope.encoders.on_shards import default_folder, encoder_on_shards

SOURCE = """
import torch
from torch import nn

VERSION = 3

def encode(images):
    return images.mean((2, 3))

def factory():
    return encode

def makes_nothing(name="x"):
    return None

def fails():
    raise RuntimeError("no weights")

class Net(nn.Module):
    def __init__(self):
        super().__init__()
        self.norm = nn.BatchNorm2d(3)

    def forward(self, images):
        return self.norm(images)

net = Net()

class Holder:
    encode = staticmethod(encode)
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A module in the current directory, of a name of its own, forgotten afterwards."""
    name = f"encoder_{hashlib.sha256(str(tmp_path).encode()).hexdigest()[:8]}"
    (tmp_path / f"{name}.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return name


IMAGES = torch.rand(3, 3, 16, 16, generator=torch.Generator().manual_seed(0))


def embedder(encode: Callable[[Tensor], Any], sample: Tensor = IMAGES, **options: Any) -> EncoderEmbedder:
    return EncoderEmbedder(LoadedEncoder(encode, "m:f", "aa", ""), sample, **options)


def dense(images: Tensor) -> Tensor:
    return nn.functional.avg_pool2d(images, 4) - 0.5


@pytest.mark.parametrize("attribute", ["encode", "factory", "Holder.encode"])
def test_an_encoder_of_the_current_directory_is_found_with_its_hash(module: str, attribute: str) -> None:
    loaded = load_encoder(f"{module}:{attribute}")
    torch.testing.assert_close(loaded.encode(IMAGES), IMAGES.mean((2, 3)))
    assert loaded.name == f"{module}:{attribute}"
    assert loaded.sha256 == hashlib.sha256(Path(f"{module}.py").read_bytes()).hexdigest()


def test_a_file_is_an_encoder_too_and_finds_its_neighbours(module: str, tmp_path: Path) -> None:
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "mine.py").write_text("from neighbour_of_mine import encode\n")
    (inner / "neighbour_of_mine.py").write_text(SOURCE)
    before = list(sys.path)
    loaded = load_encoder("inner/mine.py:encode")
    assert loaded.name == "inner/mine.py:encode" and loaded.encode(IMAGES).shape == (3, 3)
    assert sys.path == before


@pytest.mark.parametrize("attribute", ["Net", "net"])
def test_modules_are_set_to_eval_mode_and_their_weights_are_told_apart(module: str, attribute: str) -> None:
    loaded = load_encoder(f"{module}:{attribute}")
    net = loaded.encode
    assert isinstance(net, nn.Module) and not net.training
    with torch.no_grad():
        net.norm.weight.add_(1)  # type: ignore[operator, union-attr]
    sys.modules[module].net = net  # type: ignore[attr-defined]
    assert load_encoder(f"{module}:net").config_hash != loaded.config_hash
    sys.modules[module].net = sys.modules[module].Net()  # type: ignore[attr-defined]
    assert load_encoder(f"{module}:net").config_hash == loaded.config_hash


@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("encode", UsageError, "'encode' is not an encoder. Say module:function"),
        (":encode", UsageError, "is not an encoder"),
        ("MODULE:", UsageError, "is not an encoder"),
        ("no_such_module:encode", UsageError, "no module 'no_such_module'.*current directory"),
        ("no_such.py:encode", UsageError, "no such file"),
        ("MODULE:encod", UsageError, "no 'encod'. Did you mean 'encode'"),
        ("MODULE:VERSION", UsageError, "is a int, not a function of images"),
        ("MODULE:makes_nothing", UsageError, "takes no arguments, and returns a NoneType"),
        ("MODULE:fails", BadInput, "as a factory, it fails: RuntimeError: no weights"),
        ("broken:encode", BadInput, "cannot be imported: SyntaxError"),
        ("needy:encode", BadInput, "imports 'not_installed_at_all', which is not installed"),
    ],
)
def test_what_is_no_encoder_is_explained(module: str, text: str, kind: type[Exception], message: str) -> None:
    Path("broken.py").write_text("def encode(images:\n")
    Path("needy.py").write_text("import not_installed_at_all\n")
    with pytest.raises(kind, match=message) as error:
        load_encoder(text.replace("MODULE", module))
    assert "--encoder" in str(error.value)


def test_all_forms_of_features_are_read() -> None:
    maps, vectors, mask = torch.randn(3, 5, 2, 2), torch.randn(3, 7), torch.rand(3, 2, 2)
    assert read_features(vectors, 3, "m:f").pooled is vectors
    assert read_features(maps.double(), 3, "m:f").dense.dtype == torch.float32  # type: ignore[union-attr]
    for output in (
        (maps, mask),
        [maps, mask[:, None]],
        {"dense": maps, "mask": mask},
        {"features": maps, "mask": mask},
    ):
        read = read_features(output, 3, "m:f")
        assert read.pooled is None
        torch.testing.assert_close(read.dense, maps)
        torch.testing.assert_close(read.mask, mask)
    both = read_features({"dense": maps, "pooled": vectors, "mask": None}, 3, "m:f")
    assert both.dense is not None and both.pooled is not None and both.mask is None
    assert read_features((maps, mask > 0.5), 3, "m:f").mask.unique().tolist() == [0, 1]  # type: ignore[union-attr]


NAN = torch.full((3, 5), float("nan"))


@pytest.mark.parametrize(
    ("output", "message"),
    [
        (None, "returned a NoneType"),
        (np.zeros((3, 5)), "returned a ndarray"),
        ((torch.zeros(3, 5),) * 3, "returned a tuple of 3"),
        ({"tokens": torch.zeros(3, 5)}, "returned a dict of tokens"),
        ({"mask": torch.zeros(3, 2, 2)}, "returned a dict of mask"),
        ({"dense": [1, 2]}, "dense is a list instead of a tensor"),
        (torch.zeros(3, 5, 4), "features has shape 3x5x4"),
        ({"dense": torch.zeros(3, 5)}, "dense has shape 3x5"),
        (torch.zeros(3, 5, dtype=torch.int64), "int64, not of floats"),
        (torch.zeros(4, 5), "shape 4x5 for 3 images"),
        (torch.zeros(3, 0), "shape 3x0"),
        (NAN, "not finite"),
        ((torch.zeros(3, 5), torch.zeros(3, 2, 2)), "no dense features"),
        ((torch.zeros(3, 5, 2, 2), torch.zeros(3, 4, 4)), "mask has shape 3x4x4, dense features 3x5x2x2"),
        ((torch.zeros(3, 5, 2, 2), torch.full((3, 2, 2), 4.0)), "values from 4 to 4.*sigmoid"),
    ],
)
def test_what_are_no_features_is_explained(output: object, message: str) -> None:
    with pytest.raises(BadInput, match=message) as error:
        read_features(output, 3, "m:f")
    assert str(error.value).startswith("--encoder m:f: ")


def test_an_encoder_that_raises_is_named() -> None:
    def encode(images: Tensor) -> Tensor:
        raise ValueError("wants 224 px")

    with pytest.raises(BadInput, match="--encoder m:f: fails on images 3x3x16x16 of cpu: ValueError: wants 224 px"):
        embedder(encode)


def test_features_that_depend_on_the_batch_are_refused() -> None:
    with pytest.raises(BadInput, match="pooled features of an image differ with the others of its batch"):
        embedder(lambda images: images.mean((2, 3)) - images.mean((0, 2, 3)))
    with pytest.raises(BadInput, match=r"features has shape 3\."):
        embedder(lambda images: images.mean((2, 3)).squeeze(0))
    with pytest.raises(BadInput, match="sizes pooled 3, then of pooled 1 for 1 images"):
        embedder(lambda images: images.mean((2, 3))[:, : len(images)])
    found = embedder(lambda images: dense(images))
    with pytest.raises(BadInput, match="dense 3x4x4, then of dense 3x8x8"):
        found.pooled(torch.rand(1, 3, 32, 32))


def test_pooled_features_stay_raw_and_have_no_cells() -> None:
    found = embedder(lambda images: 7 * images.mean((2, 3)))
    assert not found.has_dense and found.own_classifier == "nearest" and found.name == "m:f"
    torch.testing.assert_close(found.pooled(IMAGES), 7 * IMAGES.mean((2, 3)))
    with pytest.raises(UsageError, match=r"--classifier local: m:f has no dense features.*here: nearest"):
        found.cells(IMAGES)
    with pytest.raises(UsageError, match="--encoder-mask given: m:f has pooled features only"):
        embedder(lambda images: images.mean((2, 3)), mask="given")


def as_map(cells: Any) -> Tensor:
    return cells.at(np.arange(len(cells))).T.unflatten(1, cells.grid)


def test_cells_are_unit_vectors_times_the_encoders_mask() -> None:
    mask = torch.rand(3, 4, 4, generator=torch.Generator().manual_seed(1))
    found = embedder(lambda images: (dense(images), mask[: len(images)]))
    assert found.has_dense and found.own_classifier == "local"
    expected = nn.functional.normalize(dense(IMAGES), dim=1) * mask[:, None]
    for i, cells in enumerate(found.cells(IMAGES)):
        torch.testing.assert_close(as_map(cells), expected[i])
        np.testing.assert_allclose(cells.norm_map, mask[i].numpy(), rtol=1e-5)
        assert (np.diff(cells.norms) <= 0).all()
        torch.testing.assert_close(cells.descriptors(2, 5).norm(dim=1), torch.from_numpy(cells.norms[2:5]))
    weighted = (dense(IMAGES) * mask[:, None]).sum((2, 3)) / mask.sum((1, 2))[:, None]
    torch.testing.assert_close(found.pooled(IMAGES), weighted)


def test_without_a_mask_every_cell_is_foreground() -> None:
    found = embedder(dense)
    for cells in found.cells(IMAGES):
        np.testing.assert_allclose(cells.norms, 1, rtol=1e-6)
    torch.testing.assert_close(found.pooled(IMAGES), dense(IMAGES).mean((2, 3)))


def test_given_masks_are_shrunk_by_area_and_take_the_place_of_the_encoders() -> None:
    masks = torch.zeros(3, 16, 16, dtype=torch.bool)
    masks[:, :4, :6] = True  # covers cell (0, 0), and half of cell (0, 1)
    found = embedder(lambda images: (dense(images), torch.full((len(images), 4, 4), 0.3)), mask="given")
    assert found.wants_masks and found.name == "m:f + given masks"
    cells = found.cells(IMAGES, masks)[0]
    np.testing.assert_allclose(cells.norm_map[0], [1, 0.5, 0, 0], rtol=1e-6)
    assert not cells.norm_map[1:].any()
    maps = dense(IMAGES)
    torch.testing.assert_close(found.pooled(IMAGES, masks), (maps[:, :, 0, 0] + 0.5 * maps[:, :, 0, 1]) / 1.5)


def test_a_view_whose_mask_is_empty_is_pooled_over_all_cells() -> None:
    found = embedder(dense, mask="given")
    torch.testing.assert_close(
        found.pooled(IMAGES, torch.zeros(3, 16, 16, dtype=torch.bool)), dense(IMAGES).mean((2, 3))
    )


def test_an_encoders_own_pooled_features_are_used() -> None:
    found = embedder(lambda images: {"dense": dense(images), "pooled": images[:, :2, 0, 0]})
    torch.testing.assert_close(found.pooled(IMAGES), IMAGES[:, :2, 0, 0])
    assert found.has_dense and found.cells(IMAGES)[0].dim == 3


def test_an_encoder_may_change_its_images_in_place() -> None:
    before = IMAGES.clone()
    found = embedder(lambda images: images.sub_(0.5).mean((2, 3)))
    torch.testing.assert_close(found.pooled(IMAGES), before.mean((2, 3)) - 0.5)
    assert torch.equal(IMAGES, before)


def test_half_precision_is_read_as_float32() -> None:
    found = embedder(lambda images: dense(images).half())
    assert found.pooled(IMAGES).dtype == found.cells(IMAGES)[0].descriptors(0, 2).dtype == torch.float32


def test_run_and_shards_or_shards_and_encoder() -> None:
    assert run_and_shards(["run", "shards"], None) == (Path("run"), "shards")
    assert run_and_shards(["s3://bucket/shards"], "m:f") == (None, "s3://bucket/shards")
    for places, encoder, message in [
        (["shards"], None, "shards: RUN and SHARDS are needed, here is one of them.*--encoder"),
        (["a", "b", "c"], None, "here are 3 arguments"),
        (["run", "shards"], "m:f", "--encoder m:f: a run and an encoder are given. Leave out run"),
        (["a", "b", "c"], "m:f", "SHARDS alone is needed, here are 3 arguments"),
    ]:
        with pytest.raises(UsageError, match=message):
            run_and_shards(places, encoder)


def test_rows_of_an_encoder_say_which_one(module: str, tmp_path: Path) -> None:
    shards = write_views(tmp_path / "shards", objects=2)
    subject = encoder_on_shards(f"{module}:Net", shards, mask="given")
    columns = subject.columns
    assert subject.embedder.wants_masks and columns["method"] == f"{module}:Net + given masks"
    assert columns["checkpoint_sha256"] == hashlib.sha256(Path(f"{module}.py").read_bytes()).hexdigest()
    assert columns["config_hash"] and (columns["run"], columns["step"]) == ("", None)
    folders = [default_folder(name) for name in ("hf:models/x?pool=cls", "m:f + given masks", "../:", "...")]
    assert [str(folder) for folder in folders] == [
        "eval/hf_models_x_pool_cls", "eval/m_f_+_given_masks", "eval/encoder", "eval/encoder"
    ]  # fmt: skip
