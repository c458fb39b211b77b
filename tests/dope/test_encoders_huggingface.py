"""The adapter with a stand-in for transformers; and, where transformers is installed, with tiny models of its own."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from dope.common.errors import BadInput, DopeError, UsageError
from dope.encoders.embedder import EncoderEmbedder
from dope.encoders.huggingface import Preprocessing, read_preprocessing, round_to_multiple
from dope.encoders.load import load_encoder

MEAN, STD = [0.5, 0.4, 0.3], [0.2, 0.25, 0.5]
DIM, REGISTERS = 3, 2


class PatchColours(nn.Module):
    """Tokens: CLS (the image's mean), registers (of 99), then each patch's mean colour, row by row."""

    def __init__(self, config: SimpleNamespace, special: int = 1 + REGISTERS) -> None:
        super().__init__()
        self.config, self.special = config, special
        self.scale = nn.Parameter(torch.ones(1))

    def forward(self, pixel_values: Tensor) -> SimpleNamespace:
        patches = nn.functional.avg_pool2d(pixel_values, self.config.patch_size).flatten(2).transpose(1, 2)
        cls = pixel_values.mean((2, 3))[:, None]
        registers = torch.full((len(cls), max(0, self.special - 1), DIM), 99.0)
        tokens = [cls, registers, patches] if self.special else [patches]
        return SimpleNamespace(last_hidden_state=torch.cat(tokens, 1) * self.scale)


class FakeTransformers(ModuleType):
    """AutoConfig and AutoModel, which note how they were called."""

    __version__ = "0.0"

    def __init__(self, *, special: int = 1 + REGISTERS, missing: tuple[str, ...] = ()) -> None:
        super().__init__("transformers")
        self.calls: list[dict[str, Any]] = []
        logging = SimpleNamespace(
            is_progress_bar_enabled=lambda: False, disable_progress_bar=lambda: None, enable_progress_bar=lambda: None
        )
        self.utils = SimpleNamespace(logging=logging)

        def config_of(folder: str, **options: Any) -> SimpleNamespace:
            self.calls.append(options)
            return SimpleNamespace(**json.loads((Path(folder) / "config.json").read_text()))

        def model_of(folder: str, *, config: SimpleNamespace, **options: Any) -> tuple[nn.Module, dict[str, Any]]:
            self.calls.append(options)
            return PatchColours(config, special), {"missing_keys": list(missing)}

        self.AutoConfig = SimpleNamespace(from_pretrained=config_of)
        self.AutoModel = SimpleNamespace(from_pretrained=model_of)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeTransformers:
    module = FakeTransformers()
    monkeypatch.setitem(sys.modules, "transformers", module)
    return module


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_model(tmp_path / "tiny")


def write_model(folder: Path, **preprocessor: Any) -> Path:
    folder.mkdir()
    config = {"model_type": "fake", "patch_size": 8, "num_register_tokens": REGISTERS}
    (folder / "config.json").write_text(json.dumps(config))
    values = {"image_mean": MEAN, "image_std": STD, "size": {"shortest_edge": 40}, **preprocessor}
    (folder / "preprocessor_config.json").write_text(json.dumps(values))
    (folder / "model.safetensors").write_bytes(b"weights")
    return folder


IMAGES = torch.rand(2, 3, 40, 40, generator=torch.Generator().manual_seed(0))
NORMALISED = (IMAGES - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)


def test_patch_tokens_are_the_grid_without_cls_and_registers(fake: FakeTransformers, folder: Path) -> None:
    loaded = load_encoder(f"hf:{folder}")
    found = EncoderEmbedder(loaded, IMAGES)
    expected = nn.functional.avg_pool2d(NORMALISED, 8)
    cells = found.cells(IMAGES)
    assert loaded.name == "hf:tiny" and cells[0].grid == (5, 5)
    unit = nn.functional.normalize(expected[1], dim=0)
    torch.testing.assert_close(cells[1].at(torch.arange(25).numpy()).T.unflatten(1, (5, 5)), unit)
    torch.testing.assert_close(found.pooled(IMAGES), expected.mean((2, 3)))


def test_the_cls_token_is_pooled_on_demand(fake: FakeTransformers, folder: Path) -> None:
    loaded = load_encoder(f"hf:{folder}?pool=cls")
    assert loaded.name == "hf:tiny?pool=cls" and loaded.config_hash != load_encoder(f"hf:{folder}").config_hash
    torch.testing.assert_close(EncoderEmbedder(loaded, IMAGES).pooled(IMAGES), NORMALISED.mean((2, 3)))


def test_nothing_is_fetched_and_no_code_or_pickle_of_the_folder_runs(fake: FakeTransformers, folder: Path) -> None:
    load_encoder(f"hf:{folder}")
    assert len(fake.calls) == 2
    assert all(call["local_files_only"] is True and call["trust_remote_code"] is False for call in fake.calls)
    assert fake.calls[1]["use_safetensors"] is True


def test_sides_are_rounded_to_patches(fake: FakeTransformers, folder: Path) -> None:
    assert [round_to_multiple(side, 14) for side in (1, 14, 20, 21, 224, 230, 231)] == [14, 14, 14, 28, 224, 224, 238]
    for size, grid in ((64, (8, 8)), (37, (5, 5))):
        found = EncoderEmbedder(load_encoder(f"hf:{folder}?size={size}"), torch.rand(1, 3, 30, 30))
        assert found.cells(torch.rand(1, 3, 30, 30))[0].grid == grid


def test_models_without_special_tokens_have_no_cls(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setitem(sys.modules, "transformers", FakeTransformers(special=0))
    assert EncoderEmbedder(load_encoder(f"hf:{folder}"), IMAGES).cells(IMAGES)[0].grid == (5, 5)
    with pytest.raises(UsageError, match="no CLS token"):
        EncoderEmbedder(load_encoder(f"hf:{folder}?pool=cls"), IMAGES)
    monkeypatch.setitem(sys.modules, "transformers", FakeTransformers(special=2))
    with pytest.raises(BadInput, match="27 tokens are not 5x5 patches, alone or after CLS and 2 registers"):
        EncoderEmbedder(load_encoder(f"hf:{folder}"), IMAGES)


def test_weights_that_would_be_random_are_refused(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setitem(sys.modules, "transformers", FakeTransformers(missing=("pooler.dense.weight",)))
    load_encoder(f"hf:{folder}")
    monkeypatch.setitem(sys.modules, "transformers", FakeTransformers(missing=("encoder.0.weight", "pooler.x")))
    with pytest.raises(BadInput, match=r"lacks 1 of the model's weights \(encoder.0.weight\), which would be random"):
        load_encoder(f"hf:{folder}")


def test_the_identity_changes_with_the_weights(fake: FakeTransformers, folder: Path) -> None:
    before = load_encoder(f"hf:{folder}")
    (folder / "model.safetensors").write_bytes(b"other weights")
    after = load_encoder(f"hf:{folder}")
    assert before.sha256 != after.sha256 and before.config_hash == after.config_hash


def test_missing_transformers_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(DopeError, match=r"transformers is needed.*pip install transformers"):
        load_encoder(f"hf:{folder}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("hf:facebook/dinov2-small", "no folder 'facebook/dinov2-small'.*hf download facebook/dinov2-small"),
        ("hf:", "no folder ''"),
        ("hf:FOLDER?pool=max", "pool is 'max'. It is mean or cls"),
        ("hf:FOLDER?size=0", "size is '0'"),
        ("hf:FOLDER?size=big", "size is 'big'"),
        ("hf:FOLDER?crop=1", "unknown option 'crop'"),
    ],
)
def test_wrong_texts_are_explained(fake: FakeTransformers, folder: Path, text: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_encoder(text.replace("FOLDER", str(folder)))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.json", None, "has no config.json"),
        ("config.json", "{}", "has no model_type"),
        ("config.json", "{", "config.json"),
        ("preprocessor_config.json", None, "has no preprocessor_config.json"),
        ("preprocessor_config.json", '{"image_mean": [0, 0, 0]}', "no usable image_mean, image_std and size"),
        ("preprocessor_config.json", "[]", "no usable image_mean"),
        ("model.safetensors", None, "no weights as .safetensors"),
    ],
)
def test_incomplete_folders_are_explained(
    fake: FakeTransformers, folder: Path, name: str, content: str | None, message: str
) -> None:
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_text(content)
    with pytest.raises(BadInput, match=message):
        load_encoder(f"hf:{folder}")


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"size": 32}, 32),
        ({"size": {"height": 48, "width": 48}}, 48),
        ({"size": {"shortest_edge": 256}, "crop_size": {"height": 224, "width": 224}, "do_center_crop": True}, 224),
        ({"size": {"shortest_edge": 256}, "crop_size": {"height": 224, "width": 224}, "do_center_crop": False}, 256),
        ({"size": {"height": 48, "width": 32}}, None),
        ({"image_std": [0, 1, 1]}, None),
        ({"image_mean": [0.5]}, None),
    ],
)
def test_preprocessing_is_read(tmp_path: Path, values: dict[str, Any], expected: int | None) -> None:
    path = write_model(tmp_path / "model", **values) / "preprocessor_config.json"
    if expected is None:
        with pytest.raises(BadInput, match="has no usable"):
            read_preprocessing(path)
    else:
        assert read_preprocessing(path) == Preprocessing(tuple(MEAN), tuple(STD), expected)  # type: ignore[arg-type]
        assert read_preprocessing(path, 7).side == 7


def test_images_that_were_never_normalised_are_not(tmp_path: Path) -> None:
    path = write_model(tmp_path / "model", do_normalize=False) / "preprocessor_config.json"
    assert read_preprocessing(path) == Preprocessing((0, 0, 0), (1, 1, 1), 40)


@pytest.mark.parametrize("registers", [0, 3])
def test_with_transformers_tokens_are_those_of_the_model(tmp_path: Path, registers: int) -> None:
    transformers = pytest.importorskip("transformers", reason="transformers is not installed (optional)")
    torch.manual_seed(0)
    sizes = {"hidden_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "image_size": 42, "patch_size": 14}
    if registers:
        config = transformers.Dinov2WithRegistersConfig(**sizes, num_register_tokens=registers)
        model = transformers.Dinov2WithRegistersModel(config).eval()
    else:
        model = transformers.Dinov2Model(transformers.Dinov2Config(**sizes)).eval()
    folder = write_model(tmp_path / "dinov2")
    (folder / "model.safetensors").unlink()
    model.save_pretrained(folder)
    images = torch.rand(2, 3, 42, 42)
    found = EncoderEmbedder(load_encoder(f"hf:{folder}?pool=cls"), images)
    pixels = (images - torch.tensor(MEAN).view(3, 1, 1)) / torch.tensor(STD).view(3, 1, 1)
    with torch.inference_mode():
        hidden = model(pixel_values=pixels).last_hidden_state
    torch.testing.assert_close(found.pooled(images), hidden[:, 0])
    unit = nn.functional.normalize(hidden[1, 1 + registers :], dim=1)
    torch.testing.assert_close(found.cells(images)[1].at(torch.arange(9).numpy()), unit)
