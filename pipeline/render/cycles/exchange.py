"""What goes to Blender's process and comes back: numbers in a message, arrays and pictures in files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dope.common.errors import BadInput
from pipeline.render.config import CyclesConfig
from pipeline.render.cycles.exr import read_exr
from pipeline.render.exposure import Exposure, show
from pipeline.render.scene import Picture, Scene, Shot

_SKY = 1e9
"""Blender writes 1e10 where nothing is."""


def scene_message(scene: Scene, exposure: Exposure, config: CyclesConfig, threads: int, file: Path) -> dict[str, Any]:
    """Write the arrays of a scene into `file` (.npz) and return the message that goes with it.

    Raises:
        BadInput: arrays that would crash Blender: indices that point nowhere, numbers that are not finite.
    """
    arrays: dict[str, Any] = {"panorama": scene.light.panorama}
    parts = []
    for i, part in enumerate(scene.model.parts):
        own: dict[str, NDArray[Any] | None] = {
            "vertices": part.vertices,
            "faces": part.faces,
            "normals": part.normals,
            "uv": part.uv,
            "colours": part.colours,
            "texture": part.texture,
        }
        if scene.surface.kind != "own":
            own = {name: own[name] for name in ("vertices", "faces", "normals")}
        arrays |= {f"{i}.{name}": array for name, array in own.items() if array is not None}
        parts.append({"colour": None if part.colour is None else [float(x) for x in part.colour]})
        if len(part.faces) and not 0 <= part.faces.min() <= part.faces.max() < len(part.vertices):
            raise BadInput(f"part {i} has faces of vertices that it does not have")
    ground = None
    if scene.ground is not None:
        ground = {name: float(getattr(scene.ground, name)) for name in ("height", "roughness", "side")}
        arrays["albedo"] = scene.ground.albedo
        if scene.ground.bumps is not None:
            arrays["bumps"] = scene.ground.bumps
    for name, array in arrays.items():
        if not np.isfinite(array).all():
            raise BadInput(f"{name.replace('.', ': ')} has numbers that are not finite")
    np.savez(file, **arrays)
    surface = scene.surface
    return {
        "do": "scene",
        "file": str(file),
        "parts": parts,
        "surface": {
            "kind": surface.kind,
            "colours": [[float(x) for x in colour] for colour in surface.colours],
            "cells": float(surface.cells),
            "roughness": float(surface.roughness),
            "seed": int(surface.seed),
        },
        "ground": ground,
        "light": {"strength": exposure.gain, "turn": float(scene.light.turn)},
        "cycles": {
            "samples": config.samples,
            "denoise": config.denoise,
            "bounces": config.bounces,
            "threads": threads,
        },
        "seed": scene.seed % 2**31,
    }


def shot_message(shot: Shot, file: Path) -> dict[str, Any]:
    """The message that asks for a shot as an EXR file.

    Raises:
        BadInput: the camera is no pinhole.
    """
    camera = shot.camera
    if camera.is_distorted:
        raise BadInput("Blender renders cameras without distortion only")
    return {
        "do": "shot",
        "file": str(file),
        "width": camera.width,
        "height": camera.height,
        "intrinsics": [float(x) for x in (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])],
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "place": [float(x) for x in shot.place],
    }


def read_picture(file: Path, shot: Shot, exposure: Exposure) -> Picture:
    """The picture in an EXR file of Blender's: colours as a camera shows them, mask by object index.

    Depth and index are those of the first sample, which Cycles sends through the pixel's centre.

    Raises:
        ValueError: it is not whole, or not of this shot.
    """
    passes = {name.split(".", 1)[-1]: array for name, array in read_exr(file).items()}
    try:
        red, green, blue = (passes[f"Combined.{channel}"] for channel in "RGB")
        index = next(passes[name] for name in ("IndexOB.X", "Object Index.X") if name in passes)
        depth = next(passes[name] for name in ("Depth.Z", "Depth.V") if name in passes)
    except (KeyError, StopIteration):
        raise ValueError(f"lacks a pass; it has {sorted(passes)}") from None
    if depth.shape != (shot.camera.height, shot.camera.width):
        raise ValueError(f"is {depth.shape[1]}x{depth.shape[0]}")
    image = show(np.stack([red, green, blue], axis=-1), exposure.balance)
    mask = index == 1
    return Picture(image, mask, np.where(depth < _SKY, depth, np.float32(0)))
