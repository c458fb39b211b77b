"""Settings of the `sfm` stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from dope.common.errors import UsageError
from dope.common.settings import by_flag
from pipeline.cameras.intrinsics import CameraModel, check_intrinsics
from pipeline.cameras.model_checks import CheckConfig


@dataclass(frozen=True)
class SfmConfig:
    """Settings of structure from motion."""

    matching: Literal["auto", "sequential", "exhaustive", "similar"] = "auto"
    """Which frames are matched: neighbours in time, all, or those that look alike; auto chooses by order and number."""
    mask_features: bool = False
    """Use only features inside the masks, where there are any (turntables: the object turns, the background does not).
    Without this they are used all the same when whole images give no model that can be believed."""
    camera_model: Literal["auto", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"] = "auto"
    """COLMAP's camera model; auto: SIMPLE_RADIAL, or OPENCV where intrinsics are given."""
    share_camera: bool = True
    """One camera for all frames of a size and EXIF focal length; false: one a frame (zoom, several cameras)."""
    intrinsics: tuple[float, ...] | None = None
    """Known fx, fy, cx, cy [, k1, k2, p1, p2] in pixels of the source image, from its corner; OpenCV's distortion."""
    refine_intrinsics: bool = False
    """Take known intrinsics as a first guess and refine them; false: they stay as given."""
    focal_mm: float | None = None
    """Focal length as 35 mm equivalent, in millimetres: where refinement starts."""
    focal_factor: float | None = None
    """Focal length in multiples of the longer image side: where refinement starts."""
    exif_focal: bool = True
    """Start from the focal length in the photos' EXIF, where there is one and nothing else is given; else from 1.2
    times the longer side."""
    refine_focal: bool = True
    """Refine the focal length in bundle adjustment (known intrinsics: see refine_intrinsics)."""
    max_image_size: int = 704
    """Longer side at which features are found, px; cameras are those of the stored images all the same."""
    fine_image_size: int = 640
    """The same for the second rung of the ladder, which starts an octave finer."""
    fallback_image_size: int = 1024
    """The same for the last rung of the ladder."""
    first_octave: int = 0
    """First octave of SIFT in the first attempt; the next ones use -1, four times the pixels."""
    max_features: int = 2000
    """Features of an image before orientations are assigned (an image has up to twice as many)."""
    gaps: tuple[int, ...] = (1, 2, 4, 8)
    """Sequential matching: distances in frames between the two of a pair."""
    wrap_around: bool = True
    """Sequential matching: the last frames are matched with the first ones, as if the orbit were closed."""
    similar_neighbours: int = 8
    """Similarity matching: how many look-alikes each frame is matched with (sequential: half as many)."""
    exhaustive_limit: int = 24
    """auto: unordered sets up to this size are matched exhaustively."""
    exhaustive_fallback_limit: int = 100
    """The last attempt matches sets up to this size exhaustively."""
    target_share: float = 0.97
    """Share of registered frames (rounded down to whole frames) at which no further attempt is made."""
    max_rungs: int = 3
    """Rungs of the ladder tried: default, fine (finer scales, guided matching), large (more pixels, all pairs)."""
    global_mapper: bool = False
    """Try COLMAP's global mapper on the matches of the last rung where no model of the ladder is good enough."""
    robust_refinement: bool = True
    """Adjust the accepted model once more with a loss that hardly counts large errors."""
    straggler_pairs: int = 24
    """Frames that stay out of an accepted model are matched with so many others, guided, and tried again (0: never)."""
    checks: CheckConfig = field(default_factory=CheckConfig)
    """What a model must have to be believed."""
    known_points: Literal["triangulate", "given", "none"] = "triangulate"
    """Given cameras: points from matches, which also shows whether the cameras fit the images; those that came with
    the cameras (matches where none came); or none at all, which costs nothing and checks nothing."""
    keep_database: bool = True
    """Leave COLMAP's database (features, matches, two-view geometries) and project.ini in the sequence, for its GUI."""
    threads: int = by_flag("--threads", 1)
    """Threads of COLMAP; with one the same input gives the same bytes."""
    seed: int = 0
    """Seed of all random sampling."""

    def __post_init__(self) -> None:
        given = [name for name in ("intrinsics", "focal_mm", "focal_factor") if getattr(self, name) is not None]
        if len(given) > 1:
            raise UsageError(f"{' and '.join(given)} are given at once", where="sfm", remedy="One of them is enough")
        for name in ("focal_mm", "focal_factor"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise UsageError(f"a focal length must be above 0, not {value:g}", where=f"sfm.{name}")
        if self.max_rungs < 1:
            raise UsageError(f"the ladder has at least one rung, not {self.max_rungs}", where="sfm.max_rungs")
        if self.intrinsics is not None:
            check_intrinsics(self.intrinsics, self.lens_model)

    @property
    def lens_model(self) -> CameraModel:
        """COLMAP's camera model, auto resolved."""
        if self.camera_model == "auto":
            return "OPENCV" if self.intrinsics is not None else "SIMPLE_RADIAL"
        return self.camera_model
