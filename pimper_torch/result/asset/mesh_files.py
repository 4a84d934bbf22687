"""Form of the files of a mesh."""

from dataclasses import dataclass
from typing import Literal

from pimper_torch.runtime.config import require


@dataclass(frozen=True, slots=True, kw_only=True)
class MeshFiles:
    """Form in which the surface is written.

    Attributes:
        faces: Most that the mesh has; ``None`` for as few as tell the surface to a twentieth of a
            sample's spacing and 1.5 degrees.
        formats: Beside PLY and GLB, which are always written.
    """

    faces: int | Literal["all"] | None = None
    watertight: bool = False
    formats: tuple[Literal["stl", "obj"], ...] = ()

    def __post_init__(self) -> None:
        few = self.faces is not None and self.faces != "all" and self.faces < 4
        require(not few, "faces", self.faces, "all, or 4 at least, those of a tetrahedron")
