"""Materials and the world as Blender's shader nodes."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

GREY = 0.6
"""sRGB of parts whose file says nothing of their look."""
COLOURS = "colours"
"""Name of the meshes' attribute with vertex colours (linear)."""


def to_linear(srgb: Any) -> Any:
    """sRGB in [0, 1] to linear (IEC 61966-2-1)."""
    srgb = np.asarray(srgb, np.float64)
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def byte_image(name: str, pixels: Any) -> Any:
    """(H, W, 3) uint8 sRGB, first row at the top, as an image of Blender's."""
    return _image(name, pixels.astype(np.float32) / 255, is_float=False, is_data=False)


def float_image(name: str, pixels: Any) -> Any:
    """(H, W, 3) linear light, first row at the top, as an image of Blender's."""
    return _image(name, pixels.astype(np.float32), is_float=True, is_data=False)


def data_image(name: str, numbers: Any) -> Any:
    """(H, W) numbers that are no colours, first row at the top, as an image of Blender's."""
    return _image(name, numbers[..., None].astype(np.float32), is_float=True, is_data=True)


def _image(name: str, pixels: Any, *, is_float: bool, is_data: bool) -> Any:
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, alpha=False, float_buffer=is_float, is_data=is_data)
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :3] = pixels[::-1]  # Blender counts rows from below
    image.pixels.foreach_set(rgba.ravel())
    image.update()
    return image


class Nodes:
    """Nodes of one material or world."""

    def __init__(self, tree: Any) -> None:
        self.tree = tree
        tree.nodes.clear()

    def add(self, kind: str, inputs: dict[Any, Any] | None = None, **properties: Any) -> Any:
        """A node; each input is a value, or the output of another node."""
        node = self.tree.nodes.new(kind)
        for name, value in properties.items():
            setattr(node, name, value)
        for name, value in (inputs or {}).items():
            if isinstance(value, bpy.types.NodeSocket):
                self.tree.links.new(value, node.inputs[name])
            else:
                node.inputs[name].default_value = value
        return node

    def product(self, factors: list[Any]) -> Any:
        """Output or constant that is the product of colours, outputs or constants."""
        result = factors[0]
        for factor in factors[1:]:
            node = self.add("ShaderNodeVectorMath", {0: result, 1: factor}, operation="MULTIPLY")
            result = node.outputs["Vector"]
        return result


def new_material(name: str) -> tuple[Any, Nodes]:
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    return material, Nodes(material.node_tree)


def principled(nodes: Nodes, base: Any, roughness: float, normal: Any = None) -> None:
    """A Principled BSDF with a base colour (linear (r, g, b), or an output) as the material's surface."""
    inputs = {"Base Color": (*base, 1.0) if isinstance(base, tuple) else base, "Roughness": roughness}
    if normal is not None:
        inputs["Normal"] = normal
    shader = nodes.add("ShaderNodeBsdfPrincipled", inputs)
    nodes.add("ShaderNodeOutputMaterial", {"Surface": shader.outputs["BSDF"]})


def own_material(name: str, part: dict[str, Any], arrays: dict[str, Any], roughness: float) -> Any:
    """A part as its file says it looks: texture times vertex colours times colour, multiplied as linear light."""
    material, nodes = new_material(name)
    factors: list[Any] = []
    if "texture" in arrays and "uv" in arrays:
        image = byte_image(name, arrays["texture"])
        factors.append(nodes.add("ShaderNodeTexImage", image=image).outputs["Color"])
    if "colours" in arrays:
        factors.append(nodes.add("ShaderNodeAttribute", attribute_name=COLOURS).outputs["Color"])
    if part["colour"] is not None:
        factors.append(tuple(to_linear(part["colour"]).tolist()))
    base = nodes.product(factors) if factors else tuple(to_linear([GREY] * 3).tolist())
    principled(nodes, base, roughness)
    return material


def plain_material(colour: list[float], roughness: float) -> Any:
    material, nodes = new_material("plain")
    principled(nodes, tuple(to_linear(colour).tolist()), roughness)
    return material


def voronoi_material(surface: dict[str, Any]) -> Any:
    """Cells in space, each of one colour of the palette: the cell's random number looks it up in a picture."""
    material, nodes = new_material("voronoi")
    offset = np.random.Generator(np.random.PCG64(surface["seed"])).uniform(-50, 50, 3)
    place = nodes.add("ShaderNodeNewGeometry").outputs["Position"]
    place = nodes.add("ShaderNodeVectorMath", {0: place, 1: offset.tolist()}, operation="ADD").outputs["Vector"]
    cells = nodes.add("ShaderNodeTexVoronoi", {"Vector": place, "Scale": surface["cells"], "Randomness": 1.0})
    number = nodes.add("ShaderNodeSeparateColor", {"Color": cells.outputs["Color"]}).outputs["Red"]
    where = nodes.add("ShaderNodeCombineXYZ", {"X": number, "Y": 0.5}).outputs["Vector"]
    palette = np.round(np.asarray(surface["colours"], np.float32)[None] * 255).astype(np.uint8)
    image = byte_image("palette", palette)
    colour = nodes.add(
        "ShaderNodeTexImage", {"Vector": where}, image=image, interpolation="Closest", extension="EXTEND"
    )
    principled(nodes, colour.outputs["Color"], surface["roughness"])
    return material


def ground_material(ground: dict[str, Any], arrays: dict[str, Any]) -> tuple[Any, Any]:
    """The plane's material, and the node whose "Location" moves its picture: in periods, to be set for each shot."""
    material, nodes = new_material("ground")
    position = nodes.add("ShaderNodeNewGeometry").outputs["Position"]
    scale = 1.0 / ground["side"]
    mapping = nodes.add("ShaderNodeMapping", {"Vector": position, "Scale": (scale, scale, 0.0)}, vector_type="POINT")
    albedo = byte_image("albedo", arrays["albedo"])
    colour = nodes.add("ShaderNodeTexImage", {"Vector": mapping.outputs["Vector"]}, image=albedo).outputs["Color"]
    normal = None
    if "bumps" in arrays:
        bumps = data_image("bumps", arrays["bumps"])
        # cubic: between the pixels of a linear one the slope jumps, and facets show
        where = {"Vector": mapping.outputs["Vector"]}
        height = nodes.add("ShaderNodeTexImage", where, image=bumps, interpolation="Cubic").outputs["Color"]
        normal = nodes.add("ShaderNodeBump", {"Height": height, "Distance": 1.0, "Strength": 1.0}).outputs["Normal"]
    principled(nodes, colour, ground["roughness"], normal)
    return material, mapping


def build_world(light: dict[str, Any], panorama: Any) -> None:
    """Light from all around by a panorama.

    Blender looks a direction up at u = 1/2 - atan2(y, x) / (2 pi): the middle column is +x. Turning the panorama
    counter-clockwise is turning the direction back before it is looked up.
    """
    world = bpy.data.worlds.new("world")
    bpy.context.scene.world = world
    world.use_nodes = True
    nodes = Nodes(world.node_tree)
    direction = nodes.add("ShaderNodeTexCoord").outputs["Generated"]
    mapping = nodes.add(
        "ShaderNodeMapping", {"Vector": direction, "Rotation": (0.0, 0.0, -light["turn"])}, vector_type="POINT"
    )
    image = float_image("panorama", panorama)
    sky = nodes.add("ShaderNodeTexEnvironment", {"Vector": mapping.outputs["Vector"]}, image=image)
    inputs = {"Color": sky.outputs["Color"], "Strength": light["strength"]}
    background = nodes.add("ShaderNodeBackground", inputs)
    nodes.add("ShaderNodeOutputWorld", {"Surface": background.outputs["Background"]})
    # the table by which bright places are found: the automatic one takes seconds an object
    world.cycles.sampling_method = "MANUAL"
    world.cycles.sample_map_resolution = 256
