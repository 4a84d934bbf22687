"""Positions of the places that a person points at in photographs."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from pimper_torch.doors.scale.given import Mark, PixelMark, number_of, require_inside
from pimper_torch.ground.geometry import supporting_plane
from pimper_torch.ground.geometry.lens_models import undistort_pixels
from pimper_torch.ground.geometry.projection import project
from pimper_torch.ground.geometry.rigid import invert_rigid
from pimper_torch.ground.geometry.visibility import RayCaster
from pimper_torch.ground.shapes import Vector
from pimper_torch.records import Mesh, Reconstruction, Silhouettes, SparseScene
from pimper_torch.runtime.errors import InputError, caution

# Confidence of a surface below which a warning says that it may be elsewhere. A choice: a half is
# that of normals which are 8 degrees off.
_UNSURE = 0.5

# Rays of one place: how far they may pass each other, and the least angle between some two.
_PASSING = 0.01
_MIN_ANGLE_DEG = 1.0


def view_of(name: str, scene: SparseScene) -> int:
    """Find a photograph among those that have a camera."""
    names = scene.views.names
    if number_of(name, (*names, *scene.unregistered)) >= len(names):
        raise InputError(
            f"{name}: has no place among the cameras that were found; needed: a photograph that "
            "has. Measure in another one."
        )
    return number_of(name, names)


def place_of(mark: Mark, result: Reconstruction) -> Vector:
    """Find where a mark is, world frame, float64.

    A mark in one photograph is where its ray first meets the surface; if it misses the surface, on
    the supporting plane, where silhouettes or the cloud determine one. A mark in several is where
    their rays meet, on the surface or not.

    Args:
        mark: Pixels of the photographs as they were loaded: the right way up, before undistortion.
    """
    views = [view_of(pointer.name, result.scene) for pointer in mark.pointers]
    rays = torch.stack(
        [_ray(one, view, result.scene) for one, view in zip(mark.pointers, views, strict=True)]
    )
    eyes = invert_rigid(result.cameras.cam_from_world[views].detach().cpu().double())[:, :3, 3]
    if len(views) > 1:
        return _meeting(mark, result.scene, views, eyes, rays)
    return _met(mark.pointers[0], result, views[0], eyes[0], rays[0])


def _ray(pointer: PixelMark, view: int, scene: SparseScene) -> Vector:
    """Return the direction behind a pixel, as long as it goes while its depth grows by 1."""
    lens = scene.lenses[view]
    width, height = pointer.size_px or (lens.width, lens.height)
    require_inside(pointer, width, height)
    pixel = torch.tensor(
        [[pointer.x * lens.width / width, pointer.y * lens.height / height]], dtype=torch.float64
    )
    plane = undistort_pixels(lens, pixel)[0]
    if not bool(plane.isfinite().all()):
        raise InputError(
            f"{pointer}: its lens ({lens.model}) images nothing there. Point at the place in "
            "another photograph, nearer to the middle."
        )
    rotation = scene.cameras.cam_from_world[view, :3, :3].detach().cpu().double()
    return torch.cat([plane, torch.ones_like(plane[:1])]) @ rotation


def _meeting(
    mark: Mark,
    scene: SparseScene,
    views: Sequence[int],
    eyes: Float[Tensor, "ray 3"],
    rays: Float[Tensor, "ray 3"],
) -> Vector:
    """Find the point nearest to rays in the least-squares sense."""
    unit = rays / rays.norm(dim=1, keepdim=True)
    widest = float((unit @ unit.mT).clamp(-1, 1).acos().rad2deg().max())
    if widest < _MIN_ANGLE_DEG:
        raise InputError(
            f"{mark}: these rays differ by {widest:.2g} degrees; needed: {_MIN_ANGLE_DEG:g} at "
            "least. Point at the place in photographs that were taken farther apart."
        )
    across = torch.eye(3).double() - unit[:, :, None] * unit[:, None, :]
    point = torch.linalg.solve(across.sum(dim=0), (across @ eyes[..., None]).sum(dim=0)[:, 0])
    offset = point - eyes
    off = (across @ offset[..., None])[..., 0].norm(dim=1) / offset.norm(dim=1)
    for pointer, view, one in zip(mark.pointers, views, off.tolist(), strict=True):
        lens = scene.lenses[view]
        focal = float(scene.cameras.intrinsics[view, 0, 0])
        if one * focal > _PASSING * max(lens.width, lens.height):
            raise InputError(
                f"{mark}: {pointer} is {one * focal:.0f} pixels from where the others place it; "
                f"needed: one place in all of them, to {_PASSING:.0%} of the photograph."
            )
    return point


def _met(pointer: PixelMark, result: Reconstruction, view: int, eye: Vector, ray: Vector) -> Vector:
    """Find where a ray first meets the surface, else touches it, else meets the ground."""
    mesh = result.mesh.detach().to("cpu", torch.float64)
    hits = RayCaster(mesh.vertices_world, mesh.faces).cast(eye, ray[None])
    if int(hits.face) >= 0:
        corners = mesh.faces[int(hits.face)]
        a, b, c = mesh.vertices_world[corners]
        if float(torch.linalg.cross(b - a, c - a) @ ray) > 0:
            raise InputError(
                f"{pointer}: the ray behind this pixel goes through an opening of the surface. "
                "Point at a part that the result shows, or at the place in two photographs: "
                "NAME1,x,y+NAME2,x,y."
            )
        sure = None if mesh.confidence is None else float(mesh.confidence[corners].mean())
        if sure is not None and sure < _UNSURE:
            caution(
                f"{pointer}: photographs hardly determine the surface there: its confidence is "
                f"{sure:.2f}, and {_UNSURE:g} or more is needed for a size to rely on. Point at a "
                "part that more photographs show, or at the place in two of them: "
                "NAME1,x,y+NAME2,x,y.",
                stacklevel=3,
            )
        hits = hits.refined(mesh.vertices_world, mesh.faces, eye, ray[None])
        return eye + float(hits.distance) * ray
    beside = _beside(pointer, result, mesh, view, eye, ray)
    if beside is not None:
        return beside
    plane = ground(result.scene, result.silhouettes)
    if plane is not None:
        rate = float(plane.normal_world.double() @ ray)
        height = float(plane.height_of(eye.to(plane.normal_world)))
        if rate < 0 < height:
            return eye - height / rate * ray
    raise InputError(
        f"{pointer}: the ray behind this pixel misses the surface, and the plane that the object "
        "stands on is not known there. Point at the object, or at the place in two photographs: "
        "NAME1,x,y+NAME2,x,y. What stages found is kept: the same command goes on from there."
    )


def _beside(
    pointer: PixelMark, result: Reconstruction, mesh: Mesh, view: int, eye: Vector, ray: Vector
) -> Vector | None:
    """Return the point of a ray next to the nearest vertex, if the surface is near the pixel."""
    cameras = result.cameras.detach().to("cpu", torch.float64)
    pose, intrinsics = cameras.cam_from_world[view], cameras.intrinsics[view]
    pixels, depth = project(mesh.vertices_world, pose, intrinsics)
    (pixel,), _ = project((eye + ray)[None], pose, intrinsics)
    off = torch.where(depth > 0, (pixels - pixel).norm(dim=1), torch.inf)
    nearest = int(off.argmin())
    column, row = (int(side) for side in pixel.floor())
    silhouettes = result.silhouettes
    drawn = silhouettes.masks[view]
    within = 0 <= row < drawn.shape[0] and 0 <= column < drawn.shape[1]
    on = silhouettes.source != "everything" and within and bool(drawn[row, column])
    longer = int(cameras.sizes_px[view].max())
    # A surface ends a little inside of the object that it shows.
    if float(off[nearest]) > max(2.0, 0.01 * longer if on else 0.0):
        if on:
            raise InputError(
                f"{pointer}: the silhouette says that this pixel shows the object, but the surface "
                "is missing there. Point at a part that the result shows, or at the place in two "
                "photographs: NAME1,x,y+NAME2,x,y."
            )
        return None
    return eye + float(depth[nearest]) * ray


def ground(scene: SparseScene, silhouettes: Silhouettes) -> supporting_plane.Plane | None:
    """Return the supporting plane of the object: the silhouettes', else that of the cloud."""
    if len(silhouettes.planes_world):
        found = silhouettes.planes_world[0].detach().cpu()  # of the first series, whose up is up
        length = found[:3].norm()
        return supporting_plane.Plane(normal_world=found[:3] / length, offset=-found[3] / length)
    cameras = scene.cameras.detach().to("cpu")
    points = scene.points_world.detach()[supporting_plane.well_tracked(scene)].cpu()
    distance = float(supporting_plane.fixation(cameras.cam_from_world).distance)
    return supporting_plane.supporting_plane(points, cameras.centers_world, distance)
