"""A mesh that the user gives, oriented for the chain."""

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from pimper_torch.errors import InputError
from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.geometry.topology import face_components
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh

# Rays cast along each photograph's longer side. A choice: some 20,000 rays a photograph see every
# component that is not smaller than a hundredth of it, in milliseconds.
_RAYS = 160


def oriented_outward(
    mesh: Mesh, cameras: Cameras
) -> tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]:
    """Wind the faces of a mesh consistently, with the front of each component to the cameras.

    Faces without area and vertices without faces are dropped.

    Args:
        mesh: World frame; files give it in double precision.
        cameras: They see it; the result has their floating-point type and device.

    Raises:
        InputError: The mesh has no faces, or no camera sees it.
    """
    vertices = mesh.vertices_world.detach().to(cameras.cam_from_world)
    faces = mesh.faces.to(vertices.device)
    if len(faces) == 0:
        raise InputError(
            f"coarse mesh: the given mesh has {len(vertices)} vertices and no faces; needed: "
            "triangles. Make a mesh of the cloud first, or leave it out."
        )
    used, faces = torch.unique(
        faces[face_normals(vertices, faces).norm(dim=-1) > 0], return_inverse=True
    )
    vertices = vertices[used]
    plain = trimesh.Trimesh(
        vertices.cpu().double().numpy(), faces.cpu().numpy(), process=False, validate=False
    )
    trimesh.repair.fix_winding(plain)
    faces = torch.from_numpy(np.array(plain.faces, dtype=np.int64)).to(faces.device)
    return vertices, _fronts_outward(vertices, faces, cameras)


def _fronts_outward(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], cameras: Cameras
) -> Int[Tensor, "face 3"]:
    """Flip components of which the cameras see more back than front."""
    caster, normals = RayCaster(vertices, faces), face_normals(vertices, faces)
    balance, num_hits = torch.zeros_like(normals[:, 0]), 0
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        stride = max(1, max(width, height) // _RAYS)
        pixels = pixel_centers(width, height, like=vertices)[::stride, ::stride].reshape(-1, 2)
        intrinsics, frame = cameras.intrinsics[view], cameras.cam_from_world[view]
        rays = rays_through(pixels, frame.to(pixels), intrinsics.to(pixels))
        face = caster.cast(cameras.centers_world[view].to(rays), rays).face
        hit = face >= 0
        num_hits += int(hit.sum())
        towards = -(normals[face[hit]] * rays[hit]).sum(dim=-1).sign()
        balance = balance.index_add(0, face[hit], towards)
    if not num_hits:
        raise InputError(
            "coarse mesh: no photograph shows the given mesh. It has to be in the frame and the "
            "unit of the cameras; align it with the sparse model first."
        )
    component = face_components(faces)
    total = torch.zeros_like(balance).index_add(0, component, balance)[component]
    return torch.where((total < 0)[:, None], faces.flip(1), faces)
