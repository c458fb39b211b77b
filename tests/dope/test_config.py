import json
from pathlib import Path

import pytest

from dope import preset_files
from dope.common.errors import UsageError
from dope.common.settings import to_dict
from dope.config import TrainConfig, differing_keys, load_config
from dope.preset_files import preset_names, preset_summary


def test_the_defaults_and_the_paper_preset_are_the_papers() -> None:
    config = load_config("paper")
    assert config == TrainConfig()
    assert (config.data.image_size, config.data.batch_size, config.data.points) == (224, 256, 32)
    assert config.network.projector == (1024, 1024, 1024, 256)
    assert (config.loss.temperature, config.loss.negatives, config.loss.mask_weight) == (0.1, "both", 1.0)
    assert (config.optimiser.lr, config.optimiser.weight_decay) == (1e-4, 1e-2)
    assert (config.schedule.epochs, config.schedule.per, config.schedule.warmup_steps) == (3000, "epoch", 0)
    assert (config.momentum, config.seed, config.pairs) == (0.999, 12345, "two_views")


def test_every_preset_resolves_and_says_what_it_is() -> None:
    papers = ["paper", "paper_abc", "paper_co3d", "paper_modelnet", "paper_shapenet"]
    assert preset_names() == ["fast", "nano", *papers]
    for name in preset_names():
        load_config(name)
        assert 20 < len(preset_summary(name)) < 80 and preset_summary(name).endswith(".")
    assert all(load_config(name) == TrainConfig() for name in papers)


@pytest.mark.parametrize("dataset", ["modelnet40", "shapenet55", "co3d"])
def test_the_papers_presets_know_their_datasets(dataset: str) -> None:
    table = preset_files.PRESETS.parent / f"splits/{dataset}_ls.json"
    objects = sum(json.loads(table.read_text())["train"].values())
    text = (preset_files.PRESETS / f"paper_{dataset.rstrip('0123456789')}.yaml").read_text()
    assert f"{objects:,} " in text
    assert f"{objects // 256} steps an epoch, {objects // 256 * 3000:,} in all" in text


def test_the_fast_preset_says_only_what_differs() -> None:
    fast, paper = load_config("fast"), load_config("paper")
    assert (fast.network, fast.augmentation, fast.loss, fast.data) == (
        paper.network, paper.augmentation, paper.loss, paper.data,
    )  # fmt: skip
    assert fast.schedule.per == "step" and fast.schedule.warmup_steps > 0 and fast.optimiser.lr > paper.optimiser.lr
    policy = fast.checkpoint
    assert policy.every_steps > 0 and policy.keep == 3 and policy.keep_best


@pytest.fixture
def presets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(preset_files, "PRESETS", tmp_path)
    return tmp_path


def test_a_preset_extends_another(presets: Path) -> None:
    (presets / "base.yaml").write_text("data: {batch_size: 64, points: 8}\nmomentum: 0.5\n")
    (presets / "middle.yaml").write_text("# In between.\nextends: base\ndata: {points: 9}\n")
    (presets / "top.yaml").write_text("extends: middle\nmomentum: 0.6\n")
    config = load_config("top")
    assert (config.data.batch_size, config.data.points, config.momentum) == (64, 9, 0.6)
    assert load_config("base").data.points == 8


def test_presets_that_extend_in_a_circle_or_nothing_known_are_errors(presets: Path) -> None:
    (presets / "one.yaml").write_text("extends: two\n")
    (presets / "two.yaml").write_text("extends: one\n")
    (presets / "three.yaml").write_text("extends: twoo\n")
    with pytest.raises(UsageError, match=r"one\.yaml: extends itself \(one -> two -> one\)"):
        load_config("one")
    with pytest.raises(UsageError, match=r"three\.yaml: extends: unknown preset 'twoo' \(did you mean 'two'"):
        load_config("three")


def test_a_file_goes_over_the_preset_and_overrides_over_both(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("optimiser: {lr: 2e-4}\ndata: {batch_size: 64}\n")
    config = load_config("nano", path, ["data.batch_size=32", "loss.negatives=second_view"])
    assert config.optimiser.lr == 2e-4
    assert config.data.batch_size == 32
    assert config.data.image_size == load_config("nano").data.image_size
    assert config.loss.negatives == "second_view"


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["data.bach_size=4"], "did you mean 'batch_size'"),
        (["optimizer.lr=1"], "did you mean 'optimiser'"),
        (["loss.negatives=all"], "not one of both, other_objects, second_view"),
        (["data.batch_size=many"], "not of type int"),
        (["data.batch_size"], "not key=value"),
        (["data.image_size=100"], "data.image_size: '100' must be a positive multiple of 32"),
        (["data.batch_size=1"], "data.batch_size: '1' must be at least 2"),
        (["loss.temperature=0"], "must be positive"),
        (["momentum=1.5"], r"must lie in \[0, 1\]"),
        (["data.max_points=3"], "must not be less than data.points"),
        (["network.pyramid=0"], "network.pyramid: '0' must be at least 1"),
        (["network.projector=[]"], "network.projector: .* must be one or more widths"),
        (["augmentation.gamma=[0, 1]"], "augmentation.gamma: .* must be positive"),
        (["augmentation.noise=500"], r"must lie in \[0, 256\]"),
        (["augmentation.colour_p=2"], r"augmentation.colour_p: '2.0' must lie in \[0, 1\]"),
        (["augmentation.hue=[0.5, -0.5]"], "augmentation.hue: .* must be the least value, then the greatest"),
        (["augmentation.contrast=[-1, 1]"], "augmentation.contrast: .* must not be negative"),
        (["augmentation.longest_side_px=[0, 0]"], "augmentation.longest_side_px: .* must be at least 1"),
        (["augmentation.longest_side_px=[56, 300]"], "must not be more than the view's 224 px"),
        (["augmentation.margin_px=15"], "augmentation.margin_px: '15.0' must be 0 or more and leave"),
        (["optimiser.weight_decay=-1"], "optimiser.weight_decay: '-1.0' must not be negative"),
        (["optimiser.betas=[0.9, 1.0]"], r"optimiser.betas: .* must lie in \[0, 1\)"),
        (["optimiser.lr=.inf"], "optimiser.lr: 'inf' must be finite"),
        (["network.width=.inf"], "network.width: 'inf' must be finite"),
        (["augmentation.contrast=[.nan, 1]"], "augmentation.contrast: .* must be finite"),
        (["loss.negatives=second_view", "data.points=1"], "data.points: '1' must be at least 2"),
        (["checkpoint.every_steps=-1"], "checkpoint.every_steps: '-1' must not be negative"),
        (["checkpoint.keep_best=true", "validation.every=0"], "checkpoint.keep_best: 'True' needs validation.every"),
        (["log.every=0"], "log.every: '0' must be at least 1"),
        (["log.pictures=-1"], "log.pictures: '-1' must not be negative"),
    ],
)
def test_wrong_settings_are_named(overrides: list[str], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        load_config("paper", None, overrides)


def test_a_bare_off_is_a_word_where_a_word_is_wanted() -> None:
    config = load_config("paper", None, ["augmentation.background_removal=off", "network.predict_mask=off"])
    assert config.augmentation.background_removal == "off"
    assert config.network.predict_mask is False


def test_an_unknown_preset_names_the_closest() -> None:
    with pytest.raises(UsageError, match="did you mean 'nano'"):
        load_config("nan0")


def test_an_unknown_key_in_a_file_names_the_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("schedule: {epoch: 3}\n")
    with pytest.raises(UsageError, match=r"mine\.yaml: schedule: unknown key 'epoch' \(did you mean 'epochs'"):
        load_config(None, path)


def test_only_what_changes_the_result_counts_as_a_difference() -> None:
    ours = to_dict(
        load_config("paper", None, ["data.workers=1", "device=cpu", "log.every=3", "checkpoint.keep=3", "momentum=0.9"])
    )
    assert differing_keys(ours, to_dict(TrainConfig())) == {"momentum": (0.9, 0.999)}
    assert differing_keys({"betas": (0.9, 0.99)}, {"betas": [0.9, 0.99]}) == {}
