"""A mesh that the user brings, made fit to stand on."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.components import face_components
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh

# Rays cast through each photograph's longer side to see which way faces look.
_RAYS = 160


def checked(
    mesh: Mesh, cameras: Cameras
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Check a mesh, wind its faces alike, and turn each piece's front to the cameras.

    Args:
        mesh: World frame; files give it in double precision.
        cameras: That see it; the result has their floating-point type and device.

    Raises:
        InputError: The mesh has no faces, is not finite, names vertices it does not have, or
            no camera sees it.
    """
    vertices = mesh.vertices_world.detach().to(cameras.cam_from_world)
    faces = mesh.faces.to(vertices.device)
    if len(faces) == 0:
        raise InputError(
            f"coarse mesh: the mesh that was given has {len(vertices)} vertices and no faces. "
            "Needed is a triangle mesh; make one of the cloud first, or leave it out."
        )
    if not bool((faces >= 0).all() and (faces < len(vertices)).all()):
        raise InputError(
            f"coarse mesh: faces of the mesh that was given name vertices from {int(faces.min())} "
            f"to {int(faces.max())}, but it has {len(vertices)}. Write the mesh again."
        )
    bad = int((~vertices[torch.unique(faces)].isfinite()).any(dim=1).sum())
    if bad:
        raise InputError(
            f"coarse mesh: {bad} vertices of the mesh that was given are not finite. Remove them."
        )
    whole = face_normals(vertices, faces).norm(dim=-1) > 0
    used, faces = torch.unique(faces[whole], return_inverse=True)
    vertices = vertices[used]
    plain = trimesh.Trimesh(
        vertices.cpu().double().numpy(), faces.cpu().numpy(), process=False, validate=False
    )
    trimesh.repair.fix_winding(plain)
    faces = torch.from_numpy(np.array(plain.faces, dtype=np.int64)).to(faces.device)
    return vertices, _facing(vertices, faces, cameras)


def _facing(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], cameras: Cameras
) -> Int[Tensor, "face 3"]:
    """Flip pieces that show more of their backs than of their fronts."""
    caster, normals = RayCaster(vertices, faces), face_normals(vertices, faces)
    balance = torch.zeros(len(faces), dtype=vertices.dtype, device=vertices.device)
    seen = False
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        stride = max(1, max(width, height) // _RAYS)
        pixels = pixel_centers(width, height, like=vertices)[::stride, ::stride].reshape(-1, 2)
        intrinsics, frame = cameras.intrinsics[view], cameras.cam_from_world[view]
        rays = rays_through(pixels, frame.to(pixels), intrinsics.to(pixels))
        hits = caster.cast(cameras.centers_world[view].to(rays), rays)
        met = hits.face >= 0
        seen = seen or bool(met.any())
        face = hits.face[met]
        towards = -(normals[face] * rays[met]).sum(dim=-1).sign()
        balance = balance.index_add(0, face, towards)
    if not seen:
        raise InputError(
            "coarse mesh: no photograph shows the mesh that was given. It has to be in the frame "
            "and the unit of the cameras; align it with the sparse model first."
        )
    piece = face_components(faces)
    total = torch.zeros_like(balance).index_add(0, piece, balance)[piece]
    return torch.where((total < 0)[:, None], faces.flip(1), faces)
