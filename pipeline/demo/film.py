"""Objects filmed into videos: the camera's path, the files, and many objects at once.

OUT/<family>/<family>_<k>.mp4          (or .avi, .mkv, .webm, .mov)
OUT/masks/<family>_<k>/000000.png      silhouettes by frame number of the video, 255 = object
OUT/truth/<family>_<k>.json            true cameras, sizes and settings; written last: the done-marker
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import files, seeds
from dope.common.errors import BadInput, UsageError
from dope.common.settings import config_hash
from pipeline.demo import matroska
from pipeline.demo.scene import build_scene, render_colours, render_mask
from pipeline.demo.shapes import FAMILIES
from pipeline.demo.surroundings import FAR_RING, LOWEST_ELEVATION_DEG
from pipeline.geometry import Camera, Floats

CODECS = {"mp4": "mp4v", "mov": "mp4v", "avi": "MJPG", "mkv": "MJPG", "webm": "VP80"}
"""Containers and the codec that goes into each; all are in OpenCV's wheel."""

RECIPE_VERSION = 2
"""Raise it whenever the pictures change, so that finished films are made anew."""


@dataclass(frozen=True)
class FilmConfig:
    """How each object is filmed."""

    width: int = 640
    """Width of the video in pixels."""
    height: int = 480
    """Height of the video in pixels."""
    frames: int = 28
    """Frames of a video."""
    fps: float = 8.0
    """Frames a second that the video claims."""
    arc_deg: tuple[float, float] = (230.0, 300.0)
    """Range of the angle that the camera goes round the object, drawn for each object."""
    fov_deg: tuple[float, float] = (48.0, 56.0)
    """Range of the horizontal field of view, drawn for each object."""
    distance: tuple[float, float] = (2.0, 2.6)
    """Smallest and largest distance to the object, whose diameter is 1.2."""
    elevation_deg: tuple[float, float] = (23.0, 52.0)
    """Lowest and highest the camera gets above the ground plane, as seen from the object."""
    jitter: float = 0.03
    """Deviation of the point the camera looks at, in units of length, and of its roll in radians."""
    noise: float = 1.5
    """Standard deviation of the sensor's noise in grey levels."""
    samples: int = 2
    """Samples a pixel in each direction (antialiasing)."""
    detail: float = 1.0
    """Resolution of textures and shadows; 1 suits 640 px, less is faster."""


@dataclass(frozen=True)
class DemoConfig:
    """Which objects are made, and how they are filmed."""

    training_families: tuple[str, ...] = ("mug", "bottle", "chair", "car")
    """Families to train on."""
    novel_families: tuple[str, ...] = ("pot", "lamp", "hammer", "plane")
    """Families that are kept for low-shot recognition."""
    per_family: int = 3
    """Instances of each family."""
    seed: int = 0
    """Seed of everything."""
    containers: tuple[str, ...] = ("mp4", "avi", "mp4", "mkv", "mp4", "webm")
    """Video containers, given to the objects in turn."""
    film: FilmConfig = field(default_factory=FilmConfig)
    """How each object is filmed."""

    @property
    def families(self) -> tuple[str, ...]:
        return self.training_families + self.novel_families


@dataclass(frozen=True)
class Job:
    """One object to film. `seed` depends on the config's seed, the family and the number alone."""

    family: str
    number: int
    seed: int
    container: str
    film: FilmConfig

    @property
    def id(self) -> str:
        return f"{self.family}_{self.number}"


def film_objects(
    out: Path, config: DemoConfig, workers: int = 0, progress: Callable[[str], None] | None = None
) -> list[Path]:
    """Film every object of the config that is not there yet; the same bytes whatever the number of workers.

    Args:
        out: folder that receives videos, masks and truth (see the module's head).
        workers: processes; 0 = one for each core.
        progress: called with each object's id when it is there.

    Returns:
        The videos, family by family.

    Raises:
        UsageError: the config asks for what does not exist. BadInput: a video could not be written.
    """
    _check(config)
    jobs: list[Job] = []
    for family in config.families:
        for number in range(config.per_family):
            container = config.containers[len(jobs) % len(config.containers)]
            jobs.append(
                Job(family, number, seeds.derive_seed(config.seed, "demo", family, number), container, config.film)
            )
    missing = []
    for job in jobs:
        if not is_done(out, job):
            missing.append(job)
        elif progress:
            progress(job.id)
    workers = min(workers or os.cpu_count() or 1, len(missing))
    if workers <= 1:
        for job in missing:
            film_one(out, job)
            if progress:
                progress(job.id)
    else:
        # spawn: a forked OpenCV or BLAS may hang on a lock that a thread of the parent held
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(workers, mp_context=context, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
            for job, _ in zip(missing, pool.map(film_one, [out] * len(missing), missing), strict=True):
                if progress:
                    progress(job.id)
    return [video_path(out, job) for job in jobs]


def video_path(out: Path, job: Job) -> Path:
    return out / job.family / f"{job.id}.{job.container}"


def truth_path(out: Path, job: Job) -> Path:
    return out / "truth" / f"{job.id}.json"


def is_done(out: Path, job: Job) -> bool:
    """Whether video, masks and truth are there, made with the same settings."""
    truth, video, masks = truth_path(out, job), video_path(out, job), out / "masks" / job.id
    if not (truth.is_file() and video.is_file() and masks.is_dir()):
        return False
    stored = files.read_json(truth)
    same = isinstance(stored, dict) and stored.get("settings_hash") == _fingerprint(job)
    return same and video.stat().st_size == stored["video_bytes"] and len(list(masks.glob("*.png"))) == job.film.frames


def film_one(out: Path, job: Job) -> None:
    """Render one object's video, masks and truth."""
    truth = truth_path(out, job)
    truth.unlink(missing_ok=True)
    for container in CODECS:  # the same object from a run with other containers
        (out / job.family / f"{job.id}.{container}").unlink(missing_ok=True)
    scene = build_scene(job.family, job.seed, job.film.detail)
    cameras = camera_path(job.film, scene.height, job.seed)
    rng = seeds.generator(job.seed, "sensor")
    video = video_path(out, job)
    with files.atomic_folder(out / "masks" / job.id) as masks, files.atomic_path(video) as partial:
        with _video_writer(partial, job) as writer:
            for number, camera in enumerate(cameras):
                writer.write(
                    _with_noise(render_colours(scene, camera, job.film.samples), job.film.noise, rng)[..., ::-1]
                )
                mask = render_mask(scene, camera)
                if not cv2.imwrite(str(masks / f"{number:06d}.png"), mask):
                    raise OSError(f"cannot write {masks / f'{number:06d}.png'}")
        if job.container in ("mkv", "webm"):
            matroska.make_reproducible(partial)
        _check_video(partial, video, job.film)
    first = cameras[0]
    files.write_json(
        truth,
        {
            "id": job.id,
            "family": job.family,
            "video": video.relative_to(out).as_posix(),
            "masks": f"masks/{job.id}",
            "width": first.width,
            "height": first.height,
            "K": first.K.tolist(),
            "object_height": scene.height,
            "frames": [{"frame": i, "R": c.R.tolist(), "t": c.t.tolist()} for i, c in enumerate(cameras)],
            "video_bytes": video.stat().st_size,
            "settings": asdict(job),
            "settings_hash": _fingerprint(job),
        },
    )


def read_truth(path: Path) -> list[Camera]:
    """The true cameras of a `truth/<id>.json`, by frame number of the video."""
    value: dict[str, Any] = files.read_json(path)
    K = np.array(value["K"])
    return [
        Camera(value["width"], value["height"], K, np.zeros(4), np.array(frame["R"]), np.array(frame["t"]))
        for frame in value["frames"]
    ]


def camera_path(film: FilmConfig, object_height: float, seed: int) -> list[Camera]:
    """A hand-held walk round the object: the angle grows steadily, height and distance swing, the hand shakes."""
    rng = seeds.generator(seed, "path")
    arc = np.radians(rng.uniform(*film.arc_deg)) * rng.choice([-1, 1])
    progress = np.linspace(0, 1, film.frames)
    step = 1 / max(1, film.frames - 1)
    azimuth = rng.uniform(0, 2 * np.pi) + arc * (progress + 0.1 * step * rng.uniform(-1, 1, film.frames))

    def swing(low: float, high: float) -> Floats:
        wave = np.sin(2 * np.pi * (rng.uniform(0.6, 1.4) * progress + rng.random()))
        return low + (high - low) * np.clip(0.5 + 0.45 * wave + 0.02 * rng.normal(size=film.frames), 0, 1)

    elevation, distance = np.radians(swing(*film.elevation_deg)), swing(*film.distance)
    focal = 0.5 * film.width / np.tan(np.radians(0.5 * rng.uniform(*film.fov_deg)))
    K = np.array([[focal, 0, film.width / 2], [0, focal, film.height / 2], [0, 0, 1]])
    target = np.array([0, 0, 0.5 * object_height])
    # (frames, 3) directions from the object to the camera
    around = np.stack(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    cameras = []
    for direction, length in zip(around, distance, strict=True):
        centre = target + length * direction
        R = look_at(centre, target + film.jitter * rng.normal(size=3), film.jitter * rng.normal())
        cameras.append(Camera(film.width, film.height, K, np.zeros(4), R, -R @ centre))
    return cameras


def look_at(centre: Floats, target: Floats, roll: float = 0.0) -> Floats:
    """Rotation (3, 3) of a camera at `centre` that looks at `target`, z up, rolled by radians about its axis."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    level = np.cross(forward, (0, 0, 1))
    right = level / np.linalg.norm(level)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * right + s * down, c * down - s * right, forward])


def _with_noise(image: NDArray[np.uint8], deviation: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image + np.float32(deviation) * noise), 0, 255).astype(np.uint8)


@contextmanager
def _video_writer(path: Path, job: Job) -> Iterator[cv2.VideoWriter]:
    codec = cv2.VideoWriter.fourcc(*CODECS[job.container])
    with _quiet_stderr():  # for WebM, FFmpeg remarks that it takes its own codec tag
        size = (job.film.width, job.film.height)
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, codec, job.film.fps, size)
    if not writer.isOpened():
        raise BadInput(
            f"this OpenCV cannot write {CODECS[job.container]} video into .{job.container}",
            where=path,
            remedy="Choose other containers, e.g. --set containers=[avi]",
        )
    try:
        yield writer
    finally:
        writer.release()


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Silence C code that writes to file descriptor 2."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with Path(os.devnull).open("w") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _check_video(partial: Path, video: Path, film: FilmConfig) -> None:
    """Decode what was written: encoders report neither a full disk nor a dropped frame."""
    capture = cv2.VideoCapture(str(partial), cv2.CAP_FFMPEG)
    count = 0
    while capture.grab():
        count += 1
    capture.release()
    if count != film.frames:
        raise BadInput(
            f"{count} of {film.frames} frames can be read back from the video",
            where=video,
            remedy="Check the free space of the disk, then run the same command again",
        )


def _fingerprint(job: Job) -> str:
    return config_hash({"job": asdict(job), "version": RECIPE_VERSION})


def _check(config: DemoConfig) -> None:
    film = config.film
    unknown = [name for name in config.containers if name not in CODECS]
    if unknown or not config.containers:
        raise UsageError(f"containers must be of {', '.join(CODECS)}, not {unknown}", where="containers")
    for family in config.families:
        if family not in FAMILIES:
            raise UsageError(f"unknown family '{family}'", where="families", remedy=f"Known: {', '.join(FAMILIES)}")
    if len(set(config.families)) < len(config.families):
        raise UsageError("a family is named twice", where="families")
    if film.frames < 2 or film.width % 2 or film.height % 2 or min(film.width, film.height) < 16:
        raise UsageError("a film needs two frames and even sides of at least 16 pixels", where="film")
    if film.elevation_deg[0] < LOWEST_ELEVATION_DEG or film.elevation_deg[1] > 85:
        raise UsageError(f"elevation_deg must lie within {LOWEST_ELEVATION_DEG:g} and 85 degrees", where="film")
    if film.distance[0] < 1.6 or film.distance[1] > FAR_RING[0] - 0.6:
        raise UsageError(f"distance must lie within 1.6 and {FAR_RING[0] - 0.6:g}", where="film")
