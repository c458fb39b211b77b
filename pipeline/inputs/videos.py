"""Videos decoded once from start to end, the sharpest frame of each window kept (OpenCV with its own FFmpeg)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

# FFmpeg writes its own remarks on damaged files to stderr, without the file's name; ours say more.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.inputs.frame_quality import Look, look_at


@dataclass(frozen=True)
class VideoFrame:
    """The sharpest frame of a window; `image` (BGR, upright) and `look` are None where none could be decoded."""

    number: int
    """Position in the video, from 0."""
    time_s: float | None
    image: NDArray[np.uint8] | None
    look: Look | None


class Video:
    """A video file that can be opened. Raises `BadInput` where it cannot."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.decoded = 0
        """Frames that the last pass decoded."""
        capture = self._open()
        announced = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        fps = capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        self.fps = fps if 0 < fps < 100_000 else 0.0
        self.announced = int(announced) if 0 < announced < 1e9 else 0
        """Frames according to the file's header; 0 where it does not say."""

    def sharpest(self, windows: Windows) -> Iterator[VideoFrame]:
        """One pass over the video: the sharpest of the candidates of each window, at full size, in order."""
        capture = self._open()
        self.decoded = 0
        best: VideoFrame | None = None
        best_window = 0
        last_time = -1.0
        try:
            # grab() decodes, retrieve() converts to BGR: only candidates pay for the second
            while capture.grab():
                number = self.decoded
                self.decoded += 1
                window = windows.window_of(number)
                if best is not None and window != best_window:
                    yield best
                    best = None
                best_window = window
                if not windows.is_candidate(number):
                    continue
                time_s = self._time(capture, number, last_time)
                last_time = last_time if time_s is None else time_s
                frame = self._retrieve(capture, number, time_s)
                if best is None or _sharpness(frame) > _sharpness(best):
                    best = frame
            if best is not None:
                yield best
        finally:
            capture.release()

    def count(self) -> int:
        """Decode the whole video to learn how many frames it has."""
        capture = self._open()
        self.decoded = 0
        try:
            while capture.grab():
                self.decoded += 1
        finally:
            capture.release()
        return self.decoded

    def _open(self) -> cv2.VideoCapture:
        if not self.path.is_file():
            raise BadInput("no such file", where=self.path)
        # One thread: what a damaged file decodes to must not depend on threads, and videos run side by side.
        # FFmpeg only: other backends would take some names for patterns of image files.
        settings = [cv2.CAP_PROP_N_THREADS, 1]
        level = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(0)
        try:
            capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG, settings)
        except cv2.error as error:
            raise BadInput(f"cannot be opened ({error.err})", where=self.path) from error
        finally:
            cv2.utils.logging.setLogLevel(level)
        if not capture.isOpened():
            what = "is an empty file" if self.path.stat().st_size == 0 else "is not a video that can be decoded"
            remedy = "It may be cut off before its index, or not be a video; copy it again or convert it to H.264 MP4"
            raise BadInput(what, where=self.path, remedy=remedy)
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 1)  # phones store portrait videos lying, with a rotation
        return capture

    def _time(self, capture: cv2.VideoCapture, number: int, last: float) -> float | None:
        """The frame's own time stamp (frame rates vary in phone videos), or that of a constant rate."""
        time_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
        if np.isfinite(time_s) and time_s > last and (time_s > 0 or number == 0):
            return round(time_s, 6)
        return round(number / self.fps, 6) if self.fps else None

    def _retrieve(self, capture: cv2.VideoCapture, number: int, time_s: float | None) -> VideoFrame:
        try:
            ok, image = capture.retrieve()
        except cv2.error:
            ok, image = False, None
        if not ok or image is None or image.size == 0:
            return VideoFrame(number, time_s, None, None)
        return VideoFrame(number, time_s, image, look_at(image))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Windows:
    """A video's frames in windows of equal length, of each of which one frame is taken.

    Attributes:
        length: frames a window, at least 1; it need not be whole.
        candidates: frames of each window that are looked at, spread over its middle half, so that the frames that
            are taken stay about equally far apart.
    """

    length: float
    candidates: int

    def window_of(self, number: int) -> int:
        return int((number + 1e-6) / self.length)

    def is_candidate(self, number: int) -> bool:
        window = self.window_of(number)
        first = int(np.ceil(window * self.length - 1e-6))
        last = int(np.ceil((window + 1) * self.length - 1e-6)) - 1
        n = last - first + 1
        if n <= self.candidates:
            return True
        centre, quarter = (first + last) / 2, n / 4
        if self.candidates == 1:
            return number == int(centre)
        spots = np.linspace(centre - quarter, centre + quarter, self.candidates)
        return number in {int(spot) for spot in spots}


def _sharpness(frame: VideoFrame) -> float:
    return -1.0 if frame.look is None else frame.look.sharpness
