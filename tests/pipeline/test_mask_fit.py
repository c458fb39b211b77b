"""Masks lie where the object lies, whichever images they were drawn on and however those lay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_media import encode, pan, with_orientation, write_photos

from dope.common.errors import BadInput
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.photos import turn_upright
from pipeline.inputs.sources import Source
from pipeline.masks.imported import MasksConfig, import_masks
from pipeline.sequence import Sequence

N, HEIGHT, WIDTH = 6, 128, 192

pytestmark = pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")  # of pycocotools under NumPy 2


def corner(width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """An object that lies elsewhere in every orientation of its image."""
    mask = np.zeros((height, width), bool)
    mask[8:40, 16:64] = True
    return mask


POLYGON = [[16, 8, 64, 8, 64, 40, 16, 40]]


def photos(
    tmp_path: Path, orientation: int = 1, width: int = WIDTH, name: str = "p{}.jpg", **settings: Any
) -> Sequence:
    folder = write_photos(tmp_path / "a", pan(N, width, HEIGHT), name)
    for path in folder.iterdir():
        path.write_bytes(with_orientation(path.read_bytes(), orientation))
    sequence = Sequence(tmp_path / "out/a")
    extract_frames(Source(folder, "a", "photos"), sequence, FramesConfig(**settings))
    return sequence


def files(folder: Path, mask: np.ndarray) -> Path:
    folder.mkdir()
    for i in range(N):
        (folder / f"p{i}.png").write_bytes(encode(mask.astype(np.uint8) * 255, ".png"))
    return folder


def polygons(path: Path, names: str, size: tuple[int, int] | None = None) -> Path:
    """A COCO dataset of one polygon an image; its table gives (width, height) where `size` does."""
    given = {} if size is None else {"width": size[0], "height": size[1]}
    images = [{"id": 50 + i, "file_name": names.format(i), **given} for i in range(N)]
    annotations = [{"image_id": 50 + i, "category_id": 1, "segmentation": POLYGON} for i in range(N)]
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    return path


def mask_of(sequence: Sequence, frame: int = 3) -> np.ndarray:
    mask = sequence.read_mask(sequence.read_frames()[frame])
    assert mask is not None
    return mask


def test_polygons_of_stored_images_keep_their_place_where_those_were_shrunk(tmp_path: Path) -> None:
    sequence = photos(tmp_path, long_side=96)
    for size in ((96, 64), None):  # without a size the names tell
        details = import_masks(sequence, polygons(tmp_path / "r.json", "{:06d}.jpg", size), MasksConfig())
        np.testing.assert_array_equal(mask_of(sequence), corner(96, 64))
        assert "warnings" not in details
    import_masks(sequence, polygons(tmp_path / "r.json", "p{}.jpg"), MasksConfig())
    np.testing.assert_array_equal(mask_of(sequence), corner()[::2, ::2])


def test_the_table_of_images_says_what_polygons_were_drawn_on(tmp_path: Path) -> None:
    sequence = photos(tmp_path, long_side=96)
    import_masks(sequence, polygons(tmp_path / "r.json", "p{}.jpg", (96, 64)), MasksConfig())
    np.testing.assert_array_equal(mask_of(sequence), corner(96, 64))
    bare = [{"image_id": 50 + i, "category_id": 1, "segmentation": POLYGON} for i in range(N)]
    (tmp_path / "bare.json").write_text(json.dumps(bare))
    table = MasksConfig(coco_images=str(polygons(tmp_path / "table.json", "p{}.jpg", (WIDTH, HEIGHT))))
    import_masks(sequence, tmp_path / "bare.json", table)
    np.testing.assert_array_equal(mask_of(sequence), corner()[::2, ::2])
    with pytest.raises(BadInput, match=r"annotation 0 .* the mask is 100x100, its image is 192x128"):
        import_masks(sequence, polygons(tmp_path / "r.json", "p{}.jpg", (100, 100)), MasksConfig())
    twice = json.loads((tmp_path / "table.json").read_text())
    twice["images"] += [{**image, "width": 96, "height": 64} for image in twice["images"]]
    (tmp_path / "r.json").write_text(json.dumps(twice))
    with pytest.raises(BadInput, match="several sizes"):
        import_masks(sequence, tmp_path / "r.json", MasksConfig())


def test_polygons_whose_image_cannot_be_told_are_a_warning(tmp_path: Path) -> None:
    sequence = photos(tmp_path, name="{:06d}.jpg", long_side=96)
    path = polygons(tmp_path / "r.json", "{:06d}.jpg")
    (warning,) = import_masks(sequence, path, MasksConfig())["warnings"]
    assert "(192x128)" in warning and "(96x64)" in warning and "names=stored" in warning
    for names, expected in (("source", corner()[::2, ::2]), ("stored", corner(96, 64))):
        details = import_masks(sequence, path, MasksConfig(names=names))  # type: ignore[arg-type]
        np.testing.assert_array_equal(mask_of(sequence), expected)
        assert "warnings" not in details


def test_polygons_of_photos_as_they_lie_in_their_files_are_turned(tmp_path: Path) -> None:
    sequence = photos(tmp_path, orientation=6)
    lying = polygons(tmp_path / "r.json", "p{}.jpg", (WIDTH, HEIGHT))  # the photo is 128x192 once it is upright
    import_masks(sequence, lying, MasksConfig())
    np.testing.assert_array_equal(mask_of(sequence), turn_upright(corner(), 6))
    bare = polygons(tmp_path / "r.json", "p{}.jpg")
    for setting, expected in (("yes", turn_upright(corner(), 6)), ("no", corner(HEIGHT, WIDTH))):
        import_masks(sequence, bare, MasksConfig(lying=setting))  # type: ignore[arg-type]
        np.testing.assert_array_equal(mask_of(sequence), expected)


@pytest.mark.parametrize(("orientation", "width"), [(2, WIDTH), (3, WIDTH), (4, WIDTH), (6, HEIGHT), (8, HEIGHT)])
def test_masks_whose_size_does_not_tell_how_they_lie_go_by_the_setting(
    tmp_path: Path, orientation: int, width: int
) -> None:
    sequence, mask = photos(tmp_path, orientation, width), corner(width)
    folder = files(tmp_path / "m", mask)
    (warning,) = import_masks(sequence, folder, MasksConfig())["warnings"]
    assert warning.startswith("6 masks were taken to be upright") and "lying=yes" in warning and "p0.jpg" in warning
    for setting, expected in (("no", mask), ("yes", turn_upright(mask, orientation))):
        details = import_masks(sequence, folder, MasksConfig(lying=setting))  # type: ignore[arg-type]
        np.testing.assert_array_equal(mask_of(sequence), expected)
        assert "warnings" not in details


def test_what_masks_leave_open_is_a_warning_of_the_stage_that_read_them(tmp_path: Path) -> None:
    sequence = photos(tmp_path, orientation=3)
    source = Source(tmp_path / "a", "a", "photos", masks=files(tmp_path / "m", corner()))
    details = extract_frames(source, sequence, FramesConfig())
    assert "lying=yes" in details["warnings"][0] and "warnings" not in details["masks"]


def test_a_lying_mask_is_refused_where_none_is_said_to_lie(tmp_path: Path) -> None:
    sequence, folder = photos(tmp_path, orientation=6), files(tmp_path / "m", corner())
    assert "warnings" not in import_masks(sequence, folder, MasksConfig())
    np.testing.assert_array_equal(mask_of(sequence), turn_upright(corner(), 6))
    with pytest.raises(BadInput, match=r"p0\.png: the mask is 192x128, its image 'p0\.jpg' is 128x192"):
        import_masks(sequence, folder, MasksConfig(lying="no"))
