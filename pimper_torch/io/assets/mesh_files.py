"""File options of a mesh."""

from dataclasses import dataclass
from typing import Literal

from pimper_torch.runtime.config import require

MeshFormat = Literal["stl", "obj"]
TextureFormat = Literal["png", "jpeg", "webp"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshFiles:
    """Form in which the surface is written.

    Attributes:
        faces: Maximum number of faces; ``None`` for as few as represent the surface to a twentieth
            of a sample's spacing and 1.5 degrees.
        formats: In addition to PLY and GLB, which are always written.
        texture: Of the images in ``asset.glb``; other images are PNG.
        cameras: Whether ``asset.glb`` contains the cameras of the photographs.
    """

    faces: int | Literal["all"] | None = None
    watertight: bool = False
    formats: tuple[MeshFormat, ...] = ()
    texture: TextureFormat = "png"
    cameras: bool = False

    def __post_init__(self) -> None:
        too_few = self.faces is not None and self.faces != "all" and self.faces < 4
        require(not too_few, "faces", self.faces, "all, or at least 4, a tetrahedron's")
