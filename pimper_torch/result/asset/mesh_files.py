"""Form of the files of a mesh."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Literal

from pimper_torch.runtime.config import require
from pimper_torch.runtime.errors import ConfigError

MeshFormat = Literal["stl", "obj", "usdz"]
TextureFormat = Literal["png", "jpeg", "webp"]


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshFiles:
    """Form in which the surface is written.

    Attributes:
        faces: Most that the mesh has; ``None`` for as few as tell the surface to a twentieth of a
            sample's spacing and 1.5 degrees.
        formats: Beside PLY and GLB, which are always written. USDZ holds the asset, and needs
            usd-core, the extra ``usd``.
        texture: Of the pictures in ``asset.glb``; others are PNG.
        cameras: Whether ``asset.glb`` holds the cameras of the photographs.
    """

    faces: int | Literal["all"] | None = None
    watertight: bool = False
    formats: tuple[MeshFormat, ...] = ()
    texture: TextureFormat = "png"
    cameras: bool = False

    def __post_init__(self) -> None:
        few = self.faces is not None and self.faces != "all" and self.faces < 4
        require(not few, "faces", self.faces, "all, or 4 at least, those of a tetrahedron")
        if "usdz" in self.formats and find_spec("pxr") is None:
            raise ConfigError(
                "USDZ needs usd-core, which is not installed: pip install 'pimper_torch[usd]'."
            )
