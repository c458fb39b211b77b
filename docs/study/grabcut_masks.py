"""Masks by GrabCut from a loose box around the object: what a segmentation tool gives that has learnt nothing.

    python docs/study/grabcut_masks.py WORK OUT

For every frame of WORK that has an image and a mask, the box of the mask is made larger on each side by 5 to 20% of its
longer side, and two rounds of OpenCV's GrabCut within it give OUT/<sequence>/<frame>.png, which
`dope prep masks --from OUT` imports. Prints how many there are and their IoU with the given masks.
"""

from __future__ import annotations

import argparse
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

ROUNDS = 2
MARGIN = (0.05, 0.2)
"""Of the box's longer side."""
CONTEXT = 0.5
"""Of the same: how much of the image around the box tells what is background."""

Mask = NDArray[np.bool_]


def grabcut(image: NDArray[np.uint8], given: Mask, name: str) -> Mask:
    """The object (H, W) within a loose box around `given`; the whole box where GrabCut finds nothing."""
    found = np.zeros(given.shape, bool)
    if not given.any():
        return found
    ys, xs = np.nonzero(given)
    x0, x1, y0, y1 = xs.min(), xs.max() + 1, ys.min(), ys.max() + 1
    side = max(x1 - x0, y1 - y0)
    margins = np.random.default_rng(zlib.crc32(name.encode())).uniform(*MARGIN, 4) * side + 1
    left, top, right, bottom = (int(margin) for margin in margins)
    height, width = given.shape
    bx0, by0, bx1, by1 = max(0, x0 - left), max(0, y0 - top), min(width, x1 + right), min(height, y1 + bottom)
    context = int(CONTEXT * side) + 8
    cx0, cy0 = max(0, bx0 - context), max(0, by0 - context)
    crop = image[cy0 : min(height, by1 + context), cx0 : min(width, bx1 + context)]
    labels = np.zeros(crop.shape[:2], np.uint8)
    box = (int(bx0 - cx0), int(by0 - cy0), int(bx1 - bx0), int(by1 - by0))
    cv2.setRNGSeed(0)
    try:
        cv2.grabCut(crop, labels, box, np.zeros((1, 65)), np.zeros((1, 65)), ROUNDS, cv2.GC_INIT_WITH_RECT)
    except cv2.error:  # the box is the whole crop, or all of it has one colour
        labels[:] = cv2.GC_BGD
    found[cy0 : cy0 + crop.shape[0], cx0 : cx0 + crop.shape[1]] = np.isin(labels, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if not found.any():
        found[by0:by1, bx0:bx1] = True
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("work", type=Path, help="renders with masks: `dope prep render --out`")
    parser.add_argument("out", type=Path, help="folder for the masks")
    options = parser.parse_args()
    ious = []
    for table in sorted(options.work.glob("*/frames.parquet")):
        sequence = table.parent
        rows: list[dict[str, Any]] = pq.read_table(table).to_pylist()
        for row in rows:
            if not row["image"] or not row["mask"]:
                continue
            image = cv2.imread(str(sequence / row["image"]), cv2.IMREAD_COLOR)
            drawn = cv2.imread(str(sequence / row["mask"]), cv2.IMREAD_GRAYSCALE)
            if image is None or drawn is None:
                raise SystemExit(f"{sequence}: frame {row['frame']} cannot be read")
            given = drawn > 127
            found = grabcut(image.astype(np.uint8, copy=False), given, f"{sequence.name}/{row['frame']}")
            ious.append((given & found).sum() / max(1, (given | found).sum()))
            path = options.out / sequence.name / f"{Path(row['image']).stem}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            if not cv2.imwrite(str(path), found.astype(np.uint8) * 255):
                raise SystemExit(f"{path}: cannot be written")
        print(f"{sequence.name}: {len(ious):,} masks", flush=True)
    if not ious:
        raise SystemExit(f"{options.work}: no sequence with images and masks")
    print(f"{len(ious):,} masks, IoU with the given ones: mean {np.mean(ious):.3f}, median {np.median(ious):.3f}")


if __name__ == "__main__":
    main()
