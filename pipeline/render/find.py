"""Which objects a command line means: mesh files and folders of them, an id for each.

chair.obj                 one object
meshes/*.glb              an object each, without a category
meshes/<category>/*.obj   an object each, with one
ModelNet40/, ShapeNetCore.v1/, ShapeNetCore.v2/, abc/ and folders below them: `pipeline.render.layouts`
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, cast

from dope.common import files
from dope.common.errors import BadInput, UsageError, legible
from pipeline.inputs.photos import natural_order
from pipeline.inputs.sources import SourceError
from pipeline.inputs.unique_ids import name_of, with_unique_ids
from pipeline.render.layouts import known_layout
from pipeline.render.mesh_files.references import references
from pipeline.sequence import sequence_id

MESH_SUFFIXES = (".off", ".obj", ".ply", ".stl", ".glb", ".gltf")
FOREIGN = frozenset({".fbx", ".blend", ".3ds", ".dae", ".step", ".stp", ".iges", ".igs", ".usd", ".usdz", ".x3d",
                     ".max", ".3mf", ".c4d", ".ma", ".mb", ".wrl"})  # fmt: skip
"""Meshes and models that are not read."""
Axis = Literal["z", "y", "x"]


@dataclass(frozen=True)
class RenderSource:
    """One object to be rendered.

    Attributes:
        path: the mesh file.
        id: name of the sequence, unique among the sources of one command.
        category: the class label, or None.
        instance: name of the object.
        up: axis of the file that points up.
        subset: "train" or "test" where the collection says so by its folders, or None.
    """

    path: Path
    id: str
    category: str | None
    instance: str
    up: Axis
    subset: str | None = None

    @property
    def home(self) -> Path:
        """What the sequence is named after: the mesh, or in ShapeNet the model's folder."""
        known = known_layout(self.path)
        return self.path if known is None else known.home


def find_meshes(
    inputs: Iterable[Path],
    *,
    category: str | None = None,
    category_from: str = "auto",
    up: str = "auto",
    known: Mapping[Path, str] | None = None,
) -> tuple[list[RenderSource], list[SourceError]]:
    """The objects that the paths on a command line stand for, and a row for each path that stands for none.

    Args:
        inputs: mesh files and folders; order is kept, folders are read in natural order, with all below them.
        category: label of all.
        category_from: where `category` is None: "auto" takes it from the path in a known layout, else the name of the
            mesh's folder where that is not the given one; "parent" takes the name of the folder above the mesh (the
            model's folder in ShapeNet); "none" none.
        up: "z", "y" or "x"; "auto": y in glTF and ShapeNet, else z.
        known: ids of the sources that WORK holds already (`pipeline.inputs.sources.known_sources`): they keep them.

    Returns:
        Sources with unique ids (parents' names are prefixed where two are the same), and (id, path, error) rows.
    """
    if category_from not in ("auto", "none", "parent"):
        raise UsageError(f"'{category_from}' is not one of auto, none, parent", where="--category-from")
    if up not in ("auto", "z", "y", "x"):
        raise UsageError(f"'{up}' is not one of auto, z, y, x", where="mesh.up")
    found: list[RenderSource] = []
    errors: list[SourceError] = []
    seen: set[Path] = set()
    for given in inputs:
        for path in _meshes_or_error(given, set(), top=True):
            if not isinstance(path, Path):
                errors.append(path)
                continue
            place = path.resolve()
            if place in seen:  # the same mesh given twice is one object
                continue
            seen.add(place)
            if legible(path.absolute()) == str(path.absolute()):
                found.append(_source(path, given, category, category_from, up))
            else:
                unwritable = BadInput("its name is not UTF-8", where=path, remedy="Rename it")
                errors.append((sequence_id(legible(path.stem)), path, unwritable))
    named = with_unique_ids(found, known or {})
    plain = (source if source.instance else replace(source, instance=source.id) for source in named)
    return list(plain), errors


def mesh_fingerprint(source: RenderSource) -> dict[str, Any]:
    """Identifies what rendering reads of a source, by sizes and SHA-256; JSON values.

    That is the mesh and the files that it names: materials, textures, buffers. One that is absent, or may not be read,
    has null. It does not depend on where the source lies. Raises `BadInput` where the mesh cannot be read.
    """
    try:
        read = {legible(source.path.name): _content(source.path)}
        for name, path in references(source.path):
            try:
                read[legible(name)] = _content(path) if path is not None and path.is_file() else None
            except OSError:
                read[legible(name)] = None
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=error.filename or source.path) from error
    value = {"id": source.id, "category": source.category, "instance": source.instance, "up": source.up, "files": read}
    return value if source.subset is None else {**value, "subset": source.subset}


def _content(path: Path) -> str | None:
    return f"{path.stat().st_size}:{files.sha256_of(path)}"


def _source(path: Path, given: Path, category: str | None, category_from: str, up: str) -> RenderSource:
    known = known_layout(path)
    axis = up
    if up == "auto":
        axis = known.up if known is not None else "y" if path.suffix.lower() in (".glb", ".gltf") else "z"
    if category is None and category_from == "auto":
        if known is not None:
            category = known.category
        elif given.is_dir() and path.absolute().parent != given.absolute():
            category = path.absolute().parent.name or None
    elif category is None and category_from == "parent":
        category = (known.home if known is not None else path.absolute()).parent.name or None
    name, instance, subset = name_of(path), "", None
    if known is not None:
        name, instance, subset = sequence_id(known.name), known.instance, known.subset
    return RenderSource(path, name, category, instance, cast("Axis", axis), subset)


def _meshes_or_error(path: Path, above: set[Path], *, top: bool) -> Iterator[Path | SourceError]:
    """The meshes at or below `path`, and a row where it cannot be used: never a reason to leave out its neighbours."""
    try:
        yield from _expand(path, above, top=top)
    except BadInput as error:
        yield sequence_id(legible(name_of(path))), path, error
    except OSError as error:
        unreadable = BadInput(f"cannot be read ({error.strerror})", where=error.filename or path)
        yield sequence_id(legible(name_of(path))), path, unreadable


def _expand(path: Path, above: set[Path], *, top: bool) -> Iterator[Path | SourceError]:
    """The meshes at or below `path`.

    Raises:
        BadInput: it cannot be used. That it holds no mesh is one only where the user named it, or where it holds models
            of a kind that is not read.
    """
    suffixes = ", ".join(suffix[1:] for suffix in MESH_SUFFIXES)
    if not path.exists():
        raise BadInput("no such file or folder", where=path, remedy="Check how it is spelt")
    if not path.is_dir():
        if path.suffix.lower() not in MESH_SUFFIXES or not path.is_file():
            raise BadInput(
                "is no mesh that can be read", where=path, remedy=f"Give {suffixes} files or folders of them"
            )
        yield path
        return
    if (path / "sequence.json").is_file():  # WORK lies among the inputs: what was made of them is none of them
        if top:
            raise BadInput("is a prepared sequence", where=path, remedy="Give the mesh that it was made of")
        return
    entries = sorted((p for p in path.iterdir() if not p.name.startswith(".")), key=natural_order)
    any_mesh, place = False, path.resolve()
    for entry in entries:
        if entry.suffix.lower() in MESH_SUFFIXES and not entry.is_dir():
            any_mesh = True
            if entry.is_file():
                yield entry
            else:
                what = "is a link to nothing" if entry.is_symlink() else "is no regular file"
                error = BadInput(what, where=entry, remedy="Put the mesh there, or remove it")
                yield sequence_id(legible(name_of(entry))), entry, error
    if place not in above:  # a link to a folder above would never end
        for entry in entries:
            if entry.is_dir():
                for mesh in _meshes_or_error(entry, above | {place}, top=False):
                    any_mesh = True
                    yield mesh
    foreign = sorted({entry.suffix.lower() for entry in entries} & FOREIGN)
    if not any_mesh and (top or foreign):
        remedy = f"Convert {', '.join(foreign)} files to GLB first" if foreign else f"Meshes are {suffixes} files"
        raise BadInput("holds no meshes" if entries else "is an empty folder", where=path, remedy=remedy)
