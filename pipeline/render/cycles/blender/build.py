"""A scene as Blender's objects, and one call of Cycles for each shot."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
import shading

GROUND_REACH = 4096.0
"""Half the side of the plane: its edge lies 0.02 px below the true horizon for a camera one unit above it."""
GROUND_GAP = 1e-5
"""The plane lies this much lower than it is said to, so that what lies flat on it is seen; 0.002 px."""

FILTER_PX = 1.5
"""Width of the pixels' filter (Blackman-Harris)."""
FIRST_SAMPLE_PX = 5.26e-4
"""The first sample, which gives mask and depth, is meant for the pixel's centre and lies this much right and up of it:
Cycles reads its place from a table of the filter. Measured (Blender 4.5.15); with it depth is exact to 2e-6."""


def build(message: dict[str, Any], arrays: dict[str, Any]) -> Any:
    """Make everything but the camera's place anew; returns what `place_shot` needs.

    Args:
        message: the scene's numbers (`exchange.scene_message`).
        arrays: its arrays; those of part i are "i.vertices", "i.faces", ...
    """
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    surface = message["surface"]
    shared = None
    if surface["kind"] == "voronoi":
        shared = shading.voronoi_material(surface)
    elif surface["kind"] == "colour":
        shared = shading.plain_material(surface["colours"][0], surface["roughness"])
    for i, part in enumerate(message["parts"]):
        prefix = f"{i}."
        own = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        material = shared or shading.own_material(f"part{i}", part, own, surface["roughness"])
        add_object(f"part{i}", part_mesh(f"part{i}", own), material, pass_index=1)
    mapping = None
    if message["ground"] is not None:
        material, mapping = shading.ground_material(message["ground"], arrays)
        add_object("ground", ground_mesh(message["ground"]["height"] - GROUND_GAP), material, pass_index=2)
    shading.build_world(message["light"], arrays["panorama"])
    camera = bpy.data.cameras.new("camera")
    scene.camera = bpy.data.objects.new("camera", camera)
    scene.collection.objects.link(scene.camera)
    set_up_cycles(scene, message["cycles"], message["seed"])
    side = None if message["ground"] is None else message["ground"]["side"]
    return mapping, side


def add_object(name: str, mesh: Any, material: Any, pass_index: int) -> None:
    mesh.materials.append(material)
    thing = bpy.data.objects.new(name, mesh)
    thing.pass_index = pass_index
    bpy.context.scene.collection.objects.link(thing)


def triangle_mesh(name: str, vertices: Any, faces: Any) -> Any:
    """A mesh of vertices (V, 3) and triangles (F, 3)."""
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(len(vertices))
    mesh.vertices.foreach_set("co", np.ascontiguousarray(vertices, np.float32).ravel())
    mesh.loops.add(faces.size)
    mesh.loops.foreach_set("vertex_index", np.ascontiguousarray(faces, np.int32).ravel())
    mesh.polygons.add(len(faces))
    mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
    return mesh


def part_mesh(name: str, arrays: dict[str, Any]) -> Any:
    """Triangles with what the file gives for their vertices."""
    faces = arrays["faces"]
    if "normals" in arrays:
        faces = wound_by_normals(arrays["vertices"], faces, arrays["normals"])
    mesh = triangle_mesh(name, arrays["vertices"], faces)
    if "uv" in arrays:
        layer = mesh.uv_layers.new(name="uv")
        layer.uv.foreach_set("vector", np.ascontiguousarray(arrays["uv"][faces.ravel()], np.float32).ravel())
    if "colours" in arrays:
        rgba = np.ones((len(arrays["colours"]), 4), np.float32)
        rgba[:, :3] = shading.to_linear(arrays["colours"])
        mesh.attributes.new(shading.COLOURS, "FLOAT_COLOR", "POINT").data.foreach_set("color", rgba.ravel())
    smooth = "normals" in arrays
    mesh.polygons.foreach_set("use_smooth", np.full(len(faces), smooth))
    mesh.update(calc_edges=True)
    if smooth:
        mesh.normals_split_custom_set(corner_normals(arrays["vertices"], faces, arrays["normals"]))
    return mesh


def wound_by_normals(vertices: Any, faces: Any, normals: Any) -> Any:
    """Faces (F, 3), turned over where most of their corners' normals look to their back: Blender shades neighbours
    that are wound against each other black where they share a normal."""
    corners = vertices[faces]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("fi,fi->f", normals[faces].sum(axis=1), outwards) < 0
    return np.where(inwards[:, None], faces[:, ::-1], faces)


def corner_normals(vertices: Any, faces: Any, normals: Any) -> Any:
    """(3F, 3) normals of the faces' corners, on the side that the face itself turns outwards: against it a surface
    would be black."""
    corners = vertices[faces]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    own = normals[faces]
    inwards = np.einsum("fci,fi->fc", own, outwards) < 0
    return np.where(inwards[..., None], -own, own).reshape(-1, 3).astype(np.float32)


def ground_mesh(height: float) -> Any:
    """A square out to the horizon, of rings that double in size: near the object its triangles are small, so that
    points on them are as exact as the object's."""
    reach = 2.0 ** np.arange(1, np.log2(GROUND_REACH) + 1)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    flat = (reach[:, None, None] * corners).reshape(-1, 2)
    vertices = np.column_stack([flat, np.full(len(flat), height)])
    quads = [(0, 1, 2, 3)]
    for ring in range(len(reach) - 1):
        inner, outer = 4 * ring, 4 * ring + 4
        for side in range(4):
            after = (side + 1) % 4
            quads.append((outer + side, outer + after, inner + after, inner + side))
    faces = np.array([triangle for a, b, c, d in quads for triangle in ((a, b, c), (a, c, d))])
    mesh = triangle_mesh("ground", vertices, faces)
    mesh.polygons.foreach_set("use_smooth", np.zeros(len(faces), bool))
    mesh.update(calc_edges=True)
    return mesh


def set_up_cycles(scene: Any, settings: dict[str, Any], seed: int) -> None:
    """Cycles on the CPU; all that a shot gives lies in one EXR file without compression."""
    render, cycles = scene.render, scene.cycles
    render.engine = "CYCLES"
    render.use_persistent_data = True
    render.threads_mode, render.threads = "FIXED", settings["threads"]
    render.use_compositing = render.use_sequencer = render.film_transparent = False
    cycles.device = "CPU"
    cycles.samples, cycles.seed = settings["samples"], seed
    cycles.pixel_filter_type, cycles.filter_width = "BLACKMAN_HARRIS", FILTER_PX
    cycles.use_adaptive_sampling = cycles.use_auto_tile = False
    cycles.max_bounces = settings["bounces"]
    cycles.diffuse_bounces = cycles.glossy_bounces = cycles.transmission_bounces = settings["bounces"]
    cycles.caustics_reflective = cycles.caustics_refractive = False
    cycles.use_denoising = settings["denoise"]
    if settings["denoise"]:
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.denoising_prefilter, cycles.denoising_quality = "FAST", "HIGH"
        cycles.denoising_use_gpu = False
    layer = bpy.context.view_layer
    layer.use_pass_z = layer.use_pass_object_index = True
    picture = render.image_settings
    if hasattr(picture, "media_type"):  # Blender 5
        picture.media_type = "MULTI_LAYER_IMAGE"
        picture.use_exr_interleave = True
    picture.file_format, picture.color_depth, picture.exr_codec = "OPEN_EXR_MULTILAYER", "32", "NONE"
    render.use_file_extension = render.use_overwrite = True


def place_shot(scene: Any, shot: dict[str, Any], ground: Any) -> None:
    """Put camera and ground where the shot has them.

    Pinhole of K with the horizontal field fitted: lens = fx * sensor / W; shifts are in units of the width W, with
    x to the right and y up: shift_x = 1/2 - cx / W, shift_y = (cy - H/2) / W * fx / fy; fx / fy is the pixels' aspect.
    cam_to_world = inverse([R t; 0 1]) diag(1, -1, -1, 1): Blender's cameras look along -z with y up.
    """
    import mathutils

    (fx, fy, cx, cy), width, height = shot["intrinsics"], shot["width"], shot["height"]
    cx, cy = cx + FIRST_SAMPLE_PX, cy - FIRST_SAMPLE_PX
    render, camera = scene.render, scene.camera.data
    render.resolution_x, render.resolution_y, render.resolution_percentage = width, height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
    camera.sensor_fit, camera.sensor_width = "HORIZONTAL", 36.0
    camera.lens = fx * 36.0 / width
    camera.shift_x, camera.shift_y = 0.5 - cx / width, (cy - height / 2) / width * (fx / fy)
    camera.clip_start, camera.clip_end = 1e-3, 1e6
    rotation, t = np.array(shot["R"]), np.array(shot["t"])
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * (1, -1, -1)
    pose[:3, 3] = -rotation.T @ t
    scene.camera.matrix_world = mathutils.Matrix(pose.tolist())
    mapping, side = ground
    if mapping is not None:  # less whole periods, since float32 is coarse far out
        x, y = (float(np.mod(place / side, 1.0)) for place in shot["place"])
        mapping.inputs["Location"].default_value = (x, y, 0.0)


def render_shot(scene: Any, path: str) -> None:
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)
