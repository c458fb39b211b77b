"""Shards: stock WebDataset reads them, offsets are right, bytes repeat, nothing is lost when a run breaks off."""

import errno
import io
import itertools
import json
import shutil
import tarfile
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
import webdataset
from synthetic import Scene, orbit, write_sequence

from dope.common import files
from dope.common.errors import BadInput, DiskFull, UsageError
from pipeline.correspond.match import CorrespondConfig, correspond
from pipeline.correspond.pairs import PairsConfig
from pipeline.correspond.views import ViewsConfig, read_views
from pipeline.geometry import Camera, epipolar_distance_px, fundamental
from pipeline.sequence import Sequence
from pipeline.shards import writer as shard_writer
from pipeline.shards.dataset import ShardsConfig, verify_shards, write_shards
from pipeline.stages import StageResult, run_stage, write_marker

CORRESPOND = CorrespondConfig(ViewsConfig(every=1), PairsConfig(max_pairs=40))
CONFIG = ShardsConfig(samples_per_shard=25)
NAMES = ("apple_1", "apple_2", "bell", "Größe-7", "x" * 90)


def _correspond(sequence: Sequence, config: CorrespondConfig = CORRESPOND) -> None:
    assert run_stage(sequence, "correspond", config, sequence.id, lambda: correspond(sequence, config)).ok


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five sequences, the same pictures under different names and categories."""
    work = tmp_path_factory.mktemp("work")
    first = write_sequence(work / NAMES[0], orbit(20, width=160, height=120, focal=190), Scene("box"))
    _correspond(first)
    for name in NAMES[1:]:
        shutil.copytree(first.folder, work / name)
        info = first.read_info()
        info.id, info.instance, info.category = name, name, name.split("_")[0]
        Sequence(work / name).write_info(info)
    return work


@pytest.fixture(scope="module")
def sequences(work: Path) -> list[Sequence]:
    return [Sequence(work / name) for name in NAMES]


@pytest.fixture(scope="module")
def dataset(sequences: list[Sequence], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("shards") / "out"
    return out, write_shards(sequences, out, CONFIG)


def rows_of(out: Path, table: str = "index.parquet") -> list[dict[str, Any]]:
    return pq.read_table(out / table).to_pylist()


def stock_samples(out: Path, kind: str) -> list[dict[str, Any]]:
    paths = [str(path) for path in sorted(out.glob(f"{kind}-*.tar"))]
    return list(webdataset.WebDataset(paths, shardshuffle=False).decode("rgb8"))


def test_stock_webdataset_reads_pairs(dataset: tuple[Path, dict[str, Any]], sequences: list[Sequence]) -> None:
    out, _ = dataset
    for split in ("train", "val"):
        samples, rows = stock_samples(out, split), [row for row in rows_of(out) if row["split"] == split]
        assert [sample["__key__"] for sample in samples] == [row["key"] for row in rows]
        for sample, row in zip(samples, rows, strict=True):
            assert {name for name in sample if not name.startswith("__")} == {
                "1.jpg", "2.jpg", "1.png", "2.png", "corr.npy", "json"
            }  # fmt: skip
            assert sample["1.jpg"].shape == (224, 224, 3)
            assert sample["corr.npy"].dtype == np.float32 and sample["corr.npy"].shape == (row["n_correspondences"], 4)
            for name in ("sequence", "instance", "category", "frame1", "frame2", "angle_deg"):
                assert sample["json"][name] == row[name]


def test_the_cameras_and_points_of_a_sample_agree(dataset: tuple[Path, dict[str, Any]]) -> None:
    """K, R, t in the JSON explain the correspondences: the epipolar distance is a fraction of a pixel."""
    for sample in stock_samples(dataset[0], "train")[:10]:
        facts, points = sample["json"], sample["corr.npy"].astype(float)
        one, two = (
            Camera(
                224, 224, *(np.array(facts[f"K{n}"]), np.zeros(4), np.array(facts[f"R{n}"]), np.array(facts[f"t{n}"]))
            )
            for n in (1, 2)
        )
        distance = epipolar_distance_px(fundamental(one, two), points[:, :2], points[:, 2:])
        assert np.median(distance) < 0.01 and distance.max() < 1


def test_floats_and_files_are_passed_on_unchanged(dataset: tuple[Path, dict[str, Any]], work: Path) -> None:
    out, _ = dataset
    row = next(row for row in rows_of(out) if row["sequence"] == "bell")
    members = read_members(out, row)
    sequence = Sequence(work / "bell")
    for number in (1, 2):
        frame = row[f"frame{number}"]
        assert members[f"{number}.jpg"] == (sequence.views / f"{frame:06d}.jpg").read_bytes()
        assert members[f"{number}.png"] == (sequence.views / f"{frame:06d}.png").read_bytes()
        view = next(view for view in read_views(sequence) if view["frame"] == frame)
        facts = json.loads(members["json"])
        assert np.array(facts[f"R{number}"]).ravel().tolist() == view["R"] and facts[f"t{number}"] == view["t"]
        assert facts[f"K{number}"][0] == [view["fx"], 0.0, view["cx"]]
    pair = next(
        pair
        for pair in pq.read_table(sequence.correspondences).to_pylist()
        if (pair["frame1"], pair["frame2"]) == (row["frame1"], row["frame2"])
    )
    np.testing.assert_array_equal(np.load(io.BytesIO(members["corr.npy"])).ravel(), np.float32(pair["points"]))


def read_members(out: Path, row: dict[str, Any]) -> dict[str, bytes]:
    """The members of [offset, offset + size) of the shard, which must be a tar of its own."""
    data = (out / row["shard"]).read_bytes()[row["offset"] : row["offset"] + row["size"]]
    with tarfile.open(fileobj=io.BytesIO(data)) as tar:
        members = {member.name: tar.extractfile(member).read() for member in tar}  # type: ignore[union-attr]
    assert all(name.startswith(row["key"] + ".") for name in members)
    return {name[len(row["key"]) + 1 :]: content for name, content in members.items()}


def test_offsets_span_exactly_the_members(dataset: tuple[Path, dict[str, Any]]) -> None:
    out, _ = dataset
    for table, n in (("index.parquet", 6), ("views.parquet", 3)):
        rows = rows_of(out, table)
        for row in rows:
            assert len(read_members(out, row)) == n
        for before, after in itertools.pairwise(rows):
            if before["shard"] == after["shard"]:
                assert before["offset"] + before["size"] == after["offset"]
            else:
                assert after["offset"] == 0


def test_views_are_all_there(dataset: tuple[Path, dict[str, Any]]) -> None:
    out, details = dataset
    samples, rows = stock_samples(out, "views"), rows_of(out, "views.parquet")
    assert [sample["__key__"] for sample in samples] == [row["key"] for row in rows]
    assert len(rows) == 5 * 20 == sum(details["views"].values())
    for sample, row in zip(samples, rows, strict=True):
        assert sample["json"]["frame"] == row["frame"] and sample["json"]["category"] == row["category"]
        assert (sample["png"][..., 0] > 0).mean() == pytest.approx(row["mask_share"])
        assert np.array(sample["json"]["K"]).shape == (3, 3)


def test_no_held_out_view_is_in_a_training_pair(dataset: tuple[Path, dict[str, Any]]) -> None:
    out, details = dataset
    split_of = {(row["sequence"], row["frame"]): row["split"] for row in rows_of(out, "views.parquet")}
    for row in rows_of(out):
        assert {split_of[row["sequence"], row["frame1"]], split_of[row["sequence"], row["frame2"]]} == {row["split"]}
    for name in NAMES:
        held = [frame for (sequence, frame), split in split_of.items() if sequence == name and split == "val"]
        assert len(held) == 5 and np.ptp(held) == 4  # a quarter of 20, next to each other
    assert details["without_val_pairs"] == []
    assert all(any(r["sequence"] == name and r["split"] == "val" for r in rows_of(out)) for name in NAMES)
    total = sum(details["pairs"].values()) + details["mixed_pairs_not_written"]
    assert total == 5 * 40 and details["pairs"] == Counter(row["split"] for row in rows_of(out))


def test_pairs_come_in_rounds(dataset: tuple[Path, dict[str, Any]]) -> None:
    for split in ("train", "val"):
        seen: Counter[str] = Counter()
        order = []
        for row in rows_of(dataset[0]):
            if row["split"] == split:
                order.append((seen[row["sequence"]], row["sequence"]))
                seen[row["sequence"]] += 1
        assert [n for n, _ in order] == sorted(n for n, _ in order)
        assert {name for _, name in order[:5]} == set(NAMES)
        assert [name for _, name in order[:5]] != [name for _, name in order[5:10]]  # shuffled within rounds


def test_shards_are_of_even_size(dataset: tuple[Path, dict[str, Any]]) -> None:
    manifest = json.loads((dataset[0] / "dataset.json").read_text())
    for kind, n in (("train", dataset[1]["pairs"]["train"]), ("views", 100)):
        sizes = [entry["samples"] for name, entry in manifest["shards"].items() if name.startswith(kind)]
        assert sum(sizes) == n and max(sizes) <= 25 and max(sizes) - min(sizes) <= 1


def bytes_of(out: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in out.iterdir()}


def test_same_input_gives_the_same_bytes(
    dataset: tuple[Path, dict[str, Any]], sequences: list[Sequence], tmp_path: Path
) -> None:
    write_shards(sequences[::-1], tmp_path / "again", CONFIG)
    assert bytes_of(tmp_path / "again") == bytes_of(dataset[0])


def test_another_seed_orders_and_holds_out_differently(
    dataset: tuple[Path, dict[str, Any]], sequences: list[Sequence], tmp_path: Path
) -> None:
    write_shards(sequences, tmp_path / "other", replace(CONFIG, seed=1))
    one, two = ({(r["key"], r["split"]) for r in rows_of(out)} for out in (dataset[0], tmp_path / "other"))
    assert one != two


def test_what_is_there_is_not_written_again(sequences: list[Sequence], tmp_path: Path) -> None:
    out, calls = tmp_path / "out", []
    first = write_shards(sequences[:2], out, CONFIG, lambda done, total: calls.append((done, total)))
    assert calls[-1] == (calls[-1][1],) * 2 and [done for done, _ in calls] == sorted(done for done, _ in calls)
    stamp = (out / "dataset.json").stat().st_mtime_ns
    assert write_shards(sequences[:2], out, CONFIG) == {**first, "skipped": True}
    assert (out / "dataset.json").stat().st_mtime_ns == stamp
    assert not write_shards(sequences[:2], out, CONFIG, overwrite=True)["skipped"]
    assert not write_shards(sequences[:2], out, replace(CONFIG, seed=5))["skipped"]
    assert not write_shards(sequences[:3], out, replace(CONFIG, seed=5))["skipped"]
    (out / "val-000000.tar").unlink()
    assert not write_shards(sequences[:3], out, replace(CONFIG, seed=5))["skipped"]
    assert verify_shards(out)["samples"] == len(rows_of(out)) + len(rows_of(out, "views.parquet"))


def test_what_was_made_again_with_other_content_is_packed_again(work: Path, tmp_path: Path) -> None:
    bell = Sequence(Path(shutil.copytree(work / "bell", tmp_path / "bell")))
    out = tmp_path / "out"

    def again() -> bool:
        run_stage(bell, "correspond", CORRESPOND, "", lambda: correspond(bell, CORRESPOND), overwrite=True)
        return not write_shards([bell], out, CONFIG)["skipped"]

    assert again() and not again(), "the same content is the same dataset"
    frame = bell.read_frames()[4]
    mask = bell.read_mask(frame)
    assert mask is not None
    mask[: mask.shape[0] // 2] = False
    bell.write_mask(frame, mask)
    assert again()


def test_holding_out_whole_objects(sequences: list[Sequence], tmp_path: Path) -> None:
    details = write_shards(sequences, tmp_path / "out", replace(CONFIG, holdout="sequences", val_fraction=0.4))
    split_of = {row["sequence"]: row["split"] for row in rows_of(tmp_path / "out")}
    assert sorted(name for name, split in split_of.items() if split == "val") == details["val_sequences"]
    assert len(details["val_sequences"]) == 2 and details["mixed_pairs_not_written"] == 0
    assert split_of["apple_1"] != split_of["apple_2"] or "apple_1" not in details["val_sequences"]
    details = write_shards(sequences, tmp_path / "all", replace(CONFIG, holdout="none"))
    assert details["pairs"] == {"train": 200, "val": 0} and details["views"]["val"] == 0
    assert not list((tmp_path / "all").glob("val-*"))


def test_sequences_that_are_not_ready_are_listed(work: Path, sequences: list[Sequence], tmp_path: Path) -> None:
    flat = write_sequence(tmp_path / "flat", orbit(3, width=80, height=60, focal=90), depths=False)
    run_stage(flat, "correspond", CORRESPOND, "", lambda: correspond(flat, CORRESPOND))
    bare = write_sequence(tmp_path / "bare", orbit(1, width=80, height=60, focal=90), masks=False)
    run_stage(bare, "correspond", CORRESPOND, "", lambda: correspond(bare, CORRESPOND))
    never = write_sequence(tmp_path / "never", orbit(1, width=80, height=60, focal=90))
    lost = write_sequence(tmp_path / "lost", orbit(1, width=80, height=60, focal=90))
    write_marker(lost, StageResult("lost", "sfm", "failed", reason="nothing registers"))
    broken = Sequence(Path(shutil.copytree(work / "bell", tmp_path / "broken")))
    (broken.views / "000007.jpg").unlink()
    torn = Sequence(Path(shutil.copytree(work / "bell", tmp_path / "torn")))
    torn.correspondences.write_bytes(torn.correspondences.read_bytes()[:999])
    odd = Sequence(Path(shutil.copytree(work / "bell", tmp_path / "odd")))
    (odd.folder / "sequence.json").write_text("[]")
    details = write_shards([*sequences[:2], flat, bare, never, lost, broken, torn, odd], tmp_path / "out", CONFIG)
    assert details["sequences"] == 2
    reasons = details["left_out"]
    assert "empty: only 0 of 3 views" in reasons["flat"] and "dope prep masks" in reasons["bare"]
    assert reasons["lost"] == "stage 'sfm' failed: nothing registers"
    assert reasons["never"] == "stage 'correspond' has not been run"
    assert "000007.jpg" in reasons["broken"] and "correspondences.parquet" in reasons["torn"]
    assert "odd/sequence.json: is not a JSON object" in reasons["odd"]
    assert json.loads((tmp_path / "out/dataset.json").read_text())["counts"]["left_out"] == reasons
    with pytest.raises(BadInput, match=r"never: .*not been run.*dope prep correspond"):
        write_shards([never], tmp_path / "none", CONFIG)
    with pytest.raises(BadInput, match="WORK holds none"):
        write_shards([], tmp_path / "none", CONFIG)
    assert not (tmp_path / "none").exists()


def test_two_sequences_of_one_name_are_refused(work: Path, tmp_path: Path) -> None:
    twin = Sequence(Path(shutil.copytree(work / "bell", tmp_path / "bell")))
    with pytest.raises(BadInput, match="same id"):
        write_shards([Sequence(work / "bell"), twin], tmp_path / "out", CONFIG)


def test_a_folder_with_other_files_is_never_replaced(sequences: list[Sequence], tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("ten years of work")
    with pytest.raises(UsageError, match=r"thesis\.tex"):
        write_shards(sequences[:1], tmp_path, CONFIG, overwrite=True)
    with pytest.raises(UsageError, match="is a file"):
        write_shards(sequences[:1], tmp_path / "thesis.tex", CONFIG)
    assert (tmp_path / "thesis.tex").read_text() == "ten years of work"
    for bad in (replace(CONFIG, val_fraction=1.5), replace(CONFIG, samples_per_shard=0)):
        with pytest.raises(UsageError):
            write_shards(sequences[:1], tmp_path / "out", bad)


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_what_breaks_off_leaves_the_old_dataset(
    sequences: list[Sequence], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    out = tmp_path / "out"
    write_shards(sequences[:1], out, CONFIG)
    before = bytes_of(out)
    real, left = shard_writer.HashingFile.write, [100_000]

    def write(self: shard_writer.HashingFile, data: bytes) -> int:
        left[0] -= len(data)
        if left[0] < 0:
            raise error
        return real(self, data)

    monkeypatch.setattr(shard_writer.HashingFile, "write", write)
    with pytest.raises(DiskFull if isinstance(error, OSError) else KeyboardInterrupt):
        write_shards(sequences[:2], out, CONFIG)
    assert bytes_of(out) == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    verify_shards(out)


def test_a_rename_that_fails_brings_the_old_folder_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/old").write_text("old")
    real = Path.replace

    def replace_(self: Path, target: Path) -> Path:
        if target.name == "out" and (self / "new").exists():
            raise OSError(errno.EIO, "broken disk")
        return real(self, target)

    monkeypatch.setattr(Path, "replace", replace_)
    with pytest.raises(OSError, match="broken disk"), files.atomic_folder(tmp_path / "out") as folder:
        (folder / "new").write_text("new")
    assert [str(path.relative_to(tmp_path)) for path in sorted(tmp_path.rglob("*"))] == ["out", "out/old"]


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("train-000001.tar", _cut, "is cut off"),
        ("views-000000.tar", _flip, "is damaged"),
        ("val-000000.tar", Path.unlink, "is missing"),
        ("index.parquet", _flip, "is damaged"),
        ("views.parquet", Path.unlink, "is missing"),
        ("dataset.json", _cut, "is not valid JSON"),
        ("dataset.json", lambda path: path.write_text("[]"), "does not list its shards"),
        ("dataset.json", Path.unlink, "it has no dataset.json"),
    ],
)
def test_damage_is_named(
    dataset: tuple[Path, dict[str, Any]], tmp_path: Path, name: str, damage: Any, message: str
) -> None:
    out = tmp_path / "out"
    shutil.copytree(dataset[0], out)
    assert verify_shards(out)["samples"] == sum(dataset[1]["pairs"].values()) + 100
    damage(out / name)
    with pytest.raises(BadInput, match=message) as raised:
        verify_shards(out)
    assert name in str(raised.value) and raised.value.remedy


def test_counts_that_disagree_are_named(dataset: tuple[Path, dict[str, Any]], tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(dataset[0], out)
    manifest = files.read_json(out / "dataset.json")
    manifest["shards"]["train-000000.tar"]["samples"] += 1
    files.write_json(out / "dataset.json", manifest)
    with pytest.raises(BadInput, match=r"train-000000\.tar.*samples"):
        verify_shards(out)


def test_images_of_the_two_views_show_the_same_texture(dataset: tuple[Path, dict[str, Any]]) -> None:
    """End to end: the colours at corresponding pixels of the written JPEGs agree; at shuffled ones they do not."""
    for sample in stock_samples(dataset[0], "train")[:5]:
        points = sample["corr.npy"] - 0.5
        one, two = (
            cv2.remap(sample[f"{n}.jpg"], *np.split(points[:, 2 * n - 2 : 2 * n], 2, axis=1), cv2.INTER_LINEAR).astype(
                float
            )
            for n in (1, 2)
        )
        matched = np.abs(one - two).mean()
        shuffled = np.abs(one - np.random.default_rng(0).permutation(two)).mean()
        assert matched < 0.6 * shuffled
