"""Finish of a surface before it is written: fewer vertices, and caps where it is open."""

from dataclasses import dataclass
from typing import Literal

from pimper_torch.config import require
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.io.meshes import written_channels
from pimper_torch.meshing.closing import Closed, closed
from pimper_torch.meshing.simplify import simplify
from pimper_torch.records import Mesh, Record
from pimper_torch.sfm.colmap_surfaces import reduced


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


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Finished(Record):
    """A surface as it is written.

    Attributes:
        mesh: Without caps; what pictures show.
        closed: With caps, if it shall have some.
    """

    mesh: Mesh
    closed: Closed | None
    summary: dict[str, dict[str, int | float]]


def finished(mesh: Mesh, files: MeshFiles) -> Finished:
    """Make a surface ready to be written.

    Args:
        mesh: Of a run, on the CPU.
    """
    told: dict[str, dict[str, int | float]] = {}
    if isinstance(files.faces, int):
        few, whole = _few_enough(mesh, files.faces, files.watertight)
        told["reduced"] = {"vertices": len(few.vertices_world), "faces": len(few.faces)}
    elif files.faces == "all":
        few, whole = mesh, closed(mesh) if files.watertight else None
    else:
        found = simplify(mesh, values=written_channels(mesh))
        few = found.mesh
        whole = closed(few) if files.watertight else None
        told["simplified"] = {
            "vertices": len(few.vertices_world),
            "faces": len(few.faces),
            "spacing": found.spacing,
            "max_spacings": found.max_spacings,
            "max_angle_deg": found.max_angle_deg,
        }
    if whole is not None:
        told["caps"] = _caps(whole)
    return Finished(mesh=few, closed=whole, summary=told)


def _few_enough(mesh: Mesh, faces: int, watertight: bool) -> tuple[Mesh, Closed | None]:
    """Reduce a mesh until it has few enough faces, together with its caps if it gets some."""
    few = reduced(mesh, faces)
    if not watertight:
        return few, None
    whole, wanted = closed(few), faces
    for _ in range(4):  # caps hardly change after the second time
        excess = len(whole.mesh.faces) - faces
        wanted -= excess
        if excess <= 0 or wanted < 4:
            break
        few = reduced(mesh, wanted)
        whole = closed(few)
    return few, whole


def _caps(whole: Closed) -> dict[str, int | float]:
    area = face_normals(whole.mesh.vertices_world, whole.mesh.faces).norm(dim=1)
    return {
        "borders": whole.borders,
        "faces": int((~whole.measured).sum()),
        "area_fraction": float(area[~whole.measured].sum() / area.sum()),
    }
