"""A software renderer: exact visibility, depth and texture coordinates of triangle meshes, by NumPy alone.

All triangles of a mesh are rasterised at once: they are cut into rows, the rows into pixels, and the pixels compete
for the depth buffer. Quantities that are affine on the surface, divided by depth, are affine on the screen, so depth
and texture coordinates are exact at pixel centres (no interpolation beyond rounding).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipeline.geometry import Camera, Floats

NEAR = 0.05
"""Triangles that reach nearer to the camera than this are dropped, and planes are clipped there."""


@dataclass(frozen=True)
class Visible:
    """What is seen at the pixels of an image.

    Attributes:
        face: (H, W) int32, index into the faces that were given, -1 = none.
        nearness: (H, W) float64, what competed for the depth buffer (larger is nearer), 0 where there is no face.
        planes: (F, 3, 3) float64; row k = (A, B, C): the barycentric weight of corner k, divided by depth where the
            projection is a perspective one, is A x + B y + C at pixel position (x, y).
    """

    face: NDArray[np.int32]
    nearness: Floats
    planes: Floats

    def interpolate(
        self, values: Floats, faces: NDArray[np.integer]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
        """Values (V, C) at vertices to rows, columns and values (N, C) at the N pixels that show a face."""
        rows, columns = np.nonzero(self.face >= 0)
        face = self.face[rows, columns]
        seen = np.zeros(len(faces), bool)
        seen[face] = True
        shown, owner = np.flatnonzero(seen), (np.cumsum(seen) - 1)[face]
        # affine functions on the screen of values / depth, for the faces that are seen
        slopes = np.einsum("fki,fkc->cif", self.planes[shown], values[faces[shown]])
        x, y, nearness = columns + 0.5, rows + 0.5, self.nearness[rows, columns]
        found = [(a[owner] * x + b[owner] * y + c[owner]) / nearness for a, b, c in slopes]
        return rows, columns, np.stack(found, axis=1)


def rasterise(
    xy: Floats, nearness: Floats, faces: NDArray[np.integer], width: int, height: int, *, cull: bool = True
) -> Visible:
    """Which triangle is seen at each pixel centre.

    Args:
        xy: (V, 2) pixel positions of the vertices (y down).
        nearness: (V,) 1/z for a perspective projection; <= 0 marks a vertex behind the camera, whose triangles are
            dropped. Must be affine on the screen over each triangle, as 1/z is.
        faces: (F, 3) vertex indices, clockwise on the screen when seen from the front.
        cull: drop triangles that are seen from behind.
    """
    # column by column: NumPy is slow at reducing many short rows
    (x0, y0), (x1, y1), (x2, y2) = (xy[corner].T for corner in faces.T)
    double_area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    keep = (double_area if cull else np.abs(double_area)) > 1e-9
    keep &= _smallest(*nearness[faces.T]) > 0
    left, right, top, bottom = _smallest(x0, x1, x2), _largest(x0, x1, x2), _smallest(y0, y1, y2), _largest(y0, y1, y2)
    keep &= (right > 0.5) & (left < width - 0.5) & (bottom > 0.5) & (top < height - 0.5)
    kept = np.flatnonzero(keep)
    x0, y0, x1, y1, x2, y2, double_area = (values[kept] for values in (x0, y0, x1, y1, x2, y2, double_area))

    # Edge functions A x + B y + C, zero on the edge opposite to corner k and 1 at the corner: barycentric coordinates.
    # C is an antisymmetric product, so two triangles agree to the bit about the edge they share: no cracks.
    A = (y1 - y2, y2 - y0, y0 - y1)
    B = (x2 - x1, x0 - x2, x1 - x0)
    C = (x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0)
    planes = np.zeros((len(faces), 3, 3))
    for k in range(3):
        weight = nearness[faces[kept, k]] / double_area
        planes[kept, k] = np.stack([A[k] * weight, B[k] * weight, C[k] * weight], axis=1)

    first = np.maximum(np.ceil(top[kept] - 0.5), 0).astype(np.intp)
    last = np.minimum(np.floor(bottom[kept] - 0.5), height - 1).astype(np.intp)
    which, row = _runs(first, last)
    start, stop = np.full(len(which), -np.inf), np.full(len(which), np.inf)
    y = row + 0.5
    flip = np.sign(double_area)
    for k in range(3):
        slope = A[k][which]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -(B[k][which] * y + C[k][which]) / slope
        slope *= flip[which]
        np.maximum(start, crossing, out=start, where=slope > 0)
        np.minimum(stop, crossing, out=stop, where=slope < 0)
    first = np.clip(np.ceil(start - 0.5), 0, width).astype(np.intp)
    last = np.clip(np.floor(stop - 0.5), -1, width - 1).astype(np.intp)
    run, column = _runs(first, last)
    index = kept[which]

    a, b, c = planes.sum(1)[index].T
    candidate = a[run] * (column + 0.5) + (b * y + c)[run]
    pixel = (row * width)[run] + column
    buffer = np.zeros(width * height)
    np.maximum.at(buffer, pixel, candidate)
    face = np.full(width * height, -1, dtype=np.int32)
    won = (candidate == buffer[pixel]) & (candidate > 0)
    face[pixel[won]] = index[run[won]]
    return Visible(face.reshape(height, width), buffer.reshape(height, width), planes)


def _smallest(a: Floats, b: Floats, c: Floats) -> Floats:
    return np.minimum(np.minimum(a, b), c)


def _largest(a: Floats, b: Floats, c: Floats) -> Floats:
    return np.maximum(np.maximum(a, b), c)


def project(camera: Camera, points: Floats) -> tuple[Floats, Floats]:
    """World points (V, 3) to pixels (V, 2) and 1/z (V,), which is -1 for what lies nearer than `NEAR`."""
    xy, depth = camera.project(points)
    behind = depth < NEAR
    return np.where(behind[:, None], 0.0, xy), np.where(behind, -1.0, 1 / np.where(behind, 1.0, depth))


@dataclass(frozen=True)
class Panel:
    """A textured flat convex polygon of the surroundings: a wall, the floor.

    Attributes:
        origin: (3,) world position of the texture's top-left corner.
        right, down: (3,) world vectors along one texel to the right and down.
        outline: (K, 3) corners of the polygon.
        texture: (H, W, 3) uint8 RGB; reflected where the polygon is larger.
    """

    origin: Floats
    right: Floats
    down: Floats
    outline: Floats
    texture: NDArray[np.uint8]

    def nearness(self, camera: Camera, x: Floats, y: Floats) -> Floats:
        """1/z of the panel's infinite plane at pixel positions; <= 0 where the ray points away from it."""
        normal = np.cross(self.right, self.down)
        distance = normal @ (self.origin - camera.centre)
        a, b, c = normal @ camera.R.T @ np.linalg.inv(camera.K) / distance
        return a * x + b * y + c

    def draw(self, image: NDArray[np.uint8], camera: Camera) -> None:
        """Paint the panel over `image` (H, W, 3); what lies behind must have been painted before."""
        local = _clip_near(self.outline @ camera.R.T + camera.t)
        if len(local) < 3:
            return
        pixels = local @ camera.K.T
        pixels = pixels[:, :2] / pixels[:, 2:]
        corners = np.clip(pixels, -20_000, 20_000)
        height, width = image.shape[:2]
        x0, y0 = np.maximum(np.floor(corners.min(0)).astype(int), 0)
        x1, y1 = np.minimum(np.ceil(corners.max(0)).astype(int) + 1, (width, height))
        if x0 >= x1 or y0 >= y1:
            return
        # texel index -> pixel index of the window; both kinds of index are half a step from positions
        basis = np.stack([self.right, self.down, self.origin + 0.5 * (self.right + self.down)], axis=1)
        to_pixels = camera.K @ (camera.R @ basis + np.outer(camera.t, (0, 0, 1)))
        shift = np.array([[1, 0, -0.5 - x0], [0, 1, -0.5 - y0], [0, 0, 1.0]])
        size = (int(x1 - x0), int(y1 - y0))
        window = cv2.warpPerspective(
            self.texture, shift @ to_pixels, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
        )
        inside = np.zeros(size[::-1], np.uint8)
        fixed = np.round((corners - 0.5 - (x0, y0)) * 16).astype(np.int32)
        cv2.fillConvexPoly(inside, fixed, 255, shift=4)
        cv2.copyTo(window, inside, image[y0:y1, x0:x1])


def _runs(first: NDArray[np.intp], last: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """All integers of the inclusive ranges, as (index of the range, integer)."""
    count = np.maximum(last - first + 1, 0)
    which = np.repeat(np.arange(len(count)), count)
    start = np.cumsum(count) - count
    return which, np.arange(len(which)) - (start - first)[which]


def _clip_near(polygon: Floats) -> Floats:
    """The part of a polygon (K, 3) in camera coordinates that lies beyond `NEAR` (Sutherland-Hodgman)."""
    kept: list[Floats] = []
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        if a[2] >= NEAR:
            kept.append(a)
        if (a[2] >= NEAR) != (b[2] >= NEAR):
            kept.append(a + (b - a) * (NEAR - a[2]) / (b[2] - a[2]))
    return np.array(kept).reshape(-1, 3)
