"""Preparation of a surface for writing: simplification, and caps over borders."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry.poisson import reduced
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.io.assets.mesh_files import MeshFiles
from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.radiometry.base_color import base_color
from pimper_torch.records import ClosedMesh, FinishedMesh, Mesh
from pimper_torch.stages.meshing.closing import closed
from pimper_torch.stages.meshing.simplify import simplify
from pimper_torch.stages.stage import Stage

# Editable by people, and fast to draw in browsers.
_FACES = 50_000

# Colour differences hardly visible on a rendered surface, and errors far below the accuracy of
# confidence and expected error.
_MAX_LEVELS, _MAX_CONFIDENCE, _MAX_RATIO = 8.0, 0.1, 0.1


class Simplify(Stage):
    """Simplify a surface to the vertices that its shape needs, and cap its borders if requested."""

    kept_as = FinishedMesh

    def forward(self, mesh: Mesh, files: MeshFiles) -> FinishedMesh:
        """Prepare a surface for writing."""
        how, moved = "", dict[str, int | float]()
        capped: ClosedMesh | None = None
        if isinstance(files.faces, int):
            how = "reduced"
            few, capped = _reduced_to(mesh, files.faces, files.watertight)
        elif files.faces == "all":
            few = mesh
        else:
            how, simplified = "simplified", simplify(mesh, values=written_channels(mesh))
            few = simplified.mesh
            figures = ("spacing", "max_spacings", "max_angle_deg")
            moved = {name: getattr(simplified, name) for name in figures}
        if files.watertight and capped is None:
            capped = closed(few)
        caps: dict[str, int | float] = {}
        if capped is not None:
            area = face_normals(capped.mesh.vertices_world, capped.mesh.faces).norm(dim=1)
            fraction = float(area[~capped.measured].sum() / area.sum())
            count = int((~capped.measured).sum())
            caps = {"borders": capped.borders, "faces": count, "area_fraction": fraction}
            caps["trimmed_faces"] = len(few.faces) - int(capped.measured.sum())
        return FinishedMesh(
            mesh=few,
            few=reduced(few, _FACES),
            closed=capped,
            how=how,
            counts={"vertices": len(few.vertices_world), "faces": len(few.faces), **moved},
            caps=caps,
        )


def _reduced_to(mesh: Mesh, faces: int, watertight: bool) -> tuple[Mesh, ClosedMesh | None]:
    """Reduce a mesh to at most ``faces`` faces, including its caps if it gets some."""
    few = reduced(mesh, faces)
    if not watertight:
        return few, None
    capped, wanted = closed(few), faces
    for _ in range(4):  # caps hardly change after the second iteration
        excess = len(capped.mesh.faces) - faces
        wanted -= excess
        if excess <= 0 or wanted < 4:
            break
        few = reduced(mesh, wanted)
        capped = closed(few)
    return few, capped


def written_channels(mesh: Mesh) -> Float[Tensor, "vertex channel"]:
    """Return the written vertex values other than positions, in units of their tolerances.

    For :func:`pimper_torch.stages.meshing.simplify.simplify`: the tolerance of sRGB colour is 8 of
    255, of confidence 0.1, and of expected error a tenth of its value.
    """
    channels = [mesh.vertices_world.new_zeros(len(mesh.vertices_world), 0)]
    if mesh.albedo is not None:
        channels.append(255 / _MAX_LEVELS * srgb_from_linear(base_color(mesh).expand(-1, 3)))
    if mesh.confidence is not None:
        channels.append(mesh.confidence[:, None] / _MAX_CONFIDENCE)
    if mesh.expected_error is not None:
        least = torch.finfo(torch.float32).tiny
        channels.append(mesh.expected_error[:, None].clamp_min(least).log() / _MAX_RATIO)
    return torch.cat(channels, dim=1).detach()
