"""What the paths of well-known collections of meshes say: category, object, subset and the axis that points up.

ModelNet40    <category>/{train,test}/<category>_0001.off
ShapeNetCore  v1: <synset>/<model>/model.obj; v2: <synset>/<model>/models/model_normalized.obj
ABC           00000002/00000002_<hash>_trimesh_000.obj
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

SYNSETS = {
    "02691156": "airplane", "02747177": "ashcan", "02773838": "bag", "02801938": "basket", "02808440": "bathtub",
    "02818832": "bed", "02828884": "bench", "02843684": "birdhouse", "02871439": "bookshelf", "02876657": "bottle",
    "02880940": "bowl", "02924116": "bus", "02933112": "cabinet", "02942699": "camera", "02946921": "can",
    "02954340": "cap", "02958343": "car", "02992529": "cellular", "03001627": "chair", "03046257": "clock",
    "03085013": "keyboard", "03207941": "dishwasher", "03211117": "display", "03261776": "earphone",
    "03325088": "faucet", "03337140": "file", "03467517": "guitar", "03513137": "helmet", "03593526": "jar",
    "03624134": "knife", "03636649": "lamp", "03642806": "laptop", "03691459": "loudspeaker", "03710193": "mailbox",
    "03759954": "microphone", "03761084": "microwave", "03790512": "motorcycle", "03797390": "mug",
    "03928116": "piano", "03938244": "pillow", "03948459": "pistol", "03991062": "pot", "04004475": "printer",
    "04074963": "remote", "04090263": "rifle", "04099429": "rocket", "04225987": "skateboard", "04256520": "sofa",
    "04330267": "stove", "04379243": "table", "04401088": "telephone", "04460130": "tower", "04468005": "train",
    "04530566": "vessel", "04554684": "washer",
}  # fmt: skip
"""The 55 WordNet synsets of ShapeNetCore, by the names that the splits of ShapeNet55-LS have."""

ABC = re.compile(r"(\d{8})_[0-9a-fA-F]+_trimesh_\d+")


@dataclass(frozen=True)
class Known:
    """What a path of a well-known layout says.

    Attributes:
        name: of the sequence.
        category: the label, or None where the collection has none.
        instance: name of the object.
        home: the folder or file that is the object's own.
        up: axis that points up.
        subset: "train" or "test" where the collection is split by folders.
    """

    name: str
    category: str | None
    instance: str
    home: Path
    up: str = "z"
    subset: str | None = None


def known_layout(path: Path) -> Known | None:
    """What the path of a mesh says, or None where it is of no layout that is known."""
    path = path.absolute()
    folder = path.parent
    above = folder.parent
    if path.suffix.lower() == ".off" and folder.name in ("train", "test"):
        if re.fullmatch(re.escape(above.name) + r"_\d+", path.stem):
            return Known(path.stem, above.name, path.stem, path, subset=folder.name)
    elif path.stem == "model_normalized" and folder.name == "models" and re.fullmatch(r"\d{8}", above.parent.name):
        return _shapenet(above)
    elif path.stem == "model" and above.name in SYNSETS:
        return _shapenet(folder)
    elif (match := ABC.fullmatch(path.stem)) and folder.name == match[1]:
        return Known(match[1], None, match[1], path)
    return None


def _shapenet(model: Path) -> Known:
    synset = model.parent.name  # in the name, too: some models are listed under several
    return Known(f"{synset}_{model.name}", SYNSETS.get(synset, synset), model.name, model, up="y")
