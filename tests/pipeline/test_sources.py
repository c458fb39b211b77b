from __future__ import annotations

import os
from pathlib import Path

import pytest
from tiny_media import encode, pan, texture, write_photos

from pipeline.inputs.photos import list_photos
from pipeline.inputs.sources import find_sources, input_errors_as_rows, known_sources, source_fingerprint
from pipeline.sequence import Sequence, SequenceInfo

PHOTO = encode(texture(16, 16))


def touch(path: Path, data: bytes = b"x") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def photo_folder(folder: Path, n: int = 2) -> Path:
    for i in range(n):
        touch(folder / f"{i}.JPG", PHOTO)
    return folder


def ids(*inputs: Path, **options: object) -> list[str]:
    sources, errors = find_sources(list(inputs), **options)  # type: ignore[arg-type]
    assert not errors, errors
    return [source.id for source in sources]


def test_videos_of_any_case_and_photo_folders_become_sequences(tmp_path: Path) -> None:
    video, photos = touch(tmp_path / "My car (1).MOV"), photo_folder(tmp_path / "fox")
    sources, errors = find_sources([video, photos])
    assert not errors
    assert [(s.id, s.kind, s.path) for s in sources] == [("My_car_1", "video", video), ("fox", "photos", photos)]


def test_a_capture_takes_its_images_and_the_outer_name(tmp_path: Path) -> None:
    photo_folder(tmp_path / "fox/images")
    photo_folder(tmp_path / "fox/masks")
    touch(tmp_path / "fox/cameras.json")
    sources, _ = find_sources([tmp_path / "fox"], category_from="parent")
    assert [(s.id, s.path, s.category) for s in sources] == [("fox", tmp_path / "fox/images", tmp_path.name)]
    assert ids(tmp_path / "fox/images") == ["fox"], "naming the inner folder is the same capture"


def test_folders_expand_to_all_below_in_natural_order(tmp_path: Path) -> None:
    for name in ("a/10.mp4", "a/9.mp4", "b/x/images/1.jpg", "b/y/1.png", "b/notes/readme.txt", ".hidden/z.mp4"):
        touch(tmp_path / name, PHOTO)
    touch(tmp_path / "a/._9.mp4")
    photo_folder(tmp_path / "a/masks")
    assert ids(tmp_path) == ["9", "10", "x", "y"]
    sources, _ = find_sources([tmp_path], category_from="parent")
    assert [s.category for s in sources] == ["a", "a", "b", "b"]
    assert {s.category for s in find_sources([tmp_path], category="mug", category_from="parent")[0]} == {"mug"}


def test_equal_names_get_their_parents_name_and_stay_unique(tmp_path: Path) -> None:
    for name in ("car/1.mp4", "cup/1.mp4", "cup/2.mp4", "dog/3.mp4", "dog/3.mov", "Cat/4.mp4", "x/CAT/4.mp4"):
        touch(tmp_path / name)
    found = ids(tmp_path)
    assert {"car_1", "cup_1", "2"} <= set(found)
    assert len({name.casefold() for name in found}) == 7, "unique where file systems ignore case, too"
    assert ids(tmp_path) == found
    assert ids(tmp_path / "cup/2.mp4", tmp_path / "cup/../cup/2.mp4") == ["2"], "the same video twice is one sequence"


def test_bad_inputs_are_rows_and_the_others_go_on(tmp_path: Path) -> None:
    good = touch(tmp_path / "good.mp4")
    (tmp_path / "empty").mkdir()
    touch(tmp_path / "text/readme.txt")
    touch(tmp_path / "phone/a.HEIC")
    inputs = [tmp_path / "absent.mp4", tmp_path / "empty", tmp_path / "text", tmp_path / "phone", good]
    sources, errors = find_sources([*inputs, touch(tmp_path / "notes.txt")])
    assert [s.id for s in sources] == ["good"]
    assert [path for _, path, _ in errors] == [*inputs[:4], tmp_path / "notes.txt"]
    rows = input_errors_as_rows(errors)
    assert [(row.sequence, row.status) for row in rows][1:3] == [("empty", "failed"), ("text", "failed")]
    texts = [str(row.reason) for row in rows]
    wanted = ["no such file", "empty folder", "holds neither", "Convert .heic", "neither a video nor"]
    for text, part in zip(texts, wanted, strict=True):
        assert part in text and str(tmp_path) in text


def test_a_work_folder_among_the_inputs_is_none_of_them(tmp_path: Path) -> None:
    touch(tmp_path / "phone.mp4")
    prepared = photo_folder(tmp_path / "work/phone/images").parent
    (prepared / "sequence.json").write_text("{}")
    assert ids(tmp_path) == ["phone"]
    sources, ((name, _, error),) = find_sources([prepared])
    assert not sources and name == "phone" and "is a prepared sequence" in str(error)


def test_a_folder_that_may_not_be_read_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good, closed = touch(tmp_path / "good.mp4"), photo_folder(tmp_path / "in/images")

    def forbidden(folder: Path) -> list[Path]:
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("pipeline.inputs.sources.list_photos", forbidden)
    sources, ((name, path, error),) = find_sources([tmp_path / "in", good])
    assert [s.id for s in sources] == ["good"] and (name, path) == ("in", tmp_path / "in")
    assert str(closed) in str(error) and "Permission denied" in str(error)


def test_a_link_to_a_folder_above_ends(tmp_path: Path) -> None:
    touch(tmp_path / "a/1.mp4")
    (tmp_path / "a/loop").symlink_to(tmp_path)
    assert ids(tmp_path) == ["1"]


def test_a_photo_beside_captures_does_not_hide_them(tmp_path: Path) -> None:
    captures = tmp_path / "captures"
    for name in ("a", "b/images"):
        photo_folder(captures / name)
    touch(captures / "cover.jpg", PHOTO)
    for name in ("masks", "depths"):
        photo_folder(captures / name)
    assert ids(captures) == ["captures", "a", "b"]


def test_given_masks_and_depths_beside_the_photos_are_no_captures(tmp_path: Path) -> None:
    fox = photo_folder(tmp_path / "in/fox")
    soft, z = photo_folder(fox / "soft_masks"), photo_folder(fox / "z")
    for place in (fox, fox.parent):
        for masks, depths in ((str(soft), str(z)), ("{}/soft_masks", "{}/z")):
            (source,), errors = find_sources([place], masks=masks, depths=depths)
            assert not errors and (source.id, source.masks, source.depths) == ("fox", soft, z)
    (source,), _ = find_sources([fox], depths=str(z), masks_later=str(soft))
    assert source.id == "fox"
    photo_folder(tmp_path / "data/captures/cat")
    (source,), _ = find_sources([tmp_path / "data"], masks=str(tmp_path / "data/captures"))
    assert source.id == "cat", "a folder with masks for each sequence may hold the sequences, too"
    clip = touch(tmp_path / "films/clip.mp4")
    photo_folder(tmp_path / "films/clip_masks")
    (source,), errors = find_sources([clip.parent], masks="{}_masks")
    assert not errors and source.path == clip


def test_a_folder_that_cannot_be_used_does_not_hide_its_neighbours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("in/a", "in/closed", "in/co3d", "in/z"):
        photo_folder(tmp_path / name)
    touch(tmp_path / "in/co3d/frame_annotations.jgz")
    touch(tmp_path / "in/phone/1.heic")

    def listed(folder: Path) -> list[Path]:
        if folder.name == "closed":
            raise PermissionError(13, "Permission denied", str(folder))
        return list_photos(folder)

    monkeypatch.setattr("pipeline.inputs.sources.list_photos", listed)
    sources, errors = find_sources([tmp_path / "in"])
    assert [source.id for source in sources] == ["a", "z"]
    assert [(name, path) for name, path, _ in errors] == [(n, tmp_path / "in" / n) for n in ("closed", "co3d", "phone")]
    for (_, _, error), part in zip(errors, ("Permission denied", "dope prep co3d", "Convert .heic"), strict=True):
        assert part in str(error)


def test_masks_are_found_for_one_and_for_many(tmp_path: Path) -> None:
    for name in ("fox", "cat"):
        photo_folder(tmp_path / name / "images")
    photo_folder(tmp_path / "fox/masks")
    photo_folder(tmp_path / "all/fox")
    one, _ = find_sources([tmp_path / "fox"], masks=str(tmp_path / "fox/masks"))
    assert one[0].masks == tmp_path / "fox/masks"
    for template in (str(tmp_path / "all"), "{}/masks"):
        sources, errors = find_sources([tmp_path / "fox", tmp_path / "cat"], masks=template)
        assert [s.id for s in sources] == ["fox"] and sources[0].masks is not None
        assert [(name, "no such file or folder of masks" in str(e)) for name, _, e in errors] == [("cat", True)]
    touch(tmp_path / "clip.mp4")
    photo_folder(tmp_path / "clip_masks")
    assert find_sources([tmp_path / "clip.mp4"], masks="{}_masks")[0][0].masks == tmp_path / "clip_masks"


def test_the_fingerprint_follows_content_not_place_or_time(tmp_path: Path) -> None:
    prints = []
    for place in ("p", "q"):
        folder = write_photos(tmp_path / place / "fox", pan(3))
        masks = photo_folder(tmp_path / place / "masks")
        os.utime(folder / "IMG_0001.jpg", (1, 1))
        sources, _ = find_sources([folder], masks=str(masks))
        prints.append(source_fingerprint(sources[0]))
    assert prints[0] == prints[1]
    touch(tmp_path / "q/masks/0.JPG", PHOTO + b"!")
    assert source_fingerprint(sources[0]) != prints[0], "masks count"
    touch(tmp_path / "q/masks/0.JPG", PHOTO)
    (folder / "IMG_0001.jpg").rename(folder / "IMG_0009.jpg")
    assert source_fingerprint(sources[0]) != prints[0], "names count"


@pytest.mark.captures
def test_the_captures_are_found() -> None:
    captures = Path(__file__).parents[2].parent / "shared/data/captures"
    if not captures.is_dir() or os.environ.get("CI") == "true":
        pytest.skip("the real captures are not here")
    sources, errors = find_sources([captures])
    assert {s.id for s in sources} >= {"fox", "plush_doll", "skull"} and not errors


def test_a_sequence_keeps_its_name_when_inputs_of_the_same_name_join_it(tmp_path: Path) -> None:
    first, second = touch(tmp_path / "a/mug.mp4"), touch(tmp_path / "b/mug.mp4")
    work = tmp_path / "work"
    Sequence(work / "mug").write_info(SequenceInfo("mug", str(first), "video"))
    assert known_sources(tmp_path / "nowhere") == {}
    known = known_sources(work)
    sources, _ = find_sources([second, first], known=known)
    assert [(source.path, source.id) for source in sources] == [(second, "b_mug"), (first, "mug")]
    assert [source.id for source in find_sources([second], known=known)[0]] == ["b_mug"]
    first.unlink()  # moved away: under its name it is still the same sequence
    assert [source.id for source in find_sources([second], known=known_sources(work))[0]] == ["mug"]


def test_a_run_that_goes_on_gives_the_ids_that_it_gave(tmp_path: Path) -> None:
    """Whatever part of the run WORK holds by then, also beside an older sequence of the same name."""
    films = [touch(tmp_path / name) for name in ("chair/001.mp4", "mug/001.mp4", "mug/002.mp4", "pot/chair_001.mp4")]
    older, work = touch(tmp_path / "older/002.mp4"), tmp_path / "work"
    Sequence(work / "002").write_info(SequenceInfo("002", str(older), "video"))
    fresh = [source.id for source in find_sources(films, known=known_sources(work))[0]]
    assert len(set(fresh)) == 4 and "001" not in fresh and fresh[2] == "mug_002"
    for film, name in zip(films, fresh, strict=True):
        Sequence(work / name).write_info(SequenceInfo(name, str(film), "video"))
        known = known_sources(work)
        assert [source.id for source in find_sources(films, known=known)[0]] == fresh
        assert [source.id for source in find_sources(films[::-1], known=known)[0]] == fresh[::-1]


def test_a_co3d_download_is_not_taken_for_photo_folders(tmp_path: Path) -> None:
    photo_folder(tmp_path / "apple/1_2_3/images")
    touch(tmp_path / "apple/frame_annotations.jgz")
    for place in (tmp_path, tmp_path / "apple"):
        sources, errors = find_sources([place])
        assert not sources and "dope prep co3d" in str(errors[0][2])
