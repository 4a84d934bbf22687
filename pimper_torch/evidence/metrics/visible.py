"""How many positions of a camera see each point of the true surface."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.evidence.metrics.sampling import SurfaceSamples
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.visibility import RayCaster
from pimper_torch.records import Cameras, Capture, Mesh

# Fraction of the object's diagonal that a surface may lie in front of a point without hiding it:
# the ray caster's float32 needs a millionth, depth maps of files a thousandth.
_HIDDEN_BEHIND = 1e-3


def count_seeing(
    samples: SurfaceSamples, capture: Capture, diagonal: float
) -> Int[Tensor, " sample"] | None:
    """Count the positions of the camera that each true point is seen from.

    A view sees a point that lies inside its picture and behind nothing else: by ray casting
    the true mesh with its surroundings and the face's front towards the camera, or, for a
    cloud, by the true depth maps. Views taken from one position (``capture.position``) count
    once, however many lights they were taken under.

    Args:
        diagonal: Of the object's bounding box, scene units.

    Returns:
        ``None`` where nothing tells: no cameras, or neither a mesh nor depth maps.
    """
    truth, cameras = capture.truth, capture.cameras
    if cameras is None or (truth.mesh is None and truth.depth is None):
        return None
    tolerance = _HIDDEN_BEHIND * diagonal
    caster = None
    if truth.mesh is not None and len(truth.mesh.faces):
        whole = joined(truth.mesh, truth.surroundings)
        caster = RayCaster(whole.vertices_world, whole.faces)
    elif truth.depth is None:
        return None
    count = torch.zeros(len(samples.points), dtype=torch.long)
    for position in torch.unique(capture.position):
        seen = torch.zeros(len(count), dtype=torch.bool)
        views = (capture.position == position).nonzero()[:, 0].tolist()
        # A ray caster sees the same in all of them; depth maps may have other holes.
        for view in views[:1] if caster is not None else views:
            if caster is not None:
                seen |= _seen_by_casting(samples, cameras, view, caster, tolerance)
            else:
                assert truth.depth is not None
                seen |= _seen_in_depth(samples, cameras, view, truth.depth[view], tolerance)
        count += seen
    return count


def joined(mesh: Mesh, other: Mesh | None) -> Mesh:
    """Put two surfaces in one, geometry only; the faces of ``mesh`` come first."""
    vertices = mesh.vertices_world
    if other is None:
        return Mesh(vertices_world=vertices, faces=mesh.faces)
    return Mesh(
        vertices_world=torch.cat([vertices, other.vertices_world.to(vertices)]),
        faces=torch.cat([mesh.faces, other.faces + len(vertices)]),
    )


def _seen_by_casting(
    samples: SurfaceSamples, cameras: Cameras, view: int, caster: RayCaster, tolerance: float
) -> Bool[Tensor, " sample"]:
    _, _, seen = _in_picture(samples.points, cameras, view)
    center = cameras.centers_world[view].to(samples.points)
    if samples.normals is not None:
        seen &= ((center - samples.points) * samples.normals).sum(dim=1) > 0
    asked = seen.nonzero()[:, 0]
    hidden = caster.occluded(samples.points[asked], center, tolerance)
    seen[asked[hidden]] = False
    return seen


def _seen_in_depth(
    samples: SurfaceSamples,
    cameras: Cameras,
    view: int,
    depth_true: Float[Tensor, "height width"],
    tolerance: float,
) -> Bool[Tensor, " sample"]:
    pixels, depth, seen = _in_picture(samples.points, cameras, view)
    column, row = pixels.nan_to_num(0).floor().long().unbind(dim=1)
    height, width = depth_true.shape
    there = depth_true[row.clamp(0, height - 1), column.clamp(0, width - 1)].to(depth)
    return seen & there.isfinite() & ((depth - there).abs() <= tolerance)


def _in_picture(
    points: Float[Tensor, "sample 3"], cameras: Cameras, view: int
) -> tuple[Float[Tensor, "sample 2"], Float[Tensor, " sample"], Bool[Tensor, " sample"]]:
    pixels, depth = project(
        points, cameras.cam_from_world[view].to(points), cameras.intrinsics[view].to(points)
    )
    size = cameras.sizes_px[view].to(points)
    return pixels, depth, (depth > 0) & ((pixels >= 0) & (pixels < size)).all(dim=1)
