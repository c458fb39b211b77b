"""Every setting of `dope prep render`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from dope.common import settings
from dope.common.errors import UsageError

Recipe = Literal["modelnet", "shapenet", "abc", "plain", "procedural"]


def _require_between(config: Any, **limits: tuple[float, float]) -> None:
    """Refuse numbers, and pairs of them, that do not lie between their limits, or whose first is the greater."""
    for name, (low, high) in limits.items():
        value = getattr(config, name)
        ends = value if isinstance(value, tuple) else (value, value)
        if not low <= ends[0] <= ends[1] <= high:  # neither if one is no number
            order = ", the lesser first" if isinstance(value, tuple) else ""
            raise UsageError(f"{name} must be between {low:g} and {high:g}{order}, not {value}", where="settings")


@dataclass(frozen=True)
class ViewpointsConfig:
    """Where the cameras are: pairs of views (0, 1), (2, 3), ... as in the paper's renders (supplement)."""

    pairs: int = 10
    """Pairs of views of an object."""
    size: int = 224
    """Side of the square images in pixels."""
    lens_mm: float = 30.0
    """Focal length; with the sensor's 36 mm f = 186.67 px at 224 px."""
    sensor_mm: float = 36.0
    """Width of the sensor."""
    second_azimuth_deg: float = 90.0
    """The second view of a pair is turned by up to this to either side of the first."""
    zenith_deg: tuple[float, float] = (10.0, 80.0)
    """Angle between the direction to the camera and the vertical."""
    distance: tuple[float, float] = (1.75, 4.0)
    """From the object's middle, in units of twice its largest coordinate."""
    jitter: float = 0.5
    """The camera looks at a place up to this far from the object's middle, along each axis."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, pairs=1, size=16)
        _require_between(self, lens_mm=(1, 1000), sensor_mm=(1, 1000), second_azimuth_deg=(0, 180), jitter=(0, 10))
        _require_between(self, zenith_deg=(0.1, 179.9), distance=(0.9, 100))  # half the diagonal of a cube: 0.87


@dataclass(frozen=True)
class LookConfig:
    """How objects, ground and light look."""

    surface: Literal["recipe", "own", "grey", "random"] = "recipe"
    """"own": textures and colours of the file, grey where it has none; "grey": one grey; "random": the paper's for ABC:
    half one colour, a quarter each Voronoi cells of many hues or of one; "recipe": what the recipe says."""
    ground: Literal["recipe", "on", "off"] = "recipe"
    """Whether objects stand on a plane."""
    places: float = 10.0
    """Each pair of views finds the object somewhere else on the plane, up to this far along either axis."""
    strength: tuple[float, float] = (0.4, 0.9)
    """Of the light, drawn for each object."""
    hdris: str | None = None
    """Folder of panoramas (.hdr, .exr) to light with; None: procedural skies and studios."""
    materials: str | None = None
    """Folder of materials for the plane (a picture each, or a folder each with albedo, height and roughness); None:
    procedural ones."""

    def __post_init__(self) -> None:
        _require_between(self, places=(0, 1000), strength=(0.01, 100))


@dataclass(frozen=True)
class FastConfig:
    """The rasteriser."""

    supersample: int = 2
    """Samples a pixel in each direction; 1 is two to three times as fast, with jagged edges."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, supersample=1)


@dataclass(frozen=True)
class CyclesConfig:
    """Blender's path tracer."""

    samples: int = 8
    """Samples a pixel before denoising (the paper: 50)."""
    denoise: bool = True
    """OpenImageDenoise."""
    bounces: int = 4
    """Most bounces of a path."""
    python: str | None = None
    """Python interpreter whose environment has bpy; None: $DOPE_BPY_PYTHON, else this one."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, samples=1, bounces=0)


@dataclass(frozen=True)
class MeshConfig:
    """What is refused, and how objects are put."""

    max_faces: int = 1_000_000
    """Meshes with more are refused."""
    up: Literal["auto", "z", "y", "x"] = "auto"
    """The axis of the file that points up; "auto": y in glTF and ShapeNet, z elsewhere."""
    pose: Literal["stable", "upright"] = "stable"
    """"stable": as it would come to rest on the plane, drawn by how probable that is; "upright": as in the file."""
    min_mask_share: float = 0.002
    """Pairs of which a view shows less of the object are dropped."""

    def __post_init__(self) -> None:
        settings.require_at_least(self, max_faces=1)
        _require_between(self, min_mask_share=(0, 1))


@dataclass(frozen=True)
class RenderConfig:
    """Settings of `dope prep render`."""

    recipe: Recipe = "plain"
    """The paper's scenes for a kind of meshes, or plain."""
    renderer: Literal["fast", "cycles"] = "fast"
    """Rasteriser or path tracer: same cameras, same outputs."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Meshes and poses."""
    viewpoints: ViewpointsConfig = field(default_factory=ViewpointsConfig)
    """Cameras."""
    look: LookConfig = field(default_factory=LookConfig)
    """Surfaces, ground, light."""
    fast: FastConfig = field(default_factory=FastConfig)
    """The rasteriser."""
    cycles: CyclesConfig = field(default_factory=CyclesConfig)
    """The path tracer."""
    jpeg_quality: int = 97
    """Of the images; views are encoded once more."""
    seed: int = 0
    """Of everything that is drawn, together with the object's id."""

    def __post_init__(self) -> None:
        _require_between(self, jpeg_quality=(1, 100))
