from __future__ import annotations

import gzip
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools import mask as coco
from tiny_media import pan, write_photos, write_video

from dope.common.errors import BadInput, UsageError
from pipeline.inputs.frames import FramesConfig, extract_frames
from pipeline.inputs.sources import Source, find_sources, source_fingerprint
from pipeline.masks.imported import MasksConfig, import_masks
from pipeline.masks.instances import decode_segmentation
from pipeline.masks.places import find_masks
from pipeline.masks.results_file import read_results
from pipeline.sequence import Sequence

N, HEIGHT, WIDTH = 6, 128, 192

pytestmark = pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")  # of pycocotools under NumPy 2


def blob(x: int, size: int = 40) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[30 : 30 + size, x : x + size] = True
    return mask


def rle(mask: np.ndarray) -> dict[str, Any]:
    encoding = coco.encode(np.asfortranarray(mask.astype(np.uint8)))
    return {"size": list(mask.shape), "counts": encoding["counts"].decode()}


def runs(mask: np.ndarray) -> dict[str, Any]:
    flat = mask.ravel(order="F").astype(np.int8)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flat, [0]])))
    ends = np.concatenate([[0], edges, [flat.size]]) if not flat[-1] else np.concatenate([[0], edges])
    return {"size": list(mask.shape), "counts": np.diff(ends).tolist()}


def instance(image: int | str, mask: np.ndarray, score: float = 0.9, **more: Any) -> dict[str, Any]:
    return {"image_id": image, "category_id": 1, "segmentation": rle(mask), "score": score, **more}


def write(path: Path, value: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))
    return path


def photos(tmp_path: Path, name: str = "{}.jpg", at: str = "a", **settings: Any) -> Sequence:
    folder = write_photos(tmp_path / at, pan(N, WIDTH, HEIGHT), name)
    sequence = Sequence(tmp_path / "out" / at)
    extract_frames(Source(folder, at, "photos"), sequence, FramesConfig(**settings))
    return sequence


def mask_of(sequence: Sequence, frame: int) -> np.ndarray:
    mask = sequence.read_mask(sequence.read_frames()[frame])
    assert mask is not None
    return mask


def dataset(names: list[str], first: int = 0) -> dict[str, Any]:
    """What FreeSOLO's inference of free masks writes."""
    images = [{"file_name": name, "height": HEIGHT, "width": WIDTH, "id": first + i} for i, name in enumerate(names)]
    annotations = [instance(first + i, blob(4 * i), emb=[0.1] * 128, iscrowd=0, id=i) for i in range(len(names))]
    return {"categories": [{"id": 1, "name": "thing"}], "images": images, "annotations": annotations}


def forms() -> dict[str, Any]:
    masks = [blob(4 * i) for i in range(N)]
    corners = [[x, 30, x + 40, 30, x + 40, 70, x, 70] for x in range(0, 4 * N, 4)]
    return {
        "results by id": [instance(i, mask) for i, mask in enumerate(masks)],
        "ids as text": [instance(str(i), mask) for i, mask in enumerate(masks)],
        "results by name": [instance(f"some/where/{i}.png", mask) for i, mask in enumerate(masks)],
        "name beside": [{k: v for k, v in instance(0, m, file_name=f"{i}.jpg").items() if k != "image_id"}
                        for i, m in enumerate(masks)],
        "lists of runs": [{**instance(i, mask), "segmentation": runs(mask)} for i, mask in enumerate(masks)],
        "polygons": [{**instance(i, masks[0]), "segmentation": [c]} for i, c in enumerate(corners)],
        "dataset": dataset([f"{i}.jpg" for i in range(N)], first=77),
        "annotations first": dict(reversed(dataset([f"{i}.jpg" for i in range(N)], first=77).items())),
        "predictions by image": [{"image_id": i, "instances": [instance(i, mask)]} for i, mask in enumerate(masks)],
    }  # fmt: skip


@pytest.mark.parametrize("form", forms())
@pytest.mark.parametrize("indent", [None, 2])
def test_all_forms_of_results_give_the_same_masks(tmp_path: Path, form: str, indent: int | None) -> None:
    sequence = photos(tmp_path)
    path = tmp_path / "results.json"
    path.write_text(json.dumps(forms()[form], indent=indent))
    details = import_masks(sequence, path, MasksConfig())
    assert (details["masks"], details["missing"], details["pick"], details["instances"]) == (N, 0, "centre", N)
    for i in range(N):
        np.testing.assert_array_equal(mask_of(sequence, i), blob(4 * i))


def test_frames_without_an_instance_are_missing(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    path = write(tmp_path / "r.json", [instance(i, blob(9), 0.3 + i / 10) for i in range(4)])
    details = import_masks(sequence, path, MasksConfig(min_score=0.45))
    assert details["masks"] == 2 and details["missing_frames"] == ["0.jpg", "1.jpg", "4.jpg", "5.jpg"]
    with pytest.raises(BadInput, match="no instance of these frames passes the filters"):
        import_masks(sequence, path, MasksConfig(min_score=0.95))
    assert mask_of(sequence, 2).any(), "what was there before stays"


def test_rules_pick_what_they_say(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    best, large, middle = blob(2, 20), blob(100, 80), blob(80, 32)
    value = [instance(i, m, s) for i in range(N) for m, s in ((large, 0.7), (middle, 0.8), (best, 0.9))]
    path = write(tmp_path / "r.json", value)
    for rule, expected in (("score", best), ("area", large), ("centre", middle), ("consistent", middle)):
        import_masks(sequence, path, MasksConfig(pick=rule))  # type: ignore[arg-type]
        np.testing.assert_array_equal(mask_of(sequence, 3), expected, err_msg=rule)


def test_categories_are_chosen_by_id_and_name(tmp_path: Path) -> None:
    sequence = photos(tmp_path)
    value = dataset([f"{i}.jpg" for i in range(N)])
    value["categories"].append({"id": 47, "name": "Apple"})
    value["annotations"] += [instance(i, blob(60), 0.2) | {"category_id": 47} for i in range(N)]
    path = write(tmp_path / "r.json", value)
    for config in (MasksConfig(category_ids=(47,)), MasksConfig(category_names=("apple",))):
        import_masks(sequence, path, config)
        np.testing.assert_array_equal(mask_of(sequence, 0), blob(60))
    with pytest.raises(BadInput, match=r"knows no category 'pear'.*Apple, thing"):
        import_masks(sequence, path, MasksConfig(category_names=("pear",)))


def test_a_table_of_images_names_the_ids(tmp_path: Path) -> None:
    sequence = photos(tmp_path, "shot {} ä\n<b>.jpg")
    path = write(tmp_path / "r.json", [instance(100 + i, blob(4 * i)) for i in range(N)])
    with pytest.raises(BadInput, match="--coco-images"):
        import_masks(sequence, path, MasksConfig())
    names = [f"train/shot {i} ä\n<b>.jpg" for i in range(N)]
    tables = [dataset(names, 100), {str(100 + i): name for i, name in enumerate(names)}]
    for number, table in enumerate(tables):
        place = write(tmp_path / f"t{number}.json", table)
        place.write_text(json.dumps(table, ensure_ascii=number == 0))  # escaped, and as UTF-8
        import_masks(sequence, path, MasksConfig(coco_images=str(place)))
        np.testing.assert_array_equal(mask_of(sequence, 5), blob(20))


def test_ids_that_are_numbers_of_something_else_are_not_guessed(tmp_path: Path) -> None:
    sequence = photos(tmp_path, "IMG_{}.jpg")
    path = write(tmp_path / "r.json", [instance(i, blob(0)) for i in (0, 1, 2, 3, 777)])
    with pytest.raises(BadInput, match=r"image id 777 is the number of no photo.*--coco-images"):
        import_masks(sequence, path, MasksConfig())
    folder = write_photos(tmp_path / "b", pan(4, WIDTH, HEIGHT), "a_{}.jpg")
    write_photos(folder, pan(4, WIDTH, HEIGHT, seed=3), "b_{}.jpg")
    twins = Sequence(tmp_path / "out/b")
    extract_frames(Source(folder, "b", "photos"), twins, FramesConfig())
    path = write(tmp_path / "s.json", [instance(i, blob(0)) for i in range(4)])
    with pytest.raises(BadInput, match=r"image id 0 could be 'a_0.jpg' and 'b_0.jpg'"):
        import_masks(twins, path, MasksConfig(names="source"))


def test_names_of_stored_images_and_of_photos_are_told_apart(tmp_path: Path) -> None:
    folder = write_photos(tmp_path / "a", pan(N + 1, WIDTH, HEIGHT), "{:06d}.jpg")
    (folder / "000000.jpg").unlink()  # photos are called 1 to 6, stored images 0 to 5
    sequence = Sequence(tmp_path / "out/a")
    extract_frames(Source(folder, "a", "photos"), sequence, FramesConfig())
    for first in (0, 1):
        value = [instance(f"{i:06d}.jpg", blob(4 * (i - first))) for i in range(first, first + N)]
        import_masks(sequence, write(tmp_path / "r.json", value), MasksConfig())
        np.testing.assert_array_equal(mask_of(sequence, 3), blob(12))
    unclear = write(tmp_path / "r.json", [instance(f"{i:06d}.jpg", blob(4 * i)) for i in range(1, N)])
    with pytest.raises(BadInput, match=r"000001.jpg or a source image of that name.*names=stored"):
        import_masks(sequence, unclear, MasksConfig())
    import_masks(sequence, unclear, MasksConfig(names="source"))
    np.testing.assert_array_equal(mask_of(sequence, 0), blob(4))
    import_masks(sequence, unclear, MasksConfig(names="stored"))
    np.testing.assert_array_equal(mask_of(sequence, 1), blob(4))


def test_frames_of_a_video_go_by_number(tmp_path: Path) -> None:
    video = write_video(tmp_path / "a.mp4", pan(20, WIDTH, HEIGHT))
    sequence = Sequence(tmp_path / "out/a")
    path = write(tmp_path / "r.json", [instance(i, blob(4 * i)) for i in range(20)])
    source = Source(video, "a", "video", masks=path)
    details = extract_frames(source, sequence, FramesConfig(every=3))
    assert details["masks"]["masks"] == details["kept"] == 7
    for frame in sequence.read_frames():
        np.testing.assert_array_equal(sequence.read_mask(frame), blob(4 * int(frame.source_name)))
    stored = write(tmp_path / "s.json", [instance(f"{i:06d}.jpg", blob(50)) for i in range(7)])
    assert import_masks(sequence, stored, MasksConfig())["masks"] == 7, "all of them are names in images/"


def test_one_file_for_several_sequences_goes_by_folders(tmp_path: Path) -> None:
    one, two = photos(tmp_path, at="one"), photos(tmp_path, at="two")
    value = [instance(f"x/{name}/images/{i}.jpg", blob(at)) for name, at in (("one", 3), ("two", 90)) for i in range(N)]
    path, shared = write(tmp_path / "r.json", value), MasksConfig(shared=True)
    for sequence, at in ((one, 3), (two, 90)):
        import_masks(sequence, path, shared)
        np.testing.assert_array_equal(mask_of(sequence, 0), blob(at))
    bare = write(tmp_path / "bare.json", [instance(f"{i}.jpg", blob(3)) for i in range(N)])
    with pytest.raises(BadInput, match=r"Names need the folder one/, or give a folder with one\.json"):
        import_masks(one, bare, shared)
    with pytest.raises(BadInput, match=r"two images could be '0\.jpg'"):
        import_masks(one, write(tmp_path / "r2.json", [*value[N:], instance("y/0.jpg", blob(3))]), MasksConfig())
    with pytest.raises(BadInput, match="without names"):
        import_masks(one, write(tmp_path / "r3.json", [instance(0, blob(3))]), shared)


def damaged_counts() -> dict[str, Any]:
    good = rle(blob(9))
    return {
        "its runs cover": {**good, "counts": good["counts"][:-4]},
        "its runs cover 5 ": {**good, "counts": "5"},
        "cut off": {**good, "counts": good["counts"][:-2] + "o"},
        "characters that no encoding has": {**good, "counts": "ä" + good["counts"]},
        "its counts are cut off": {**good, "counts": ""},
        "too large": {**good, "counts": "oooooooo0"},
        "neither a packed text": {**good, "counts": [1.5, 2]},
        "neither a packed text nor": {**good, "counts": [-3, 3]},
        "its runs cover 10 ": {**good, "counts": [10]},
        "its runs cover 4000000000 ": {**good, "counts": [2_000_000_000] * 2},
        "its runs cover 21475265976729600000 ": {**good, "counts": "0" + "PPPPPP8" * 100_000},  # beyond 64 bits
        "has no size": {"counts": good["counts"]},
        "has no size [height, width] ('x')": {"size": "x", "counts": good["counts"]},
        "the mask is 192x100, its image is 192x128": rle(blob(9)[:100]),
        "the mask is 60000x60000": {"size": [60000, 60000], "counts": good["counts"]},
        "a polygon that is no list": [[1, 2, 3]],
        "has no polygons": [],
        "far outside": [[0, 0, 1e9, 0, 1e9, 1e9]],
        "has no size [height, width] (None)": None,
    }


@pytest.mark.parametrize("what", damaged_counts())
def test_malformed_segmentations_are_errors_that_name_the_annotation(tmp_path: Path, what: str) -> None:
    sequence = photos(tmp_path)
    value = [instance(i, blob(9)) for i in range(N)]
    value[4]["segmentation"] = damaged_counts()[what]
    with pytest.raises(BadInput) as caught:
        import_masks(sequence, write(tmp_path / "r.json", value), MasksConfig())
    assert what in str(caught.value) and "annotation 4 (image '4.jpg')" in str(caught.value)
    assert not sequence.masks.exists()


def test_runs_are_unpacked_as_pycocotools_packs_them() -> None:
    rng = np.random.default_rng(0)
    for _ in range(200):
        shape = tuple(rng.integers(1, 90, 2))
        mask = rng.random(shape) < rng.choice([0, 0.01, 0.5, 0.99, 1])
        for segmentation in (rle(mask), runs(mask)):
            np.testing.assert_array_equal(decode_segmentation(segmentation, (0, 0)), mask)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("", "is neither a list nor an object"),
        ("hello", "is neither a list nor an object"),
        ("[]", "holds no instances"),
        ('{"images": []}', "holds no instances"),
        ('{"images": [{"id": 1, "file_name": "a.jpg"}]}', "holds images, but no instances"),
        ("[1, 2]", "element 0 is no object"),
        ('[{"image_id": 1, "bbox": [1, 2, 3, 4], "score": 1}]', "element 0 has no segmentation"),
        ('[{"segmentation": []}]', "element 0 has no image_id"),
        ('[{"image_id": 1, "segmentation": [], "score": NaN}]', "a score that is no number"),
        (f'[{{"image_id": 1, "segmentation": [], "score": 1{"0" * 400}}}]', "a score that is no number"),
        ('[{"image_id": 1, "segmentation": []} {}]', "is not valid JSON"),
        ('[{"image_id": 1, "segmentation": [], "score": 0.5}]]', "something follows"),
        ("[" * 100_000, "is not valid JSON"),
        ("\x00\x01\x02", "is neither a list nor an object"),
        ('{"a" 1}', "is not valid JSON"),
    ],
)
def test_files_that_are_something_else_say_what(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "r.json"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        read_results(path)
    assert what in str(caught.value) and str(path) in str(caught.value)


def test_results_that_are_cut_off_anywhere_are_refused(tmp_path: Path) -> None:
    text = json.dumps(dataset(["0.jpg", "1.jpg"]))
    path = tmp_path / "r.json"
    for length in range(0, len(text) - 1, 37):
        path.write_text(text[:length])
        with pytest.raises(BadInput, match=r"is cut off|neither a list"):
            read_results(path)


def test_names_of_any_script_are_exact_at_any_depth_and_segmentations_found_behind_them(tmp_path: Path) -> None:
    value = [{"image_id": i, "instances": [instance(f"größe/{i}€𝄞.jpg", blob(i + 1))] * 2} for i in range(3)]
    path = tmp_path / "r.json"
    for mark in ("", "\ufeff"):
        path.write_text(mark + json.dumps(value, ensure_ascii=False), encoding="utf-8")
        results = read_results(path)
        assert len(results) == 6
        names = {name for known in (*results.names.values(), results.images) for name in known if isinstance(name, str)}
        assert names == {f"größe/{i}€𝄞.jpg" for i in range(3)}
        with path.open("rb") as file:
            for i in range(6):
                assert results.segmentation(file, i) == rle(blob(i // 2 + 1))
    path.write_bytes(gzip.compress(path.read_bytes()))
    with pytest.raises(BadInput, match=r"is gzipped.*gunzip"):
        read_results(path)
    path.write_text(json.dumps(value, ensure_ascii=False).replace("€𝄞", ""), encoding="latin-1")
    with pytest.raises(BadInput, match=r"is not UTF-8.*row 1, byte \d+"):
        read_results(path)


def test_places_of_masks_are_found_or_explained(tmp_path: Path) -> None:
    ids = ["one", "two"]
    both = write(tmp_path / "results.json", [])
    assert find_masks(str(both), ids) == {"one": both, "two": both}
    each = [write(tmp_path / f"each/{name}.json", []) for name in ids]
    assert find_masks(str(tmp_path / "each"), ids) == dict(zip(ids, each, strict=True))
    assert find_masks(str(tmp_path / "each/{}.json"), ids) == dict(zip(ids, each, strict=True))
    inference = write(tmp_path / "inference/coco_instances_results.json", [])
    assert find_masks(str(inference.parent), ids[:1]) == {"one": inference}
    write(tmp_path / "inference/other.json", [])
    with pytest.raises(UsageError, match=r"several files of results: coco_instances_results.json, other.json"):
        find_masks(str(inference.parent), ids)
    (tmp_path / "each/one").mkdir()
    with pytest.raises(UsageError, match="two kinds of masks for 'one'"):
        find_masks(str(tmp_path / "each"), ids)
    with pytest.raises(UsageError, match="holds no masks for any sequence"):
        find_masks(str(tmp_path / "nowhere"), ids)


def test_results_may_come_with_the_input(tmp_path: Path) -> None:
    for name in ("one", "two"):
        write_photos(tmp_path / "in" / name, pan(N, WIDTH, HEIGHT), "{}.jpg")
    value = [instance(f"{name}/{i}.jpg", blob(9)) for name in ("one", "two") for i in range(N)]
    path = write(tmp_path / "r.json", value)
    sources, errors = find_sources([tmp_path / "in"], masks=str(path))
    assert not errors and [(s.masks, s.masks_shared) for s in sources] == [(path, True)] * 2
    before = source_fingerprint(sources[0])
    details = extract_frames(sources[1], Sequence(tmp_path / "out/two"), FramesConfig())
    assert details["masks"]["masks"] == N
    write(path, value[1:])
    assert source_fingerprint(sources[0])["masks"] != before["masks"]
    (tmp_path / "each").mkdir()
    path.rename(tmp_path / "each/one.json")
    sources, errors = find_sources([tmp_path / "in"], masks=str(tmp_path / "each"))
    assert [(s.id, s.masks_shared) for s in sources] == [("one", False)] and [e[0] for e in errors] == ["two"]


def test_memory_does_not_grow_with_the_file(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    line = json.dumps(instance(0, blob(9), emb=[0.123456789] * 128))
    count = 40_000
    with path.open("w") as file:
        file.write("[" + ",\n".join([line] * count) + "]")
    code = (
        "import resource, sys; from pathlib import Path; from pipeline.masks.results_file import read_results\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "n = len(read_results(Path(sys.argv[1])))\n"
        "print(n, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)"
    )
    out = subprocess.run([sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True).stdout
    n, grown = map(int, out.split())
    scale = 1024 if sys.platform != "darwin" else 1
    assert n == count and grown * scale < 45e6 < path.stat().st_size
