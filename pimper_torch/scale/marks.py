"""Positions in space of points marked in photographs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.geometry import supporting_plane
from pimper_torch.geometry.lens_models import undistort_pixels
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import invert_rigid
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Mesh, Reconstruction, Silhouettes, SparseScene
from pimper_torch.records.shapes import Vector
from pimper_torch.runtime.errors import InputError, caution
from pimper_torch.runtime.file_names import view_named
from pimper_torch.scale.given import Mark, PixelMark, require_inside

# Confidence of the surface below which a warning is given. A choice: normals with an error of 8
# degrees have one half.
_UNSURE = 0.5

# Rays to one point: largest error, as a fraction of the longer side, and least angle between some.
_PASSING = 0.01
_MIN_ANGLE_DEG = 1.0


def view_of(name: str, scene: SparseScene) -> int:
    """Return the index of a photograph among those that have a camera."""
    names = scene.views.names
    if view_named(name, (*names, *scene.unregistered)) >= len(names):
        raise InputError(
            f"{name}: this photograph has no camera; needed: a registered photograph. Measure in "
            "another one."
        )
    return view_named(name, names)


def place_of(mark: Mark, result: Reconstruction) -> Vector:
    """Return the position of a mark in the world frame, in float64.

    The ray of a mark in one photograph is intersected with the surface; if it misses the surface,
    with the supporting plane, if silhouettes or the cloud determine one. The rays of a mark in
    several photographs are intersected with each other, on the surface or not.

    Args:
        mark: Pixels of the photographs as they were loaded: upright, before undistortion.
    """
    views = [view_of(pointer.name, result.scene) for pointer in mark.pointers]
    rays = torch.stack(
        [_ray(*pointed, result.scene) for pointed in zip(mark.pointers, views, strict=True)]
    )
    eyes = invert_rigid(result.cameras.cam_from_world[views].detach().cpu().double())[:, :3, 3]
    if len(views) > 1:
        return _intersect_rays(mark, result.scene, views, eyes, rays)
    return _hit(mark.pointers[0], result, views[0], eyes[0], rays[0])


def _ray(pointer: PixelMark, view: int, scene: SparseScene) -> Vector:
    """Return the world direction of a pixel's ray, scaled to a depth of 1."""
    lens = scene.lenses[view]
    width, height = pointer.size_px or (lens.width, lens.height)
    require_inside(pointer, width, height)
    pixel = torch.tensor(
        [[pointer.x * lens.width / width, pointer.y * lens.height / height]], dtype=torch.float64
    )
    plane = undistort_pixels(lens, pixel)[0]
    if not bool(plane.isfinite().all()):
        raise InputError(
            f"{pointer}: no ray of its lens ({lens.model}) reaches this pixel. Mark the point in "
            "another photograph, nearer to the centre."
        )
    rotation = scene.cameras.cam_from_world[view, :3, :3].detach().cpu().double()
    return torch.cat([plane, torch.ones_like(plane[:1])]) @ rotation


def _intersect_rays(
    mark: Mark,
    scene: SparseScene,
    views: Sequence[int],
    eyes: Float[Tensor, "ray 3"],
    rays: Float[Tensor, "ray 3"],
) -> Vector:
    """Return the least-squares intersection of rays."""
    unit = rays / rays.norm(dim=1, keepdim=True)
    widest = float((unit @ unit.mT).clamp(-1, 1).acos().rad2deg().max())
    if widest < _MIN_ANGLE_DEG:
        raise InputError(
            f"{mark}: the rays of these pixels differ by {widest:.2g} degrees; needed: at least "
            f"{_MIN_ANGLE_DEG:g}. Mark the point in photographs from viewpoints farther apart."
        )
    projector = torch.eye(3).double() - unit[:, :, None] * unit[:, None, :]
    point = torch.linalg.solve(projector.sum(dim=0), (projector @ eyes[..., None]).sum(dim=0)[:, 0])
    offset = point - eyes
    sines = (projector @ offset[..., None])[..., 0].norm(dim=1) / offset.norm(dim=1)
    for pointer, view, sine in zip(mark.pointers, views, sines.tolist(), strict=True):
        lens = scene.lenses[view]
        focal = float(scene.cameras.intrinsics[view, 0, 0])
        if sine * focal > _PASSING * max(lens.width, lens.height):
            raise InputError(
                f"{mark}: {pointer} is {sine * focal:.0f} pixels from the point that the others "
                f"mark; needed: the same point in all, within {_PASSING:.0%} of the longer side."
            )
    return point


def _hit(pointer: PixelMark, result: Reconstruction, view: int, eye: Vector, ray: Vector) -> Vector:
    """Return the first point of a ray on the surface, else near its border, else on the plane."""
    mesh = result.mesh.detach().to("cpu", torch.float64)
    hits = RayCaster(mesh.vertices_world, mesh.faces).cast(eye, ray[None])
    if int(hits.face) >= 0:
        corners = mesh.faces[int(hits.face)]
        a, b, c = mesh.vertices_world[corners]
        if float(torch.linalg.cross(b - a, c - a) @ ray) > 0:
            raise InputError(
                f"{pointer}: the ray of this pixel goes through an opening of the surface. Mark a "
                "point on the surface, or mark this point in two photographs: NAME1,x,y+NAME2,x,y."
            )
        confidence = None if mesh.confidence is None else float(mesh.confidence[corners].mean())
        if confidence is not None and confidence < _UNSURE:
            caution(
                f"{pointer}: the photographs hardly determine the surface there: its confidence is "
                f"{confidence:.2f}; needed for a reliable scale: {_UNSURE:g} or more. Mark a point "
                "in more photographs, or this point in two photographs: NAME1,x,y+NAME2,x,y.",
                stacklevel=3,
            )
        hits = hits.refined(mesh.vertices_world, mesh.faces, eye, ray[None])
        return eye + float(hits.distance) * ray
    near_border = _near_border(pointer, result, mesh, view, eye, ray)
    if near_border is not None:
        return near_border
    plane = ground(result.scene, result.silhouettes)
    if plane is not None:
        rate = float(plane.normal_world.double() @ ray)
        height = float(plane.height_of(eye.to(plane.normal_world)))
        if rate < 0 < height:
            return eye - height / rate * ray
    raise InputError(
        f"{pointer}: the ray of this pixel misses the surface, and the supporting plane is unknown "
        "there. Mark a point on the object, or mark this point in two photographs: "
        "NAME1,x,y+NAME2,x,y. Finished stages are kept: the same command continues from there."
    )


def _near_border(
    pointer: PixelMark, result: Reconstruction, mesh: Mesh, view: int, eye: Vector, ray: Vector
) -> Vector | None:
    """Return the ray's point at the depth of the vertex nearest to the pixel, if that is near."""
    cameras = result.cameras.detach().to("cpu", torch.float64)
    pose, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    pixels, depth = project(mesh.vertices_world, pose, intrinsics)
    (pixel,), _ = project((eye + ray)[None], pose, intrinsics)
    distance_px = torch.where(depth > 0, (pixels - pixel).norm(dim=1), torch.inf)
    nearest = int(distance_px.argmin())
    column, row = (int(side) for side in pixel.floor())
    silhouettes = result.silhouettes
    mask = silhouettes.masks[view]
    in_frame = 0 <= row < mask.shape[0] and 0 <= column < mask.shape[1]
    in_silhouette = silhouettes.source != "everything" and in_frame and bool(mask[row, column])
    longer = int(cameras.sizes_px[view].max())
    # A surface ends slightly inside the object's outline.
    if float(distance_px[nearest]) > max(2.0, 0.01 * longer if in_silhouette else 0.0):
        if in_silhouette:
            raise InputError(
                f"{pointer}: this pixel is in the silhouette, but the surface is missing there. "
                "Mark a point on the surface, or mark this point in two photographs: "
                "NAME1,x,y+NAME2,x,y."
            )
        return None
    return eye + float(depth[nearest]) * ray


def ground(scene: SparseScene, silhouettes: Silhouettes) -> supporting_plane.Plane | None:
    """Return the supporting plane from the silhouettes, else from the cloud."""
    if len(silhouettes.planes_world):
        plane = silhouettes.planes_world[0].detach().cpu()  # the first session's up is the world's
        length = plane[:3].norm()
        return supporting_plane.Plane(normal_world=plane[:3] / length, offset=-plane[3] / length)
    cameras = scene.cameras.detach().to("cpu")
    points = scene.points_world.detach()[supporting_plane.well_tracked(scene)].cpu()
    distance = float(supporting_plane.fixation(cameras.cam_from_world).distance)
    return supporting_plane.supporting_plane(points, cameras.centers_world, distance)
