"""Contact sheets: tiles in rows on white, a title strip above, a label beside each row. RGB throughout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from dope.common import files
from dope.common.errors import BadInput, UsageError

Image = NDArray[np.uint8]
"""(H, W, 3) RGB."""

INK = (32, 36, 42)
FAINT = (120, 126, 134)
RULE = (222, 225, 229)
MARK = (255, 45, 85)
MARGIN, GAP = 20, 8
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_OVERSAMPLED = 4  # text and markers are drawn larger and shrunk, which smooths OpenCV's strokes


@dataclass(frozen=True)
class Row:
    """A row of a sheet: its label (lines separated by newlines) and its tiles, all of one size."""

    label: str
    tiles: Sequence[Image]


def contact_sheet(rows: Sequence[Row], *, title: str, subtitle: str = "", columns: Sequence[str] = ()) -> Image:
    """Lay out rows of equally many, equally large tiles, with a label above each column."""
    height, width = rows[0].tiles[0].shape[:2]
    n = len(rows[0].tiles)
    label_width = 16 + max(_text_width(line, 0.45) for row in rows for line in row.label.split("\n"))
    head = 64 if subtitle else 44
    column_head = 22 if columns else 0
    heading_width = max(_text_width(title, 0.7), _text_width(subtitle, 0.45))
    sheet_width = max(MARGIN * 2 + label_width + n * width + (n - 1) * GAP, MARGIN * 2 + heading_width)
    sheet_height = head + MARGIN // 2 + column_head + len(rows) * (height + GAP) - GAP + MARGIN
    sheet = np.full((sheet_height, sheet_width, 3), 255, np.uint8)
    put_text(sheet, title, (MARGIN, 32), 0.7, INK)
    put_text(sheet, subtitle, (MARGIN, 54), 0.45, FAINT)
    sheet[head : head + 1, MARGIN:-MARGIN] = RULE
    left, top = MARGIN + label_width, head + MARGIN // 2 + column_head
    for i, text in enumerate(columns):
        put_text(sheet, text, (left + i * (width + GAP), top - 7), 0.42, FAINT)
    for r, row in enumerate(rows):
        y = top + r * (height + GAP)
        lines = row.label.split("\n")
        for i, line in enumerate(lines):
            put_text(sheet, line, (MARGIN, y + height // 2 + 5 + 18 * i - 9 * (len(lines) - 1)), 0.45, INK)
        for i, tile in enumerate(row.tiles):
            x = left + i * (width + GAP)
            sheet[y : y + height, x : x + width] = tile
    return sheet


def put_text(image: Image, text: str, origin: tuple[int, int], scale: float, colour: tuple[int, int, int]) -> None:
    """Write one line of ASCII text, smooth and thin; `origin` is the left end of its baseline. Changes `image`."""
    if not text:
        return
    s = _OVERSAMPLED
    (w, h), below = cv2.getTextSize(text, _FONT, scale * s, s)
    canvas = np.zeros((-(-(h + below + 2 * s) // s) * s, -(-(w + 2 * s) // s) * s), np.uint8)
    cv2.putText(canvas, text, (s, h + s), _FONT, scale * s, 255, s, cv2.LINE_AA)
    alpha = cv2.resize(canvas, (canvas.shape[1] // s, canvas.shape[0] // s), interpolation=cv2.INTER_AREA)
    x, y = origin[0] - 1, origin[1] - round(h / s) - 1
    _blend(image, x, y, alpha.astype(np.float32) / 255, colour)


def put_marker(image: Image, point: tuple[float, float], radius: int = 7) -> Image:
    """A copy with a ring, white outside and red inside, around `point` (x, y), pixel centres at +0.5."""
    s = _OVERSAMPLED
    result = image.copy()
    size = 2 * radius + 7
    left, top = int(np.floor(point[0])) - size // 2, int(np.floor(point[1])) - size // 2
    centre = (round((point[0] - left) * s), round((point[1] - top) * s))
    for r, thickness, colour in (
        (radius, 4.5, (255, 255, 255)),
        (radius, 2.2, MARK),
        (0, 3.4, (255, 255, 255)),
        (0, 2.0, MARK),
    ):
        canvas = np.zeros((size * s, size * s), np.uint8)
        if r:
            cv2.circle(canvas, centre, r * s, 255, round(thickness * s), cv2.LINE_AA)
        else:
            cv2.circle(canvas, centre, round(thickness * s / 2), 255, -1, cv2.LINE_AA)
        alpha = cv2.resize(canvas, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        _blend(result, left, top, alpha, colour)
    return result


def dimmed(photo: Image) -> Image:
    """The photo in light grey: a ground on which colours can be told apart."""
    grey = cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.repeat((168 + 0.3 * grey)[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)


def over(ground: Image, colours: NDArray[np.floating], alpha: NDArray[np.floating]) -> Image:
    """`colours` (H, W, 3) in [0, 1], RGB, over `ground` with opacity `alpha` (H, W) in [0, 1]."""
    a = alpha[..., None]
    mixed = ground.astype(np.float32) * (1 - a) + 255 * colours * a
    return np.rint(mixed).clip(0, 255).astype(np.uint8)


def heat(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Values in [0, 1] to colours (..., 3) in [0, 1], dark blue over green to yellow (viridis)."""
    levels = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    return table[levels].astype(np.float32) / 255


def write_png(path: Path, image: Image) -> None:
    """Write RGB as PNG, whole or not at all."""
    if path.suffix.lower() != ".png":
        raise UsageError("figures are PNG files", where=path, remedy="Give --out a name that ends in .png")
    files.write_bytes(path, as_png(image))


def as_png(image: Image) -> bytes:
    """RGB as the bytes of a PNG file."""
    ok, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    if not ok:
        raise BadInput(f"an image of shape {image.shape} could not be encoded")
    return data.tobytes()


def _text_width(text: str, scale: float) -> int:
    s = _OVERSAMPLED
    return cv2.getTextSize(text, _FONT, scale * s, s)[0][0] // s + 2 if text else 0


def _blend(image: Image, x: int, y: int, alpha: NDArray[np.floating], colour: tuple[int, int, int]) -> None:
    """Paint `colour` with opacity `alpha` at (x, y); what lies outside the image is cut off."""
    height, width = image.shape[:2]
    x0, y0 = max(x, 0), max(y, 0)
    x1, y1 = min(x + alpha.shape[1], width), min(y + alpha.shape[0], height)
    if x0 >= x1 or y0 >= y1:
        return
    a = alpha[y0 - y : y1 - y, x0 - x : x1 - x, None]
    part = image[y0:y1, x0:x1]
    part[:] = np.rint(part * (1 - a) + np.array(colour, np.float32) * a).astype(np.uint8)
