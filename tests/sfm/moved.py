"""Two rigid bodies: an object, and the table on which it is moved."""

import torch

from pimper_bench.scenes.scene_cameras import turntable_directions
from pimper_bench.scenes.whole_scene import upside_down
from pimper_torch.geometry.pinholes import look_at
from pimper_torch.geometry.projection import project
from pimper_torch.geometry.rigid import transform

K = torch.tensor([[400.0, 0, 160], [0, 400, 120], [0, 0, 1]]).double()


def poses(num_views, elevation_deg=25.0):
    toward = turntable_directions(num_views, elevation_deg=elevation_deg)
    target = toward.new_tensor([0.0, 0.0, 0.5])
    return look_at(target + 4.5 * toward, target, toward.new_tensor([0.0, 0.0, 1.0]))


def bodies(generator, num_object=60, num_table=90):
    """Return points of a unit box on z = 0, and of the table around it."""
    own = torch.rand(num_object, 3, generator=generator, dtype=torch.float64)
    own = own - own.new_tensor([0.5, 0.5, 0.0])
    own[0], own[1] = own.new_tensor([-0.5, -0.5, 0.0]), own.new_tensor([0.5, 0.5, 1.0])
    table = 3 * torch.rand(num_table, 3, generator=generator, dtype=torch.float64) - 1.5
    table[:, 2] = 0
    return own, table


def photographed(sessions, generator, **counts):
    """Return pixels of all points in all views, object first; it is turned over in session 1."""
    own, table = bodies(generator, **counts)
    over = transform(upside_down(own), own)
    cameras = poses(len(sessions) // 2).repeat(2, 1, 1) if 1 in sessions else poses(len(sessions))
    placed = [torch.cat([over if one else own, table]) for one in sessions]
    return [
        project(points, camera, K)[0] for points, camera in zip(placed, cameras, strict=True)
    ], len(own)
