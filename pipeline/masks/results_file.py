"""Results of instance segmentation as JSON, of any size: what is in the file and where, then single instances of it.

Forms that are read, all of them COCO's (https://cocodataset.org/#format-results):

- a list of instances {image_id, category_id, segmentation, score, ...}: detectron2's `coco_instances_results.json`
  (Mask R-CNN, PointRend), FreeSOLO's evaluation;
- a dataset {images, annotations, categories}: FreeSOLO's free masks, and annotations made by people;
- a list of images {image_id, instances: [...]}: detectron2's predictions of an evaluator.

A segmentation is a run-length encoding {size: [height, width], counts} with counts packed in a string or as a list,
or a list of polygons [x1, y1, x2, y2, ...]. An instance says `image_id` or `file_name`; no score counts as 1.

The file is read once as a stream. Of each instance 40 bytes are kept: image, category, score, and its place in the
file; a million instances take 40 MB, whatever the file's size. Segmentations are read again from their places.
"""

from __future__ import annotations

import json
import re
from array import array
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

from dope.common.errors import BadInput
from pipeline.json_stream import read_elements

LARGEST_ELEMENT = 256 << 20
"""Characters of one element of a list; what is larger is no instance."""
LARGEST_SCORE = 1e300
"""JSON's whole numbers can be larger than any float."""
REMEDY = "Write the file again"

ImageKey = int | str


@dataclass(kw_only=True)
class ImageTable:
    """What a file says of images and categories."""

    names: dict[ImageKey, list[str]] = field(default_factory=dict)
    """File names of an image id; more than one where ids are not unique."""
    sizes: dict[ImageKey, tuple[int, int] | None] = field(default_factory=dict)
    """(width, height) of an image, upright or as its pixels lie in the file: what its polygons were drawn on. None
    where sizes contradict each other; no entry where none is given."""
    categories: dict[int, str] = field(default_factory=dict)


@dataclass
class Results(ImageTable):
    """What a file of results holds."""

    path: Path
    image_of: array[int] = field(default_factory=lambda: array("q"))
    """For each instance the number of its image in `images`."""
    category: array[int] = field(default_factory=lambda: array("q"))
    score: array[float] = field(default_factory=lambda: array("d"))
    offset: array[int] = field(default_factory=lambda: array("q"))
    """Where the element that holds the instance starts in the file, in bytes."""
    length: array[int] = field(default_factory=lambda: array("q"))
    nested: array[int] = field(default_factory=lambda: array("i"))
    """The instance's number among the `instances` of that element, or -1 where it is the element."""
    images: dict[ImageKey, int] = field(default_factory=dict)
    """Number of each image by its id or file name."""

    def __len__(self) -> int:
        return len(self.image_of)

    def segmentation(self, file: BinaryIO, instance: int) -> Any:
        """The instance's segmentation as JSON values. `file` is the results file, open for reading bytes."""
        file.seek(self.offset[instance])
        try:
            element = json.loads(file.read(self.length[instance]))
            if self.nested[instance] >= 0:
                element = element["instances"][self.nested[instance]]
            return element["segmentation"]
        except (ValueError, LookupError, TypeError) as error:
            raise BadInput("was changed while it was read", where=self.path, remedy="Run it again") from error


def read_results(path: Path) -> Results:
    """Read through a file of results.

    Raises:
        BadInput: the file is absent, cut off or not JSON, or holds something else; the message says at which element.
    """
    results = Results(path)
    elements = read_elements(path, largest=LARGEST_ELEMENT, remedy=REMEDY, may_be_gzipped=False)
    for key, number, value, offset, length in elements:
        if key == "images":
            _add_image(results, value, path, number)
        elif key == "categories":
            _add_category(results.categories, value)
        elif key in (None, "annotations", "instances"):
            _add_element(results, value, number, offset, length)
    if not len(results):
        what = "holds images, but no instances" if results.names else "holds no instances"
        raise BadInput(what, where=path, remedy="Expected COCO results: a list of {image_id, segmentation, score}")
    return results


def read_image_table(path: Path) -> ImageTable:
    """The images and categories of a COCO dataset file, or of an object {id: file name}.

    Raises:
        BadInput: the file is absent, not JSON, or has no such table.
    """
    table = ImageTable()
    for key, number, value, _, _ in read_elements(path, largest=LARGEST_ELEMENT, remedy=REMEDY):
        if key == "images" or key is None:
            _add_image(table, value, path, number)
        elif key == "categories":
            _add_category(table.categories, value)
        elif isinstance(value, str):
            table.names.setdefault(_as_id(key), []).append(value)
    if not table.names:
        remedy = 'Expected a COCO dataset with `images`, or {"1": "a.jpg", ...}'
        raise BadInput("has no table of images", where=path, remedy=remedy)
    return table


def _add_element(results: Results, value: Any, number: int, offset: int, length: int) -> None:
    if isinstance(value, dict) and isinstance(value.get("instances"), list):
        inherited = {key: value[key] for key in ("image_id", "file_name") if key in value}
        for nested, instance in enumerate(value["instances"]):
            whole = inherited | instance if isinstance(instance, dict) else instance
            _add_instance(results, whole, f"instance {nested} of element {number}", offset, length, nested)
    else:
        _add_instance(results, value, f"element {number}", offset, length, -1)


def _add_instance(results: Results, value: Any, which: str, offset: int, length: int, nested: int) -> None:
    wrong = _what_is_wrong(value)
    if wrong is not None:
        remedy = "Expected COCO results: {image_id, category_id, segmentation, score}"
        raise BadInput(f"{which} {wrong}", where=results.path, remedy=remedy)
    image = _as_id(value.get("image_id", value.get("file_name")))
    if isinstance(value.get("file_name"), str):
        _add_name(results.names, image, value["file_name"])
    results.image_of.append(results.images.setdefault(image, len(results.images)))
    results.category.append(value.get("category_id", 0))
    results.score.append(value.get("score", 1.0))
    results.offset.append(offset)
    results.length.append(length)
    results.nested.append(nested)


def _what_is_wrong(value: Any) -> str | None:
    if not isinstance(value, dict):
        return "is no object"
    image = value.get("image_id", value.get("file_name"))
    score, category = value.get("score", 1.0), value.get("category_id", 0)
    if isinstance(image, bool) or not isinstance(image, (int, str)):
        return "has no image_id"
    if "segmentation" not in value:
        return "has no segmentation"
    if not isinstance(score, (int, float)) or not abs(score) <= LARGEST_SCORE:
        return f"has a score that is no number ({score!r:.40})"
    if not isinstance(category, int) or abs(category) >= 2**62:
        return f"has a category_id that is no whole number ({category!r:.40})"
    return None


def _add_image(table: ImageTable, value: Any, path: Path, number: int) -> None:
    if not isinstance(value, dict) or not isinstance(value.get("file_name"), str):
        raise BadInput(f"image {number} has no id and file_name", where=path)
    if isinstance(value.get("id"), bool) or not isinstance(value.get("id"), (int, str)):
        raise BadInput(f"image {number} has no id that is a number or a text", where=path)
    image = _as_id(value["id"])
    _add_name(table.names, image, value["file_name"])
    width, height = value.get("width"), value.get("height")
    if type(width) is int and type(height) is int and min(width, height) > 0:
        size = width, height
        table.sizes[image] = size if table.sizes.get(image, size) == size else None


def _add_name(names: dict[ImageKey, list[str]], image: ImageKey, name: str) -> None:
    known = names.setdefault(image, [])
    if name not in known:
        known.append(name)


def _add_category(categories: dict[int, str], value: Any) -> None:
    if isinstance(value, dict) and isinstance(value.get("id"), int):
        categories[value["id"]] = str(value.get("name", ""))


def _as_id(text: ImageKey) -> ImageKey:
    """Ids are numbers in one file and the same digits as a text in the next."""
    return int(text) if isinstance(text, str) and re.fullmatch(r"0|[1-9][0-9]{0,17}", text) else text
