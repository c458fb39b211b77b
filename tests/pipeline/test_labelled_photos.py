"""Labelled photos to single views: found by their paths, cut around their objects, packed as every other dataset."""

from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from dope.common.errors import BadInput, UsageError
from dope.lowshot.views import ViewShards
from dope.single_views import ViewDataset
from pipeline.shards.dataset import verify_shards
from pipeline.shards.labelled_photos import PhotosConfig, cut, find_labelled_photos, write_photos

SMALL = PhotosConfig(size=32, samples_per_shard=5)


def write_tree(folder: Path, *, categories: int = 2, objects: int = 3, photos: int = 2, masks: bool = True) -> Path:
    """Grey photos 60 x 40 px with a red box of 20 x 10 px at x = 30, y = 5, and its mask."""
    for c in range(categories):
        for o in range(objects):
            place = folder / f"kind {c}" / f"thing.{c}{o}"
            for name in ("images", "masks"):
                (place / name).mkdir(parents=True)
            for k in range(photos):
                image, mask = np.full((40, 60, 3), 128, np.uint8), np.zeros((40, 60), np.uint8)
                image[5:15, 30:50], mask[5:15, 30:50] = (0, 0, 255), 255
                cv2.imwrite(str(place / "images" / f"{k}.png"), image)
                if masks:
                    cv2.imwrite(str(place / "masks" / f"{k}.png"), mask)
    return folder


def test_views_show_the_object_in_their_middle(tmp_path: Path) -> None:
    (photo, *_) = find_labelled_photos(write_tree(tmp_path))
    view = cut(photo, SMALL)
    mask = cv2.imdecode(np.frombuffer(view.png, np.uint8), cv2.IMREAD_GRAYSCALE) > 127
    rows, columns = np.nonzero(mask)
    # 20 px and a tenth on either side are 24 px of the photo, which the view shows in 32; the photo's top is its end
    assert np.ptp(columns) + 1 == pytest.approx(20 / 24 * 32, abs=1)
    assert np.ptp(rows) + 1 == pytest.approx(10 / 24 * 32, abs=1)
    assert columns.mean() == pytest.approx(15.5, abs=0.6) and rows.min() == pytest.approx(5 / 24 * 32, abs=1)
    image = cv2.imdecode(np.frombuffer(view.jpg, np.uint8), cv2.IMREAD_COLOR)
    assert image[mask].mean(0)[2] > 220 and view.mask_share == mask.mean()


def test_shards_hold_every_photo_with_its_labels(tmp_path: Path) -> None:
    out = tmp_path / "shards"
    details = write_photos(write_tree(tmp_path / "photos"), out, SMALL)
    assert (details["views"], details["objects"], details["categories"], details["without_mask"]) == (12, 6, 2, 0)
    assert verify_shards(out)["samples"] == 12 and len(list(out.glob("views-*.tar"))) == 3
    views = ViewShards(out)
    population = views.population(views.select())
    assert {name: sorted(objects) for name, objects in population.items()} == {
        "kind 0": ["thing.00", "thing.01", "thing.02"], "kind 1": ["thing.10", "thing.11", "thing.12"],
    }  # fmt: skip
    assert views.read(0).image.shape == (32, 32, 3)
    assert ViewDataset(out, "train", image_size=32).batch([0, 11]).labels.tolist() == [0, 1]
    assert len(pq.read_table(out / "index.parquet")) == 0


def test_the_same_photos_are_not_packed_twice_and_give_the_same_bytes(tmp_path: Path) -> None:
    photos = write_tree(tmp_path / "photos")
    write_photos(photos, tmp_path / "a", SMALL)
    before = {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()}
    assert write_photos(photos, tmp_path / "a", SMALL)["skipped"]
    assert not write_photos(photos, tmp_path / "a", SMALL, overwrite=True)["skipped"]
    assert {path.name: path.read_bytes() for path in (tmp_path / "a").iterdir()} == before
    (photos / "kind 0" / "thing.00" / "images" / "1.png").unlink()
    assert write_photos(photos, tmp_path / "a", SMALL)["views"] == 11


def test_photos_without_masks_show_their_middle(tmp_path: Path) -> None:
    details = write_photos(write_tree(tmp_path / "photos", masks=False), tmp_path / "a", SMALL)
    view = ViewShards(tmp_path / "a").read(0)
    assert details["without_mask"] == 12 and view.mask.all()
    assert abs(int(view.image[10, 0, 0]) - 128) < 20 and view.image[8, 28, 0] > 200  # the square from x = 10 to 50


def test_what_cannot_be_used_is_left_out_with_its_reason(tmp_path: Path) -> None:
    photos = write_tree(tmp_path / "photos")
    first, second = (photos / "kind 0" / f"thing.0{k}" for k in (0, 1))
    (first / "images" / "0.png").write_bytes(b"no photo")
    cv2.imwrite(str(second / "masks" / "0.png"), np.zeros((40, 40), np.uint8))
    left_out = write_photos(photos, tmp_path / "a", SMALL)["left_out"]
    assert set(left_out) == {"kind 0/thing.00/images/0.png", "kind 0/thing.01/images/0.png"}
    assert "its mask 0.png is 40x40 px, it is 60x40" in left_out["kind 0/thing.01/images/0.png"]


def test_bad_input_is_named(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no such folder"):
        write_photos(tmp_path / "none", tmp_path / "a", SMALL)
    (tmp_path / "empty" / "kind").mkdir(parents=True)
    with pytest.raises(BadInput, match="holds no labelled photos"):
        write_photos(tmp_path / "empty", tmp_path / "a", SMALL)
    photos = write_tree(tmp_path / "photos", categories=1, objects=1, photos=1)
    (photos / "kind 0" / "thing.00" / "images" / "0.png").write_bytes(b"")
    with pytest.raises(BadInput, match="none of the 1 photos can be used"):
        write_photos(photos, tmp_path / "a", SMALL)
    assert not (tmp_path / "a").exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(UsageError, match=r"letter\.txt"):
        write_photos(photos, tmp_path / "mine", SMALL)
