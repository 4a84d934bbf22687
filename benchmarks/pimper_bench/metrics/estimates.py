"""Conversion of this package's results to estimates for evaluation."""

import torch

from pimper_torch.export.reports import common_lights
from pimper_torch.geometry.local_frame import NO_OFFSET, from_local
from pimper_torch.records import Estimate, Reconstruction


def estimate_of(result: Reconstruction) -> Estimate:
    """Return a run's estimate of the object, in the frame of its files.

    A view's light is that of all patches that determine it, NaN if none does; see
    :func:`pimper_torch.export.reports.common_lights`.
    """
    lights, counts = common_lights(result)
    names, offset = result.scene.views.names, result.scene.offset_world
    mesh, cameras = result.mesh, result.cameras
    if offset != NO_OFFSET:
        vertices = mesh.vertices_world.double()
        mesh = mesh.replace(vertices_world=vertices + vertices.new_tensor(offset))
        poses = from_local(cameras.cam_from_world, offset)
        intrinsics = cameras.intrinsics.double()
        cameras = cameras.replace(cam_from_world=poses, intrinsics=intrinsics)
    return Estimate(
        mesh=mesh,
        names=names,
        cameras=cameras,
        lights_world=torch.where(counts[:, None] > 0, lights, torch.nan),
        reference=names[result.coarse.reference],
    )
