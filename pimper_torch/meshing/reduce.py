"""A mesh of no more faces than asked for."""

from dataclasses import fields

import torch
from jaxtyping import Int
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.config import require
from pimper_torch.geometry.nearest import NearestSurface
from pimper_torch.geometry.surfaces import barycentric
from pimper_torch.geometry.topology import half_edges
from pimper_torch.records import Mesh
from pimper_torch.sfm.surfaces import simplified


def reduced(mesh: Mesh, max_faces: int) -> Mesh:
    """Merge vertices where that changes the surface least, until few faces are left.

    Normals, albedo, confidence and expected error are those of the nearest place of the former
    surface, blended over its face. A constant to autograd.

    Args:
        mesh: Any; one that is small enough comes back as it is.
        max_faces: Of the result; a few more are left where nothing else can be merged.

    Raises:
        ConfigError: Fewer than 4 faces are asked for.
        ReconstructionError: COLMAP cannot simplify the mesh.
    """
    require(max_faces >= 4, "faces", max_faces, "4 at least, those of a tetrahedron")
    if len(mesh.faces) <= max_faces:
        return mesh
    placed = mesh.vertices_world.detach().cpu().double()
    former = Mesh(vertices_world=placed, faces=mesh.faces.cpu())
    vertices, faces = simplified(placed, former.faces, num_faces=max_faces)
    used, faces = torch.unique(_oriented(faces), return_inverse=True)
    nearest = NearestSurface(former).query(vertices[used])
    corners = former.faces[nearest.face]
    weights = barycentric(nearest.points, placed[corners])

    def blended(values: Tensor) -> Tensor:
        """Blend what the corners of the nearest faces have."""
        rows = values.detach().cpu().double()[corners].reshape(len(corners), 3, -1)
        return (weights[..., None] * rows).sum(dim=1).reshape(-1, *values.shape[1:]).to(values)

    names = [one.name for one in fields(Mesh) if one.name not in ("vertices_world", "faces")]
    known = {name: getattr(mesh, name) for name in names}
    known = {name: None if values is None else blended(values) for name, values in known.items()}
    if known["normals_world"] is not None:
        known["normals_world"] = normalize(known["normals_world"], dim=-1)
    return Mesh(
        vertices_world=vertices[used].to(mesh.vertices_world),
        faces=faces.to(mesh.faces),
        **known,
    )


def _oriented(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "kept 3"]:
    """Drop faces that run along an edge the way that an earlier face does."""
    ends = half_edges(faces)
    _, label = torch.unique(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1], return_inverse=True)
    number = torch.arange(len(faces)).repeat_interleave(3)
    first = torch.full_like(label, len(faces)).scatter_reduce(0, label, number, "amin")
    return faces[(first[label] == number).reshape(-1, 3).all(dim=1)]
