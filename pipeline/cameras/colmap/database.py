"""Databases: images entered, features found and matched, and both read back."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.cameras.colmap.base import CPU, CameraModel, explained, opened, pycolmap


@dataclass(frozen=True)
class Lens:
    """One camera, the images taken with it, and what is known of it.

    Attributes:
        names: of the images.
        width, height: of the images.
        model: COLMAP's name of the camera model.
        focal_px: the focal length to start from; None: unknown, 1.2 times the longer side.
        params: all parameters of the model in COLMAP's order, or None.
    """

    names: tuple[str, ...]
    width: int
    height: int
    model: CameraModel = "SIMPLE_RADIAL"
    focal_px: float | None = None
    params: tuple[float, ...] | None = None


def import_images(database: Path, images: Path, lenses: Sequence[Lens]) -> None:
    """Enter images into a new database, those of a lens with one camera; ids follow the given order."""
    with opened(database):
        pass  # creates the tables
    with explained("images could not be entered", images):
        for lens in lenses:
            options = pycolmap.ImageReaderOptions(camera_model=lens.model)
            if lens.params is not None or lens.focal_px is not None:
                camera = pycolmap.Camera.create_from_model_name(
                    1, lens.model, lens.focal_px or 1.0, lens.width, lens.height
                )
                if lens.params is not None:
                    camera.params = list(lens.params)
                options.camera_params = camera.params_to_string()
            pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, list(lens.names), options)


def extract_features(
    database: Path,
    images: Path,
    names: Sequence[str],
    *,
    masks: Path | None,
    max_image_size: int,
    first_octave: int,
    max_features: int,
    threads: int,
) -> None:
    """SIFT features of images entered before. `masks` holds `a.jpg.png` for `a.jpg`; black is ignored."""
    reader = pycolmap.ImageReaderOptions()
    if masks is not None:
        reader.mask_path = masks
    extraction = pycolmap.FeatureExtractionOptions(
        use_gpu=False,
        num_threads=threads,
        max_image_size=max_image_size,
        sift=pycolmap.SiftExtractionOptions(first_octave=first_octave, max_num_features=max_features),
    )
    with explained("features could not be extracted", images):
        pycolmap.extract_features(
            database, images, list(names), reader_options=reader, extraction_options=extraction, device=CPU
        )


def read_features(database: Path) -> dict[str, tuple[NDArray[np.float32], NDArray[np.uint8]]]:
    """Name -> scales (N,) and SIFT descriptors (N, 128) of each image's features."""
    result = {}
    with opened(database) as db:
        for image in db.read_all_images():
            keypoints = db.read_keypoints(image.image_id)
            if not len(keypoints):
                result[image.name] = (np.zeros(0, np.float32), np.zeros((0, 128), np.uint8))
                continue
            a11, a12, a21, a22 = keypoints[:, 2:6].T  # x and y come first, then the affine shape
            descriptors = np.asarray(db.read_descriptors(image.image_id).data, dtype=np.uint8)
            result[image.name] = (np.sqrt(np.abs(a11 * a22 - a12 * a21)), descriptors)
    return result


def match_pairs(database: Path, pairs: Sequence[tuple[str, str]], *, guided: bool, seed: int, threads: int) -> None:
    """Match and geometrically verify exactly these pairs of images.

    Args:
        guided: match the pairs that pass once more, along their epipolar lines, which finds more matches. Only those:
            guided matching costs several times as much, and finds nothing where nothing passed.
    """
    _match(database, pairs, guided=False, seed=seed, threads=threads)
    if not guided:
        return
    asked = {frozenset(pair) for pair in pairs}
    passed = [(a, b) for a, b, _ in read_verified_pairs(database) if frozenset((a, b)) in asked]
    forget_pairs(database, passed)
    _match(database, passed, guided=True, seed=seed, threads=threads)


def forget_pairs(database: Path, pairs: Iterable[tuple[str, str]]) -> None:
    """Take back the matches of these pairs of images: pairs that have matches are not matched again."""
    with opened(database) as db:
        number = {image.name: image.image_id for image in db.read_all_images()}
        for a, b in pairs:
            db.delete_matches(number[a], number[b])
            db.delete_two_view_geometry(number[a], number[b])


def _match(database: Path, pairs: Sequence[tuple[str, str]], *, guided: bool, seed: int, threads: int) -> None:
    if not pairs:
        return
    pycolmap.set_random_seed(seed)
    listing = database.with_suffix(".pairs.txt")
    listing.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads, guided_matching=guided)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listing)
    with explained("images could not be matched", database):
        pycolmap.match_image_pairs(database, matching, pairing, verification, device=CPU)


def read_verified_pairs(database: Path) -> list[tuple[str, str, int]]:
    """Pairs of image names with their number of verified matches, those without any left out."""
    with opened(database) as db:
        name = {image.image_id: image.name for image in db.read_all_images()}
        pair_ids, counts = db.read_two_view_geometry_num_inliers()
    pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in pair_ids]
    return sorted((name[a], name[b], int(n)) for (a, b), n in zip(pairs, counts, strict=True) if n)


@dataclass(frozen=True)
class MatchedPair:
    """All matches of two images that share a two-view geometry.

    Attributes:
        first_px, second_px: (N, 2) positions in the two images.
        verified: (N,) bool, True where the match agrees with the geometry.
    """

    first_px: NDArray[np.float32]
    second_px: NDArray[np.float32]
    verified: NDArray[np.bool_]


def read_matched_pairs(database: Path) -> Iterator[MatchedPair]:
    """The matches of all verified pairs, in the order of the images' ids."""
    with opened(database) as db:
        pixels = {image.image_id: db.read_keypoints(image.image_id)[:, :2] for image in db.read_all_images()}
        for pair_id, number in zip(*db.read_two_view_geometry_num_inliers(), strict=True):
            if not number:
                continue
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            matches = np.asarray(db.read_matches(a, b), dtype=np.int64).reshape(-1, 2)
            inliers = np.asarray(db.read_two_view_geometry(a, b).inlier_matches, dtype=np.int64).reshape(-1, 2)
            width = len(pixels[b]) + 1
            verified = np.isin(matches @ [width, 1], inliers @ [width, 1])
            yield MatchedPair(pixels[a][matches[:, 0]], pixels[b][matches[:, 1]], verified)
