"""The `sfm` stage from cameras that are given: placed, checked against the images, moved to the object's frame.

The check does not trust anybody: SIFT matches that agree between two images (whatever their cameras) must lie near the
epipolar lines of the given cameras. Where most of many matches do not, the cameras are of another convention, another
world or other images, and the sequence is refused; a smaller misfit is a warning. Without matches nothing is known,
and the cameras are believed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.cameras import colmap
from pipeline.cameras.known_points import refusal, triangulated, with_given_points
from pipeline.cameras.naming import listed, match_names
from pipeline.cameras.normalise import MIN_POINTS, ObjectFrame, find_object
from pipeline.cameras.project import keep_project
from pipeline.cameras.readers import KnownCameras, checked_camera, read_known_cameras
from pipeline.cameras.sfm import SfmConfig
from pipeline.cameras.store import scratch_folder, store_model
from pipeline.geometry import Camera, Floats, nearest_point_to_axes
from pipeline.sequence import Frame, Sequence

__all__ = ["KnownCameras", "place_cameras", "read_known_cameras", "reuse_cameras"]

MAX_ASPECT = 0.02  # widths and heights of small images are rounded


def reuse_cameras(sequence: Sequence, path: Path, config: SfmConfig) -> dict[str, Any]:
    """`place_cameras` with the cameras that `path` holds; see `read_known_cameras`."""
    return place_cameras(sequence, read_known_cameras(path), config)


def place_cameras(sequence: Sequence, known: KnownCameras, config: SfmConfig) -> dict[str, Any]:
    """Give a sequence's frames these cameras; write `sparse/`, frames.parquet and sequence.json in the object's frame.

    Frames that no camera belongs to stay without one. `config.known_points` says where points come from.

    Returns:
        What happened: registered share, points, errors, the normalising similarity, warnings.

    Raises:
        BadInput: names match nothing or are ambiguous, a camera is of an image of another shape, fewer than two
            frames have one, or the images contradict the cameras.
    """
    frames = sequence.read_frames()
    used = [frame for frame in frames if frame.image is not None]
    info = sequence.read_info()
    folder = Path(info.source)
    matched = match_names(known.cameras, used, by_number=info.kind == "video", folder=folder, where=known.where)
    cameras = {f.frame: _fitted(known, matched[f.frame], f) for f in used if f.frame in matched}
    if len(cameras) < 2:
        raise BadInput(f"only one frame has a camera, of {len(used)}", where=known.where)
    warnings = []
    without = [frame.source_name for frame in used if frame.frame not in cameras]
    if without:
        warnings.append(f"{len(without)} frames have no camera: {listed(without)}")
    with scratch_folder(sequence) as scratch:
        model, report = _with_points(sequence, used, cameras, known, config, warnings, scratch)
        kept = keep_project(sequence, frames, scratch / "database.db", wanted=config.keep_database)
    if model.n_points < MIN_POINTS:
        warnings.append(f"{model.n_points} points: stereo depth and GrabCut need them, or give --depths and --masks")
    report = {
        "rung": "given",
        "cameras_from": known.where,
        "n_frames": len(used),
        "n_registered": len(cameras),
        "registered_share": round(len(cameras) / len(used), 4),
        **report,
    }
    masks = [sequence.read_mask(frame) for frame in used if frame.frame in cameras]
    xyz = model.points().xyz
    views = list(cameras.values())
    found = find_object(xyz, views, masks) if len(xyz) >= MIN_POINTS else object_without_points(views, masks)
    model.transform(found.similarity)
    store_model(sequence, frames, [{**report, "verdict": "given"}], model, found.similarity.s)
    return {
        **report,
        **kept,
        "n_attempts": 1,
        "unused_cameras": len(known.cameras) - len(set(matched.values())),
        "object": {
            "centre": [round(float(v), 6) for v in found.centre],
            "radius": round(found.radius, 6),
            "n_points": found.n_points,
            "method": found.method,
        },
        "warnings": warnings,
    }


def _fitted(known: KnownCameras, name: str, frame: Frame) -> Camera:
    """The camera in pixels of the stored frame."""
    camera = checked_camera(name, known.cameras[name], Path(known.where))
    given, stored = camera.width / camera.height, frame.width / frame.height
    if abs(given / stored - 1) > MAX_ASPECT:
        turned = abs(given * stored - 1) < MAX_ASPECT
        raise BadInput(
            f"the camera of '{name}' is of a {camera.width}x{camera.height} image, frame '{frame.source_name}' is "
            f"{frame.source_width or frame.width}x{frame.source_height or frame.height}",
            where=known.where,
            remedy="The cameras were found before the photo's EXIF orientation was applied: turn the photos' pixels "
            "upright and find them again"
            if turned
            else "Give the photos that the cameras were found from, neither cropped nor stretched",
        )
    return camera.resized(frame.width, frame.height)


def _with_points(
    sequence: Sequence,
    used: list[Frame],
    cameras: dict[int, Camera],
    known: KnownCameras,
    config: SfmConfig,
    warnings: list[str],
    scratch: Path,
) -> tuple[colmap.Model, dict[str, Any]]:
    """The model of the cameras with its points, and what is to be said of them; its database in `scratch`."""
    given = known.xyz is not None and len(known.xyz) > 0
    if config.known_points == "none" or (config.known_points == "given" and given):
        model = colmap.model_of_cameras(cameras, [frame.frame for frame in used])
        if config.known_points == "given":
            assert known.xyz is not None
            rgb = known.rgb if known.rgb is not None else np.zeros((len(known.xyz), 3), np.uint8)
            model = with_given_points(model, cameras, known.xyz, rgb)
        colmap.enter_model(scratch / "database.db", model, [frame.frame for frame in used])
        return model, {"points": config.known_points, "n_points": model.n_points}
    masked_frames = [frame for frame in used if frame.mask is not None]
    for masked in [True] if config.mask_features and masked_frames else [False, True]:
        database = scratch / "database.db"
        database.unlink(missing_ok=True)
        model, fit, settings = triangulated(sequence, used, cameras, config, database, masked=masked)
        if not fit.refuted or not masked_frames:
            break
    if fit.refuted:
        raise refusal(fit, known.where, masks=bool(masked_frames))
    if fit.warning:
        warnings.append(fit.warning)
    return model, {
        "points": "triangulated",
        **settings,
        "n_matches": fit.n_matches,
        "match_error_px": round(fit.median_px, 3),
        "n_points": model.n_points,
        "mean_error_px": round(model.mean_error_px, 3),
    }


def object_without_points(cameras: list[Camera], masks: list[NDArray[np.bool_] | None]) -> ObjectFrame:
    """Where the object is, from cameras and masks alone.

    With masks: at the point nearest to the rays through their middles, as large as they show it from there. Without,
    it is taken to fill half of the views, at the point nearest to the optical axes.
    """
    shown = [(c, *_outline(c, m)) for c, m in zip(cameras, masks, strict=True) if m is not None and m.any()]
    if len(shown) >= 2:
        turned = [replace(camera, R=_facing(middle) @ camera.R) for camera, middle, _ in shown]
        centre = nearest_point_to_axes(turned)
        reach = [share * (camera.R[2] @ (centre - camera.centre)) for camera, _, share in shown]
        if (radius := float(np.median(reach))) > 0:
            return ObjectFrame(centre, radius, 0, "masks, without points")
    centre = nearest_point_to_axes(cameras)
    distance = float(np.median([np.linalg.norm(camera.centre - centre) for camera in cameras]))
    half_view = float(np.median([0.5 * min(c.width / c.K[0, 0], c.height / c.K[1, 1]) for c in cameras]))
    return ObjectFrame(centre, max(0.5 * half_view * distance, 1e-9), 0, "optical axes, without points")


def _outline(camera: Camera, mask: NDArray[np.bool_]) -> tuple[Floats, float]:
    """Middle (2,) of a mask and the distance from it that holds nearly all of the mask, in normalised coordinates."""
    row, column = np.nonzero(mask)
    few = slice(None, None, max(1, len(row) // 2000))
    xy = camera.to_normalised(np.stack([column[few], row[few]], axis=1) + 0.5)
    middle = np.percentile(xy, [2, 98], axis=0).mean(axis=0)
    return middle, float(np.percentile(np.linalg.norm(xy - middle, axis=1), 95))


def _facing(xy: Floats) -> Floats:
    """A rotation (3, 3) that turns the ray through normalised coordinates (2,) into the optical axis."""
    z = np.array([*xy, 1.0]) / np.linalg.norm([*xy, 1.0])
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
