"""A mesh that the user gives, prepared for the chain."""

import numpy as np
import torch

from pimper_torch.ground.geometry.mesh_frame import compare_with_scene
from pimper_torch.ground.geometry.pixels import pixel_centers
from pimper_torch.ground.geometry.projection import rays_through
from pimper_torch.ground.geometry.surfaces import face_normals, side_lengths
from pimper_torch.ground.geometry.topology import face_components, first_of_each
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.geometry.welding import welded
from pimper_torch.ground.shapes import Faces, Vertices
from pimper_torch.records import Cameras, Mesh, Silhouettes, SparseScene
from pimper_torch.runtime.errors import InputError, caution


def prepared(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> tuple[Mesh, dict[str, int | float]]:
    """Weld a mesh, drop faces that are none, and compare it with the scene.

    Returns:
        The mesh, of the scene's floating-point type and device, and figures of how far off it is.
        Warns of what was dropped, and of a mesh that is off.
    """
    found, dropped = cleaned(mesh.to(scene.points_world.device))
    if dropped:
        caution(f"Of the given mesh's {len(mesh.faces)} faces {dropped} were left out.")
    figures = compare_with_scene(found, scene, silhouettes)  # in the precision that it came in
    found = found.replace(vertices_world=found.vertices_world.to(scene.cameras.cam_from_world))
    return found, {"faces": len(found.faces), **figures}


def cleaned(mesh: Mesh) -> tuple[Mesh, str]:
    """Weld vertices at the same place; drop faces without area and those that stand twice.

    Returns:
        Its surface, and how many of which faces were dropped, in words.
    """
    vertices, faces = welded(mesh.vertices_world.detach(), mesh.faces)
    if len(faces) == 0:
        raise InputError(
            f"coarse mesh: the given mesh has {len(mesh.vertices_world)} vertices and no faces; "
            "needed: triangles. Make a mesh of the cloud first, or leave it out."
        )
    longest = side_lengths(vertices[faces]).amax(dim=1)
    area = face_normals(vertices, faces).norm(dim=-1)
    # Single precision does not tell the normal of a lower face.
    flat = ~(area > 1e-6 * longest.square())
    if bool(flat.all()):
        raise InputError(
            f"coarse mesh: none of the given mesh's {len(faces)} faces has an area; needed: a "
            "surface. Look at the file, and export it again."
        )
    faces = faces[~flat]
    first = first_of_each(faces.sort(dim=1).values)
    twice = len(faces) - len(first)
    counts = ((int(flat.sum()), "without area"), (twice, "that stand twice"))
    used, faces = torch.unique(faces[first], return_inverse=True)
    dropped = " and ".join(f"{count} {what}" for count, what in counts if count)
    return Mesh(vertices_world=vertices[used], faces=faces), dropped


def oriented_outward(mesh: Mesh, cameras: Cameras) -> tuple[Vertices, Faces]:
    """Wind the faces of a mesh consistently, with the front of each component to the cameras.

    Vertices at the same place become one first, see :func:`cleaned`.

    Args:
        mesh: World frame; files give it in double precision.
        cameras: They see it; the result has their floating-point type and device.
    """
    like = cameras.cam_from_world
    found, _ = cleaned(mesh.to(like.device, like.dtype))
    vertices, faces = found.vertices_world, found.faces
    import trimesh

    plain = trimesh.Trimesh(
        vertices.cpu().double().numpy(), faces.cpu().numpy(), process=False, validate=False
    )
    trimesh.repair.fix_winding(plain)
    faces = torch.from_numpy(np.array(plain.faces, dtype=np.int64)).to(faces.device)
    return vertices, _fronts_outward(vertices, faces, cameras)


def _fronts_outward(vertices: Vertices, faces: Faces, cameras: Cameras) -> Faces:
    """Flip components of which the cameras see more back than front."""
    caster, normals = RayCaster(vertices, faces), face_normals(vertices, faces)
    balance, num_hits = torch.zeros_like(normals[:, 0]), 0
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        # Some 20,000 rays see every component that is not smaller than a hundredth.
        stride = max(1, max(width, height) // 160)
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
