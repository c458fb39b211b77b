"""One prepared sequence on disk: where everything lies and how it is read and written.

Whatever the source (video, photos, CO3D, renders), from here on all is the same:

    WORK/<sequence_id>/
      sequence.json       id, source, category, instance, image size, counts, unit of length, what was tried
      frames.parquet      a row a frame (see FRAME_SCHEMA)
      images/             JPEG, named 000000.jpg, 000001.jpg ... in order
      masks/              8-bit PNG, 255 = object, same stem and size as the image
      depths/             16-bit PNG, z-depth = value * depth_scale (0 = unknown); may be smaller than the image
      sparse/             a COLMAP model of the registered frames that COLMAP's own tools open
      views/              224x224 crops around the object (written by the correspond stage)
      correspondences.parquet
      stages/<stage>.json the done-marker of each stage (see stages.py)
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput
from pipeline.geometry import Camera
from pipeline.inputs.image_size import refuse_huge

FRAME_SCHEMA = pa.schema(
    [
        ("frame", pa.int32()),  # index of the row and stem of the file names
        ("time_s", pa.float64()),  # in the video; null for photos
        ("source_name", pa.string()),  # original file name, or the video's frame number
        ("image", pa.string()),  # paths relative to the sequence; null where absent
        ("mask", pa.string()),
        ("depth", pa.string()),
        ("width", pa.int32()),  # of the image as stored
        ("height", pa.int32()),
        ("camera_model", pa.string()),  # OPENCV, or null while unknown
        ("fx", pa.float64()),
        ("fy", pa.float64()),
        ("cx", pa.float64()),
        ("cy", pa.float64()),
        ("distortion", pa.list_(pa.float64())),  # k1, k2, p1, p2
        ("R", pa.list_(pa.float64())),  # row-major, world to camera
        ("t", pa.list_(pa.float64())),
        ("registered", pa.bool_()),
        ("sharpness", pa.float64()),
        ("dropped", pa.string()),  # why it was left out, or null
        ("depth_scale", pa.float64()),
        ("source_width", pa.int32()),  # of the source image, upright, before any resizing
        ("source_height", pa.int32()),
        ("focal_px_prior", pa.float64()),  # by the photo's EXIF, pixels of the image as stored; null where unknown
        ("mask_iou", pa.float64()),  # of the mask and the silhouette of the other views' hull; null where not checked
        ("mask_flag", pa.string()),  # why the mask is doubted, or null
    ]
)


FARTHEST = 13.0
"""Depth that is kept, in multiples of the depth of what the view looks at: a step is 0.02% of that at most."""


@dataclass
class Frame:
    """One row of frames.parquet. Dropped frames keep their row, with a reason and no image."""

    frame: int
    source_name: str
    width: int
    height: int
    time_s: float | None = None
    image: str | None = None
    mask: str | None = None
    depth: str | None = None
    camera_model: str | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    distortion: list[float] | None = None
    R: list[float] | None = None
    t: list[float] | None = None
    registered: bool = False
    sharpness: float | None = None
    dropped: str | None = None
    depth_scale: float | None = None
    source_width: int | None = None
    source_height: int | None = None
    focal_px_prior: float | None = None
    mask_iou: float | None = None
    mask_flag: str | None = None

    @property
    def camera(self) -> Camera:
        """The camera in pixels of the stored image. Raises ValueError for a frame without a pose."""
        if not self.registered or self.fx is None or self.R is None or self.t is None:
            raise ValueError(f"frame {self.frame} has no camera")
        K = np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], dtype=np.float64)
        distortion = np.array(self.distortion or [0.0] * 4, dtype=np.float64)
        return Camera(self.width, self.height, K, distortion, np.array(self.R).reshape(3, 3), np.array(self.t))

    def set_camera(self, camera: Camera) -> None:
        """Store a camera given in pixels of the stored image and mark the frame registered."""
        K = camera.K
        self.camera_model = "OPENCV"
        self.fx, self.fy, self.cx, self.cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
        self.distortion = [float(v) for v in camera.distortion]
        self.R, self.t = [float(v) for v in camera.R.ravel()], [float(v) for v in camera.t]
        self.registered = True

    def clear_camera(self) -> None:
        """Forget pose and intrinsics (a new reconstruction starts from nothing)."""
        self.camera_model = self.fx = self.fy = self.cx = self.cy = None
        self.distortion = self.R = self.t = None
        self.registered = False


@dataclass
class SequenceInfo:
    """sequence.json: what a person or a tool needs to know of a sequence before opening anything else."""

    id: str
    source: str
    """Where it came from: path of the video or folder."""
    kind: str
    """video, photos, co3d or render."""
    category: str | None = None
    instance: str | None = None
    licence: str | None = None
    unit: str = "arbitrary"
    """Unit of length: "arbitrary" until the reconstruction is normalised, then "object radius"."""
    input_scale: float | None = None
    """Length, in this sequence's unit, of one unit of the cameras as given or reconstructed; None: no cameras."""
    ordered: bool = False
    """True where neighbouring frames are neighbouring views (videos, turntables)."""
    paired: bool = False
    """True where frames 2k and 2k + 1 were made to be a pair (renders)."""
    subset: str | None = None
    """The part of its dataset that it comes from (ModelNet's train or test), as the source says; nothing reads it."""
    n_frames: int = 0
    n_registered: int = 0
    registered_share: float = 0.0
    attempts: list[dict[str, Any]] = field(default_factory=list)
    """Every reconstruction attempt: settings, registered share, mean reprojection error, accepted or why not."""
    masks_from: Literal["input", "import", "grabcut"] | None = None
    """Whose the masks are: they came with the input, were imported by `prep masks`, or cut out by it."""

    @property
    def masks_are_later(self) -> bool:
        """True where the masks were made after the cameras: cameras and depth must not depend on them."""
        return self.masks_from in ("import", "grabcut")


class Sequence:
    """A folder WORK/<id> and its files. Reading never changes anything; every write is atomic."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __repr__(self) -> str:
        return f"Sequence({str(self.folder)!r})"

    @property
    def id(self) -> str:
        return self.folder.name

    @property
    def images(self) -> Path:
        return self.folder / "images"

    @property
    def masks(self) -> Path:
        return self.folder / "masks"

    @property
    def depths(self) -> Path:
        return self.folder / "depths"

    @property
    def sparse(self) -> Path:
        return self.folder / "sparse"

    @property
    def views(self) -> Path:
        return self.folder / "views"

    @property
    def correspondences(self) -> Path:
        return self.folder / "correspondences.parquet"

    @property
    def stages(self) -> Path:
        return self.folder / "stages"

    def read_info(self) -> SequenceInfo:
        """Raises `BadInput` where sequence.json is absent, or is none: no object, or without id, source or kind."""
        path = self.folder / "sequence.json"
        values = files.read_json(path)
        remedy = "Prepare the sequence again with --overwrite"
        if not isinstance(values, dict):
            raise BadInput("is not a JSON object", where=path, remedy=remedy)
        if missing := [key for key in ("id", "source", "kind") if not isinstance(values.get(key), str)]:
            raise BadInput(f"does not say its {', '.join(missing)}", where=path, remedy=remedy)
        known = {f.name for f in fields(SequenceInfo)}
        return SequenceInfo(**{key: value for key, value in values.items() if key in known})

    def write_info(self, info: SequenceInfo) -> None:
        files.write_json(self.folder / "sequence.json", info.__dict__)

    def read_frames(self) -> list[Frame]:
        """All rows, dropped frames included, in order."""
        path = self.folder / "frames.parquet"
        try:
            table = pq.read_table(path)
        except FileNotFoundError:
            raise BadInput("has no frames yet", where=self.folder, remedy="Run `dope prep colmap` first") from None
        except pa.ArrowInvalid as error:
            raise BadInput(f"cannot be read ({error})", where=path, remedy="Run the stage with --overwrite") from error
        known = {f.name for f in fields(Frame)}
        return [Frame(**{k: v for k, v in row.items() if k in known}) for row in table.to_pylist()]

    def write_frames(self, frames: Iterable[Frame]) -> None:
        table = pa.Table.from_pylist([frame.__dict__ for frame in frames], schema=FRAME_SCHEMA)
        with files.atomic_path(self.folder / "frames.parquet") as partial:
            pq.write_table(table, partial)

    def registered_frames(self) -> list[Frame]:
        return [frame for frame in self.read_frames() if frame.registered and frame.image]

    def read_image(self, frame: Frame) -> NDArray[np.uint8]:
        """The image, BGR, shape (height, width, 3)."""
        return self._read(frame.image, cv2.IMREAD_COLOR)

    def read_mask(self, frame: Frame) -> NDArray[np.bool_] | None:
        """The object's mask (height, width), or None where the frame has none."""
        return None if frame.mask is None else self._read(frame.mask, cv2.IMREAD_GRAYSCALE) > 127

    def read_depth(self, frame: Frame) -> NDArray[np.float32] | None:
        """z-depth (h, w) in the sequence's unit, 0 = unknown, or None. May be smaller than the image."""
        if frame.depth is None or frame.depth_scale is None:
            return None
        return self._read(frame.depth, cv2.IMREAD_UNCHANGED).astype(np.float32) * np.float32(frame.depth_scale)

    def write_mask(self, frame: Frame, mask: NDArray[np.bool_]) -> None:
        """Write the mask and note its path in `frame` (the caller writes the frames)."""
        frame.mask = f"masks/{frame.frame:06d}.png"
        write_image(self.folder / frame.mask, mask.astype(np.uint8) * 255)

    def write_depth(
        self, frame: Frame, depth: NDArray[np.floating], *, subject: float | None = None
    ) -> NDArray[np.float32]:
        """Write z-depth (h, w) as 16-bit PNG and return it as it is read back (the caller writes the frames).

        One step is 1/65535 of the largest depth. So that a sky at 1e10 leaves steps for what is near, depth of more
        than `FARTHEST` times the subject's becomes unknown, as is what is no positive finite number.

        Args:
            subject: depth of what the view looks at; None: the median of the map.
        """
        known = np.where(np.isfinite(depth) & (depth > 0), depth, 0.0)
        if subject is None:
            subject = float(np.median(known[known > 0])) if known.any() else 0.0
        known[known > FARTHEST * subject] = 0
        largest = float(known.max(initial=0.0))
        frame.depth = f"depths/{frame.frame:06d}.png"
        frame.depth_scale = largest / 65535 if largest > 0 else 1.0
        values = np.rint(known / frame.depth_scale).astype(np.uint16)
        write_image(self.folder / frame.depth, values)
        return values.astype(np.float32) * np.float32(frame.depth_scale)

    def _read(self, name: str | None, flags: int) -> NDArray[Any]:
        if name is None:
            raise BadInput("a dropped frame has no image", where=self.folder)
        return read_image(self.folder / name, flags)


def read_image(path: Path, flags: int = cv2.IMREAD_COLOR) -> NDArray[Any]:
    """Decode an image (file names of any alphabet). Raises `BadInput` naming the file."""
    try:
        data = path.read_bytes()
        refuse_huge(data)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    except BadInput as error:
        raise BadInput(error.what, where=path, remedy=error.remedy) from error
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise BadInput("is not an image that can be decoded", where=path)
    return image


def write_image(path: Path, image: NDArray[Any], *, jpeg_quality: int = 95) -> None:
    """Encode by the path's suffix and write atomically."""
    parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    ok, data = cv2.imencode(path.suffix, image, parameters)
    if not ok:
        raise BadInput("image could not be encoded", where=path)
    files.write_bytes(path, data.tobytes())


def find_sequences(work: Path) -> Iterator[Sequence]:
    """The prepared sequences under WORK, sorted by id."""
    if not work.is_dir():
        raise BadInput("no such folder", where=work, remedy="WORK is what `dope prep colmap --out` wrote")
    for folder in sorted(path for path in work.iterdir() if (path / "sequence.json").is_file()):
        yield Sequence(folder)


def sequence_id(name: str) -> str:
    """A name that is safe as a folder and as a WebDataset key: letters, digits, "_" and "-"; never empty."""
    return re.sub(r"[^\w-]+", "_", name).strip("_") or "sequence"
