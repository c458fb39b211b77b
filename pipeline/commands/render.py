"""`dope prep render`: meshes, or objects made on the spot, rendered into prepared sequences."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from dope.common.errors import UsageError
from pipeline.commands.options import (
    AsJson,
    ConfigFile,
    Memory,
    NumShards,
    Overwrite,
    RetryFailed,
    ShardIndex,
    Workers,
    any_setting,
    resolve_config,
    run_options,
)

OBJECTS, SCENES, QUALITY = "Which objects", "Scenes", "Renderer"


def render(
    out: Annotated[Path, typer.Option("--out", help="WORK: the folder to write to.", show_default=False)],
    meshes: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="MESHES", help="Meshes, or folders of them: OFF, OBJ, PLY, STL, GLB, glTF.", show_default=False
        ),
    ] = None,
    recipe: Annotated[
        str | None,
        typer.Option(
            help="modelnet, shapenet, abc: the paper's scenes for them; plain: the object alone, in a studio's light; "
            "procedural: objects that are made on the spot.",
            show_default="plain",
            rich_help_panel=SCENES,
        ),
    ] = None,
    renderer: Annotated[
        str | None,
        typer.Option(
            help="fast: a rasteriser; cycles: Blender's path tracer (bpy).",
            show_default="fast",
            rich_help_panel=QUALITY,
        ),
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(min=1, help="How many objects; --recipe procedural.", show_default=False, rich_help_panel=OBJECTS),
    ] = None,
    category: Annotated[
        str | None, typer.Option(help="Label of all objects.", show_default=False, rich_help_panel=OBJECTS)
    ] = None,
    category_from: Annotated[
        str,
        typer.Option(
            help="auto: by the layout (ModelNet, ShapeNet, ABC), or the folder above where a folder of folders "
            "is given; parent: always that folder; none.",
            rich_help_panel=OBJECTS,
        ),
    ] = "auto",
    limit: Annotated[
        int | None,
        typer.Option(min=1, help="At most so many of each category.", show_default="all", rich_help_panel=OBJECTS),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            help="Axis of the files that points up: z, y, x, or auto.", show_default="auto", rich_help_panel=OBJECTS
        ),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(
            help="stable: as it would come to rest; upright: as in the file.",
            show_default="stable",
            rich_help_panel=SCENES,
        ),
    ] = None,
    pairs: Annotated[
        int | None,
        typer.Option(min=1, help="Pairs of views of an object.", show_default="10", rich_help_panel=SCENES),
    ] = None,
    size: Annotated[
        int | None, typer.Option(min=16, help="Side of the images, pixels.", show_default="224", rich_help_panel=SCENES)
    ] = None,
    surface: Annotated[
        str | None,
        typer.Option(
            help="own, grey, random (one colour, or Voronoi cells), or recipe.",
            show_default="recipe",
            rich_help_panel=SCENES,
        ),
    ] = None,
    hdris: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER",
            help="Panoramas (.hdr, .exr) to light with.",
            show_default="procedural",
            rich_help_panel=SCENES,
        ),
    ] = None,
    materials: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER", help="PBR materials of the ground.", show_default="procedural", rich_help_panel=SCENES
        ),
    ] = None,
    supersample: Annotated[
        int | None,
        typer.Option(min=1, help="fast: samples a pixel in each direction.", show_default="2", rich_help_panel=QUALITY),
    ] = None,
    samples: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="cycles: samples a pixel before denoising (the paper: 50).",
            show_default="8",
            rich_help_panel=QUALITY,
        ),
    ] = None,
    bpy_python: Annotated[
        str | None,
        typer.Option(
            metavar="PYTHON",
            help="cycles: the interpreter that has bpy.",
            show_default="this one",
            rich_help_panel=QUALITY,
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Of poses, looks, light and cameras.", show_default="0", rich_help_panel=SCENES)
    ] = None,
    config: ConfigFile = None,
    set_: Annotated[list[str] | None, any_setting("viewpoints.jitter=0.2")] = None,
    workers: Workers = 0,
    minutes: Annotated[float, typer.Option(help="Time limit of one object.", rich_help_panel="Running")] = 10.0,
    memory_gib: Memory = 8.0,
    shard_index: ShardIndex = None,
    num_shards: NumShards = None,
    overwrite: Overwrite = False,
    retry_failed: RetryFailed = False,
    as_json: AsJson = False,
) -> None:
    """Render meshes into prepared sequences: pairs of views with exact masks, depth and cameras.

    Every object is posed, put on a plane, lit from all around and seen by pairs of cameras as in the paper. A mesh that
    cannot be used (empty, not finite, without area, a texture missing ...) is a row with its reason, and so is one that
    crashes the renderer. What comes out depends on the mesh, the settings and the seed alone.

    Examples:

      dope prep render ModelNet40/ --recipe modelnet --out work

      dope prep render ShapeNetCore.v2/ --recipe shapenet --out work --limit 50

      dope prep render meshes/ --recipe abc --surface random --supersample 1 --out work     (fastest)

      dope prep render meshes/ --recipe abc --renderer cycles --bpy-python bpyenv/bin/python --samples 50 --out work

      dope prep render --recipe procedural --count 1000 --out work     (no meshes at hand)

    Then: dope prep correspond work; dope prep shards work --out shards
    """
    from pipeline.console import Display, exit_code, show_rows
    from pipeline.engines import find_share
    from pipeline.inputs.sources import SourceError, input_errors_as_rows, known_sources
    from pipeline.refused import keep_refused
    from pipeline.render.config import RenderConfig
    from pipeline.render.find import find_meshes
    from pipeline.render.prepare import ObjectSource, ProceduralSource, prepare_renders

    flags: dict[str, Any] = {
        "recipe": recipe,
        "renderer": renderer,
        "mesh.up": up,
        "mesh.pose": pose,
        "viewpoints.pairs": pairs,
        "viewpoints.size": size,
        "look.surface": surface,
        "look.hdris": hdris,
        "look.materials": materials,
        "fast.supersample": supersample,
        "cycles.samples": samples,
        "cycles.python": bpy_python,
        "seed": seed,
    }
    resolved: RenderConfig = resolve_config(RenderConfig, config, flags, set_)
    share = find_share(shard_index, num_shards)
    sources: list[ObjectSource]
    errors: list[SourceError] = []
    if resolved.recipe == "procedural":
        if meshes or count is None:
            raise UsageError("--recipe procedural makes its objects itself", remedy="Give --count N, and no MESHES")
        of_meshes = {"--category": category, "--limit": limit}
        of_meshes["--category-from"] = None if category_from == "auto" else category_from
        if given := [flag for flag, value in of_meshes.items() if value is not None]:
            what = f"{', '.join(given)}: of meshes only; procedural objects have no category"
            raise UsageError(what, remedy="Leave it out; --count says how many objects")
        sources = [ProceduralSource(number, resolved.seed) for number in range(count)]
    else:
        if not meshes or count is not None:
            raise UsageError(
                "which meshes?", where="MESHES", remedy="Give files or folders; --count N is for --recipe procedural"
            )
        found, errors = find_meshes(
            meshes, category=category, category_from=category_from, up=resolved.mesh.up, known=known_sources(out)
        )
        sources = list(_limited(found, limit))
    options = run_options(workers, 1, minutes, memory_gib, overwrite, retry_failed)
    mine = share.of(sources)
    with Display(len(mine), "prep render").showing() as display:
        rows = prepare_renders(mine, out, resolved, options, display)
    rows += input_errors_as_rows(errors) if share.index == 0 else []  # told by one part of an array job
    others = {source.id for source in sources} - {source.id for source in mine}
    elsewhere = others | (set() if share.index == 0 else {name for name, _, _ in errors})
    keep_refused(out, rows, elsewhere=elsewhere)
    show_rows(rows, as_json=as_json)
    raise typer.Exit(exit_code(rows))


def _limited(sources: list[Any], limit: int | None) -> list[Any]:
    """The first `limit` of each category."""
    taken: dict[str | None, int] = {}
    kept = []
    for source in sources:
        taken[source.category] = taken.get(source.category, 0) + 1
        if limit is None or taken[source.category] <= limit:
            kept.append(source)
    return kept
