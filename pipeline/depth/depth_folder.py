"""A folder of depth maps made by other tools: which file belongs to which frame, and each brought to one form."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Literal

import numpy as np

from dope.common.errors import BadInput
from pipeline.depth.depth_filter import sample_pixels
from pipeline.depth.mvs import DepthConfig, working_size
from pipeline.depth.readers import READERS, read_depth_file
from pipeline.depth.resample import distortion_px, redistorted, reduced
from pipeline.depth.stereo import Depth, pixel_rays
from pipeline.geometry import Camera
from pipeline.inputs.photos import natural_order, read_orientation, turn_upright
from pipeline.sequence import Frame, Sequence

NEGLIGIBLE_PX = 0.5  # lens distortion that moves no pixel of a depth map farther than this
TELLING_FRAMES = 8  # frames whose sparse points tell how the files of a folder lie
CLEARLY = 0.7  # the median error of the right way is less than this share of the other's
AFFIX = re.compile(r"^depth[_-]|[_.-](depth|geometric|photometric)$", re.IGNORECASE)


class FolderDepths:
    """Depth maps of a folder, one file a frame.

    A file belongs to a photo `IMG_1.jpg` as `IMG_1.png`, `IMG_1.jpg.png`, `IMG_1_depth.exr` or COLMAP's
    `IMG_1.jpg.geometric.bin`, and to a video's frame by the last number in its name, the frame's number from 0. They
    are upright, or lie as the photos' pixels do before the EXIF orientation is applied: where the shape does not tell
    (half a turn, mirrored, square), the way that agrees with the sparse points is taken for all files. COLMAP's arrays
    belong to undistorted images: in their workspace (stereo/depth_maps beside sparse/) they are distorted again as its
    model says, elsewhere they are refused where the photos' distortion makes a difference. Of several files for one
    frame, the first of COLMAP's geometric, EXR, NPY, NPZ, TIFF, PNG, COLMAP's photometric is taken.

    Raises:
        BadInput: no such folder, or no file belongs to any frame.
    """

    def __init__(self, sequence: Sequence, folder: Path, config: DepthConfig) -> None:
        self.folder, self._config, self._long_side = folder, config.imported, config.long_side
        self._sequence, self._min_track = sequence, config.min_track
        self._as_stored: bool | None = None
        self.unit: Literal["cameras", "unknown", "auto"] = config.imported.unit
        info = sequence.read_info()
        self._photos = Path(info.source)
        self._by_number = info.kind == "video"
        self._frames = [frame for frame in sequence.read_frames() if frame.registered and frame.image]
        self._paths = match_depth_files(self._frames, folder, by_number=self._by_number)
        self._workspace: dict[int, Camera] | None = None
        self.whole_numbers = False
        """Whether a file that was read counts steps whose length it does not tell (16-bit PNG)."""

    def read(self, frame: Frame) -> Depth | None:
        path = self._paths.get(frame.frame)
        if path is None:
            return None
        raw = read_depth_file(path)
        self.whole_numbers |= raw.whole_numbers
        if path.suffix.lower() == ".bin" and frame.frame in (pinholes := self._pinholes()):
            size = working_size(frame, self._long_side)
            return redistorted(raw.values, pinholes[frame.frame], frame.camera.resized(*size))
        depth = self._upright(raw.values, frame)
        if not has_shape_of(depth, frame):
            height, width = depth.shape
            raise BadInput(
                f"depth is {width}x{height}, '{frame.source_name}' is {frame.source_width}x{frame.source_height}",
                where=path,
                remedy="A depth map shows the whole image: its size has the same shape",
            )
        depth = reduced(depth, self._long_side)
        camera = frame.camera.resized(depth.shape[1], depth.shape[0])
        if path.suffix.lower() == ".bin" and (moved := distortion_px(camera)) > NEGLIGIBLE_PX:
            raise BadInput(
                f"belongs to an undistorted image, which differs from '{frame.source_name}' by up to {moved:.1f} px",
                where=path,
                remedy="Leave it in its workspace beside sparse/, or give the workspace's images/ as the input",
            )
        return depth / np.linalg.norm(pixel_rays(camera), axis=2) if self._config.kind == "ray" else depth

    def _pinholes(self) -> dict[int, Camera]:
        """The undistorted cameras of the COLMAP workspace that the folder (stereo/depth_maps) lies in, by frame."""
        if self._workspace is None:
            from pipeline.cameras.naming import match_names
            from pipeline.cameras.readers import read_known_cameras

            self._workspace = {}
            model = self.folder.absolute().parent.parent / "sparse"
            if self.folder.absolute().parent.name == "stereo" and model.is_dir():
                known = read_known_cameras(model)
                names = match_names(
                    known.cameras, self._frames, by_number=self._by_number, folder=self._photos, where=known.where
                )
                cameras = {number: known.cameras[name] for number, name in names.items()}
                self._workspace = {number: camera for number, camera in cameras.items() if not camera.is_distorted}
        return self._workspace

    def _upright(self, depth: Depth, frame: Frame) -> Depth:
        height, width = depth.shape
        orientation = self._orientation(frame)
        if orientation == 1:
            return depth
        if orientation >= 5 and height != width:  # sides change places, which the shape shows
            same = (width > height) == (frame.width > frame.height)
            return depth if same else turn_upright(depth, orientation)
        if self._as_stored is None:
            self._as_stored = self._lie_as_stored()
        return turn_upright(depth, orientation) if self._as_stored else depth

    def _orientation(self, frame: Frame) -> int:
        """Of a photo's EXIF; 1 where it is no JPEG, or is not there any more."""
        photo = self._photos / frame.source_name
        return read_orientation(photo)

    def _lie_as_stored(self) -> bool:
        """Whether the files lie as the photos' pixels do, by the depth of sparse points read from them either way.

        Raises:
            BadInput: the points do not tell, since there are too few or both ways fit them alike.
        """
        from pipeline.cameras import colmap

        tracks = colmap.read_points(self._sequence).longer_than(self._min_track)
        upright, turned = [np.zeros(0)], [np.zeros(0)]
        read = 0
        for frame in self._frames:
            path, orientation = self._paths.get(frame.frame), self._orientation(frame)
            if path is None or orientation == 1 or read == TELLING_FRAMES:
                continue
            try:
                depth = read_depth_file(path).values
            except BadInput:  # told when its turn comes
                continue
            other = turn_upright(depth, orientation)
            if other.shape != depth.shape:
                continue
            read += 1
            pixels, z = frame.camera.resized(depth.shape[1], depth.shape[0]).project(tracks.seen_by(frame.frame))
            seen = np.stack([sample_pixels(values, pixels) for values in (depth, other)])
            both = (np.isfinite(seen) & (seen > 0)).all(axis=0) & (z > 0)
            if both.any():
                ratios = np.log(seen[:, both] / z[both])
                off = np.abs(ratios - np.median(ratios, axis=1, keepdims=True))
                upright.append(off[0])
                turned.append(off[1])
        errors = [np.concatenate(parts) for parts in (upright, turned)]
        if len(errors[0]) >= self._config.min_points:
            as_upright, as_stored = (float(np.median(error)) for error in errors)
            if min(as_upright, as_stored) < CLEARLY * max(as_upright, as_stored):
                return as_stored < as_upright
        raise BadInput(
            f"{len(errors[0])} sparse points do not tell whether the depth maps are turned by the photos' EXIF",
            where=self.folder,
            remedy="Turn photos and depth maps upright, and remove the orientation from the photos' EXIF",
        )


def match_depth_files(frames: list[Frame], folder: Path, *, by_number: bool) -> dict[int, Path]:
    """Depth files of frames, by frame index, see `FolderDepths`."""
    if not folder.is_dir():
        raise BadInput("no such folder of depth maps", where=folder)
    files = [path for path in folder.iterdir() if path.suffix.lower() in READERS and not path.name.startswith(".")]
    named: dict[str, Path] = {}
    for path in sorted((path for path in files if path.is_file()), key=lambda p: (_rank(p), natural_order(p))):
        named.setdefault(path.stem, path)
        named.setdefault(AFFIX.sub("", path.stem), path)
    if by_number:
        numbered: dict[int, Path] = {}
        for stem, path in named.items():
            if digits := re.findall(r"\d+", stem):
                numbered.setdefault(int(digits[-1]), path)
        found = {f.frame: numbered[int(f.source_name)] for f in frames if int(f.source_name) in numbered}
    else:
        found = {}
        for frame in frames:
            keys = (frame.source_name, Path(frame.source_name).stem)
            if paths := [named[key] for key in keys if key in named]:
                found[frame.frame] = min(paths, key=_rank)
    if not found:
        names = ", ".join(frame.source_name for frame in frames[:3])
        how = "the frame's number from 0, e.g. 000012.png" if by_number else "the photo's name, e.g. IMG_1.png"
        what = f"no depth map belongs to any frame ({names} ...)" if files else f"holds no {', '.join(READERS)} files"
        raise BadInput(what, where=folder, remedy=f"A depth map's name is {how}")
    return found


def _rank(path: Path) -> int:
    order = (".bin", ".exr", ".npy", ".npz", ".tiff", ".tif", ".png")
    return len(order) if path.name.endswith(".photometric.bin") else order.index(path.suffix.lower())


def has_shape_of(depth: Depth, frame: Frame) -> bool:
    """Whether a depth map shows a frame's whole image: the same ratio of width to height, up to a pixel."""
    height, width = depth.shape
    shapes = ((frame.source_width or frame.width, frame.source_height or frame.height), (frame.width, frame.height))
    return any(abs(width - height * w / h) <= 1 or abs(height - width * h / w) <= 1 for w, h in shapes)
