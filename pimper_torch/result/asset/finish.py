"""Finish of a surface before it is written: fewer vertices, and caps where it is open."""

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.ground.geometry.poisson import reduced
from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.method.meshing.closing import closed
from pimper_torch.method.meshing.simplify import simplify
from pimper_torch.records import Closed, Finished, Mesh
from pimper_torch.result.asset.mesh_files import MeshFiles
from pimper_torch.result.viz.maps import base_color
from pimper_torch.runtime.stage import Stage

# What people can edit, and browsers draw at once.
_FACES = 50_000

# Steps that the eye hardly sees on a rendered surface, and errors far below the accuracy of these
# two figures.
_MAX_LEVELS, _MAX_CONFIDENCE, _MAX_RATIO = 8.0, 0.1, 0.1


class Simplify(Stage):
    """Reduce a surface to as few vertices as its shape needs, and close it if asked to."""

    def forward(self, mesh: Mesh, files: MeshFiles) -> Finished:
        """Make a surface ready to be written."""
        how, moved = "", dict[str, int | float]()
        whole: Closed | None = None
        if isinstance(files.faces, int):
            how = "reduced"
            few, whole = _few_enough(mesh, files.faces, files.watertight)
        elif files.faces == "all":
            few = mesh
        else:
            how, found = "simplified", simplify(mesh, values=written_channels(mesh))
            few = found.mesh
            figures = ("spacing", "max_spacings", "max_angle_deg")
            moved = {name: getattr(found, name) for name in figures}
        if files.watertight and whole is None:
            whole = closed(few)
        caps: dict[str, int | float] = {}
        if whole is not None:
            area = face_normals(whole.mesh.vertices_world, whole.mesh.faces).norm(dim=1)
            share = float(area[~whole.measured].sum() / area.sum())
            count = int((~whole.measured).sum())
            caps = {"borders": whole.borders, "faces": count, "area_fraction": share}
        return Finished(
            mesh=few,
            few=reduced(few, _FACES),
            closed=whole,
            how=how,
            counts={"vertices": len(few.vertices_world), "faces": len(few.faces), **moved},
            caps=caps,
        )


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


def written_channels(mesh: Mesh) -> Float[Tensor, "vertex channel"]:
    """Return a file's other values of vertices, in units of their tolerances.

    For :func:`pimper_torch.method.meshing.simplify.simplify`: sRGB colour may be off by 8 levels of
    255, confidence by 0.1, expected error by a tenth of itself.
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
