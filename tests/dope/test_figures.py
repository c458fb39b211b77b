from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from spheres import CoordinateNetwork, sphere_view
from tiny_views import write_views
from torch import Tensor

from dope.batch import PairBatch
from dope.common.errors import BadInput, UsageError
from dope.figures import draw_figures, figure_for, from_shards, held_out
from dope.figures.colouring import correspondence_colouring, nearest, position_colours, principal_components
from dope.figures.drawing import MARK, Row, contact_sheet, dimmed, heat, over, put_marker, put_text, write_png
from dope.figures.from_shards import evenly_spaced
from dope.figures.heatmap import similarity_heatmap
from dope.figures.held_out import held_out_sheet
from dope.figures.maps import describe
from dope.networks import DopeNetwork, NetworkConfig
from dope.networks.untrained import untrained_network

TURNS = (0, 30, -25)
NETWORK = NetworkConfig(width=0.125, pyramid=16, projector=(24, 12))


@pytest.fixture(scope="module")
def spheres() -> list[tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float64]]]:
    return [sphere_view(turn, 96) for turn in TURNS]


def seen_in_both(spheres: list, i: int) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:  # type: ignore[type-arg]
    """Pixels of view i whose point the first view shows well inside its disc, and that point's row and column there."""
    points = spheres[i][2]
    front = spheres[i][1] & (points[..., 2] < -0.45) & (np.abs(points[..., :2]).max(-1) < 0.85)
    rows, columns = (np.floor((points[front][:, axis] + 1.2) / 2.4 * 96).astype(int) for axis in (1, 0))
    return front, rows, columns


@pytest.mark.parametrize("masks", ["given", "predicted"])
@pytest.mark.parametrize("colours", ["position", "pca"])
def test_the_same_point_has_the_same_colour_in_every_view(
    spheres: list,
    tmp_path: Path,
    masks: str,
    colours: str,  # type: ignore[type-arg]
) -> None:
    given = [mask for _, mask, _ in spheres] if masks == "given" else None
    out = tmp_path / "sheet.png"
    carried = correspondence_colouring(
        CoordinateNetwork(),
        [photo for photo, _, _ in spheres],
        out,
        masks=given,
        colours=colours,  # type: ignore[arg-type]
    )
    for i in (1, 2):
        front, rows, columns = seen_in_both(spheres, i)
        assert front.sum() > 800
        difference = np.abs(carried[i][front] - carried[0][rows, columns]).max(1)
        shuffled = np.abs(carried[i][front] - np.roll(carried[0][rows, columns], 300, axis=0)).max(1)
        assert np.quantile(difference, 0.95) < 0.05 < 0.1 < np.median(shuffled)
    sheet = cv2.imread(str(out))
    assert sheet.shape[0] > 3 * 96 and sheet.shape[1] > 3 * 96


def test_principal_components_of_one_point_agree_across_views(spheres: list) -> None:  # type: ignore[type-arg]
    maps = describe(CoordinateNetwork(), [photo for photo, _, _ in spheres])
    images = principal_components(maps)
    for i in (1, 2):
        front, rows, columns = seen_in_both(spheres, i)
        assert np.quantile(np.abs(images[i][front] - images[0][rows, columns]), 0.95) < 0.06
    for again, image in zip(principal_components(maps), images, strict=True):
        np.testing.assert_array_equal(again, image)


def test_few_cells_or_dimensions_still_have_three_components() -> None:
    class Flat(torch.nn.Module):
        def descriptors(self, images: Tensor) -> Tensor:
            found = torch.zeros(1, 2, 8, 8)
            found[0, 0, 3, 3:5] = 1.0
            return found

    photo = np.zeros((32, 32, 3), np.uint8)
    (image,) = principal_components(describe(Flat(), [photo]))
    assert image.shape == (32, 32, 3) and np.isfinite(image).all()


@pytest.mark.parametrize("turn", [30, -25])
def test_a_point_is_found_where_it_is(spheres: list, tmp_path: Path, turn: int) -> None:  # type: ignore[type-arg]
    photo, _, points = spheres[0]
    other = spheres[TURNS.index(turn)]
    point = (40.5, 55.5)
    best = similarity_heatmap(CoordinateNetwork(), [photo, other[0]], point, tmp_path / "map.png")
    wanted = points[55, 40]
    nearest_pixel = np.unravel_index(
        np.linalg.norm(other[2] - wanted + 9 * ~other[1][..., None], axis=-1).argmin(), (96, 96)
    )
    assert best[0] == point
    assert np.abs(np.array(best[1]) - 0.5 - np.array(nearest_pixel[::-1])).max() <= 2
    assert (tmp_path / "map.png").is_file()


def test_without_a_point_the_innermost_pixel_is_taken(spheres: list, tmp_path: Path) -> None:  # type: ignore[type-arg]
    best = similarity_heatmap(CoordinateNetwork(), [s[0] for s in spheres], None, tmp_path / "map.png")
    assert np.abs(np.array(best[0]) - 48).max() <= 2


def test_points_outside_and_empty_masks_are_explained(spheres: list, tmp_path: Path) -> None:  # type: ignore[type-arg]
    photos = [photo for photo, _, _ in spheres]
    with pytest.raises(UsageError, match="--point: 96,10 lies outside the view of 96x96 px"):
        similarity_heatmap(CoordinateNetwork(), photos, (96, 10), tmp_path / "a.png")
    nothing = [np.zeros((96, 96), bool)] * 3
    with pytest.raises(BadInput, match="view 0: no object"):
        similarity_heatmap(CoordinateNetwork(), photos, None, tmp_path / "a.png", masks=nothing)
    with pytest.raises(BadInput, match="frame 7: the reference mask is empty"):
        names = ["frame 7", "", ""]
        correspondence_colouring(CoordinateNetwork(), photos, tmp_path / "a.png", masks=nothing, names=names)
    with pytest.raises(UsageError, match=r"\.png"):
        write_png(tmp_path / "a.jpg", photos[0])
    assert not list(tmp_path.iterdir())


def test_a_view_without_the_object_stays_uncoloured(spheres: list, tmp_path: Path) -> None:  # type: ignore[type-arg]
    masks = [spheres[0][1], np.zeros((96, 96), bool)]
    photos = [spheres[0][0], spheres[1][0]]
    carried = correspondence_colouring(CoordinateNetwork(), photos, tmp_path / "a.png", masks=masks)
    assert carried[0].any() and not carried[1].any()


def test_nearest_is_the_greatest_cosine() -> None:
    generator = torch.Generator().manual_seed(0)
    known, asked = (torch.nn.functional.normalize(torch.randn(n, 6, generator=generator), dim=1) for n in (700, 2000))
    assert torch.equal(nearest(asked, known), (asked @ known.T).argmax(1))


def test_position_colours_are_smooth_and_all_different() -> None:
    where = np.zeros((40, 60), bool)
    where[5:35, 10:50] = True
    colours = position_colours(where)[5:35, 10:50]
    assert (colours >= 0).all() and (colours <= 1).all()
    assert np.abs(np.diff(colours, axis=1)).max() < 0.05
    flat = colours.reshape(-1, 3)
    distance = np.linalg.norm(flat[::7, None] - flat[None, ::7], axis=-1) + np.eye(len(flat[::7]))
    assert distance.min() > 0.005


def test_a_sheet_holds_its_tiles_unchanged_on_white() -> None:
    generator = np.random.default_rng(0)
    tiles = [generator.integers(0, 255, (30, 40, 3), dtype=np.uint8) for _ in range(4)]
    sheet = contact_sheet([Row("one\ntwo", tiles[:2]), Row("three", tiles[2:])], title="T", columns=["a", "b"])
    found = []
    for tile in tiles:
        score = cv2.matchTemplate(sheet, tile, cv2.TM_SQDIFF)
        _, _, place, _ = cv2.minMaxLoc(score)
        np.testing.assert_array_equal(sheet[place[1] : place[1] + 30, place[0] : place[0] + 40], tile)
        found.append(place)
    assert found[0][1] == found[1][1] < found[2][1] == found[3][1] and found[0][0] == found[2][0] < found[1][0]
    assert (sheet[:3] == 255).all() and (sheet[-3:] == 255).all() and (sheet[:, -3:] == 255).all()
    wide = contact_sheet([Row("", tiles[:1])], title="a title that is much wider than its only tile")
    assert wide.shape[1] > 300 and (wide[:, -3:] == 255).all()


def test_markers_and_text_are_drawn_where_asked_and_cut_off_at_the_edge() -> None:
    white = np.full((60, 80, 3), 255, np.uint8)
    marked = put_marker(white, (30.5, 20.5))
    rows, columns = np.nonzero((marked != 255).any(-1))
    assert abs(rows.mean() - 20) < 0.6 and abs(columns.mean() - 30) < 0.6 and (white == 255).all()
    assert np.abs(marked[20, 30].astype(int) - MARK).max() < 40
    for corner in ((0.5, 0.5), (79.5, 59.5), (200.0, 20.0)):
        assert put_marker(white, corner).shape == white.shape
    put_text(white, "Ag", (5, 40), 0.5, (0, 0, 0))
    rows, columns = np.nonzero((white < 128).all(-1))
    assert rows.min() > 20 and rows.max() < 50 and columns.min() >= 4 and columns.max() < 40


def test_colours_are_laid_over_the_photo_by_opacity() -> None:
    ground = dimmed(np.zeros((2, 2, 3), np.uint8))
    red = np.zeros((2, 2, 3))
    red[..., 0] = 1
    alpha = np.array([[0.0, 1.0], [0.5, 1.0]])
    image = over(ground, red, alpha)
    assert image[0, 0].tolist() == ground[0, 0].tolist() and image[0, 1].tolist() == [255, 0, 0]
    assert image[1, 0].tolist() == [212, 84, 84]
    bright, dark = heat(np.array([1.0, 0.0]))
    assert bright.sum() > dark.sum() + 0.8


def test_evenly_spaced_views() -> None:
    assert evenly_spaced(np.arange(100, 112), 4).tolist() == [100, 103, 106, 109]
    assert evenly_spaced(np.arange(3), 6).tolist() == [0, 1, 2]


@pytest.fixture(scope="module")
def shards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_views(tmp_path_factory.mktemp("shards"), categories=1, objects=3, views=3)


@pytest.fixture
def small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def load(checkpoint: Path | None, device: object) -> tuple[DopeNetwork, int | None, str]:
        return untrained_network(NETWORK, seed=0), 32, "random weights"

    monkeypatch.setattr(from_shards, "_network", load)


@pytest.mark.usefixtures("small_network")
def test_figures_of_sequences_in_shards(shards: Path, tmp_path: Path) -> None:
    held_out_first = list(draw_figures(None, shards, tmp_path, limit=2, masks="given"))
    assert held_out_first == [tmp_path / "shape0_object2-colouring.png", tmp_path / "shape0_object0-colouring.png"]
    named = figure_for(shards, None, "shape0_object1", "heatmap", tmp_path, views=2, point=(32, 32))
    assert named == tmp_path / "shape0_object1-heatmap.png"
    images = [cv2.imread(str(path)) for path in (*held_out_first, named)]
    assert images[0].shape[0] > images[2].shape[0]  # three rows against two
    first = held_out_first[0].read_bytes()
    list(draw_figures(None, shards, tmp_path, limit=1, masks="given"))
    assert held_out_first[0].read_bytes() == first


@pytest.mark.parametrize("limit", [0, -1])
def test_no_figure_at_all_is_an_error(shards: Path, tmp_path: Path, limit: int) -> None:
    with pytest.raises(UsageError, match=f"^--limit: must be at least 1, not {limit}"):
        list(draw_figures(None, shards, tmp_path, limit=limit))


@pytest.mark.usefixtures("small_network")
def test_unknown_sequences_and_too_few_views_are_explained(shards: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="did you mean 'shape0_object1'"):
        figure_for(shards, None, "shape0-object1", "heatmap", tmp_path)
    with pytest.raises(UsageError, match="at least 2 views"):
        figure_for(shards, None, "shape0_object1", "heatmap", tmp_path, views=1)
    alone = write_views(tmp_path / "alone", categories=1, objects=1, views=1)
    with pytest.raises(UsageError, match="no sequence has two views"):
        list(draw_figures(None, alone, tmp_path))
    with pytest.raises(UsageError, match="only one view"):
        figure_for(alone, None, "shape0_object0", "colouring", tmp_path)


def test_one_sequence_without_an_object_does_not_stop_the_others(
    shards: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class SeesObjectsOnce(CoordinateNetwork):
        calls = 0

        def descriptors(self, images: Tensor) -> Tensor:
            SeesObjectsOnce.calls += 1
            return super().descriptors(images) * (SeesObjectsOnce.calls > 2)

    monkeypatch.setattr(from_shards, "_network", lambda checkpoint, device: (SeesObjectsOnce(), None, "fake"))
    drawn = []
    with pytest.raises(BadInput, match="shape0_object2, frame 0: the network sees no object"):
        for path in draw_figures(None, shards, tmp_path, views=2, limit=2):
            drawn.append(path.name)
    assert drawn == ["shape0_object0-colouring.png"]


def sphere_pairs(spheres: list) -> PairBatch:  # type: ignore[type-arg]
    """Views 0 and 1, twice; the point of the second pair is the sphere's middle, the first pair has none."""
    images = [torch.from_numpy(photo).permute(2, 0, 1)[None].expand(2, -1, -1, -1) for photo, _, _ in spheres[:2]]
    masks = [torch.from_numpy(mask)[None, None].expand(2, -1, -1, -1) for _, mask, _ in spheres[:2]]
    front, rows, columns = seen_in_both(spheres, 1)
    at = int(np.argmin((rows - 48) ** 2 + (columns - 48) ** 2))
    row2, column2 = np.argwhere(front)[at]
    points = torch.full((2, 3, 4), 5.0)
    points[1, 1] = torch.tensor([columns[at] + 0.5, rows[at] + 0.5, column2 + 0.5, row2 + 0.5])
    valid = torch.tensor([[False] * 3, [False, True, True]])
    return PairBatch(*images, *masks, points, valid, torch.arange(2), ("no point", "mug-0001"))


def test_the_sheet_of_held_out_pairs_shows_a_point_where_it_is_and_where_it_is_found(
    spheres: list, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Row] = []
    monkeypatch.setattr(held_out, "contact_sheet", lambda rows, **_: shown.extend(rows) or "sheet")
    marked: list[tuple[float, float]] = []
    monkeypatch.setattr(held_out, "put_marker", lambda image, point: marked.append(point) or image)
    batch = sphere_pairs(spheres)
    assert held_out_sheet(CoordinateNetwork(), [batch], 4) == "sheet"
    (row,) = shown
    assert row.label.startswith("mug-0001\noff by ") and len(row.tiles) == len(held_out.COLUMNS)
    query, truth, found = marked
    assert query == pytest.approx(batch.points[1, 1, :2].tolist())
    assert truth == pytest.approx(batch.points[1, 1, 2:].tolist())
    assert np.hypot(found[0] - truth[0], found[1] - truth[1]) < 4 < np.hypot(*(np.subtract(query, truth)))
    for tile, photo, mask in ((row.tiles[3], *spheres[0][:2]), (row.tiles[4], *spheres[1][:2])):
        core = cv2.erode(mask.astype(np.uint8), np.ones((17, 17))) > 0
        outside = cv2.dilate(mask.astype(np.uint8), np.ones((17, 17))) == 0
        assert np.abs(tile[core].astype(int) - photo[core]).max() < 12 and (tile[outside] > 240).all()


def test_as_many_held_out_pairs_as_asked_for_and_none_where_there_is_none(spheres: list) -> None:
    batch = sphere_pairs(spheres)
    sheets = [held_out_sheet(CoordinateNetwork(), [batch] * 3, n) for n in (1, 2)]
    assert sheets[0] is not None and sheets[1] is not None
    assert sheets[0].dtype == np.uint8 and sheets[1].shape[0] - sheets[0].shape[0] > 96
    assert held_out_sheet(CoordinateNetwork(), [], 4) is None
