"""Preparation of a mesh that the user provides."""

import numpy as np
import torch

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.surfaces import face_normals, side_lengths
from pimper_torch.geometry.topology import face_components, first_of_each
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Mesh, Silhouettes, SparseScene
from pimper_torch.records.shapes import Faces, Vertices
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.stages.coarse.mesh_frame import compare_with_scene
from pimper_torch.stages.coarse.welding import welded


def prepared(
    mesh: Mesh, scene: SparseScene, silhouettes: Silhouettes
) -> tuple[Mesh, dict[str, int | float]]:
    """Weld a mesh, remove degenerate and duplicate faces, and compare it with the scene.

    Returns:
        The mesh, of the scene's floating-point type and device, and measures of its deviation from
        the scene. Warns of removed faces, and of a mesh that deviates.
    """
    clean, removed = cleaned(mesh.to(scene.points_world.device))
    if removed:
        caution(f"Removed from the given mesh of {len(mesh.faces)} faces: {removed}.")
    figures = compare_with_scene(clean, scene, silhouettes)  # in the precision of the mesh
    clean = clean.replace(vertices_world=clean.vertices_world.to(scene.cameras.cam_from_world))
    return clean, {"faces": len(clean.faces), **figures}


def cleaned(mesh: Mesh) -> tuple[Mesh, str]:
    """Weld coincident vertices; remove faces without area and duplicate faces.

    Returns:
        The mesh, and the numbers of removed faces, in words; empty if none was.
    """
    vertices, faces = welded(mesh.vertices_world.detach(), mesh.faces)
    if len(faces) == 0:
        raise InputError(
            f"coarse mesh: the given mesh has {len(mesh.vertices_world)} vertices and no faces; "
            "needed: triangles. Convert the point cloud to a mesh, or omit it."
        )
    longest = side_lengths(vertices[faces]).amax(dim=1)
    area = face_normals(vertices, faces).norm(dim=-1)
    # Single precision does not determine the normal of a flatter face.
    flat = ~(area > 1e-6 * longest.square())
    if bool(flat.all()):
        raise InputError(
            f"coarse mesh: none of the given mesh's {len(faces)} faces has an area; needed: a "
            "surface. Check the file, and export it again."
        )
    faces = faces[~flat]
    first = first_of_each(faces.sort(dim=1).values)
    counts = ((int(flat.sum()), "without area"), (len(faces) - len(first), "duplicated"))
    used, faces = torch.unique(faces[first], return_inverse=True)
    removed = ", ".join(f"{count} {kind}" for count, kind in counts if count)
    return Mesh(vertices_world=vertices[used], faces=faces), removed


def oriented_outward(mesh: Mesh, cameras: Cameras) -> tuple[Vertices, Faces]:
    """Return the vertices and consistently wound faces, each component's front to the cameras.

    Coincident vertices are welded first, see :func:`cleaned`.

    Args:
        mesh: World frame; double precision if read from a file.
        cameras: They see the mesh. The result has their floating-point type and device.
    """
    like = cameras.cam_from_world
    clean, _ = cleaned(mesh.to(like.device, like.dtype))
    vertices, faces = clean.vertices_world, clean.faces
    import trimesh

    wound = trimesh.Trimesh(
        vertices.cpu().double().numpy(), faces.cpu().numpy(), process=False, validate=False
    )
    trimesh.repair.fix_winding(wound)
    faces = torch.from_numpy(np.array(wound.faces, dtype=np.int64)).to(faces.device)
    return vertices, _fronts_outward(vertices, faces, cameras)


def _fronts_outward(vertices: Vertices, faces: Faces, cameras: Cameras) -> Faces:
    """Return the faces, with components flipped of which the cameras see more back than front."""
    caster, normals = RayCaster(vertices, faces), face_normals(vertices, faces)
    balance, num_hits = torch.zeros_like(normals[:, 0]), 0
    for view in range(cameras.num_views):
        width, height = (int(side) for side in cameras.sizes_px[view])
        # Some 20,000 rays hit every component larger than a hundredth of the object.
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
            "coarse mesh: no photograph shows the given mesh. It must be in the frame and unit of "
            "the cameras: align it with the sparse model first."
        )
    component = face_components(faces)
    total = torch.zeros_like(balance).index_add(0, component, balance)[component]
    return torch.where((total < 0)[:, None], faces.flip(1), faces)
