"""Sides without cameras are named where the mesh is open."""

import math

import pytest
import torch
from scenes import ball

from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.stages.verdict.sides import unphotographed

UP = torch.tensor([0.0, 1.0, 0.0])


def cameras(elevation_deg, span_deg):
    """Return cameras on an arc around the origin that begins at the z axis."""
    count, up = 12, math.radians(elevation_deg)
    angles = torch.arange(count) * math.radians(span_deg) / count
    level = torch.stack([angles.sin(), torch.zeros(count), angles.cos()], dim=1)
    eyes = 5 * (math.cos(up) * level + math.sin(up) * UP)
    return pinholes(look_at(eyes, torch.zeros(3), UP), 100.0, 64, 48)


def without(mesh, direction, cosine=0.7):
    """Return a ball without the faces around a direction."""
    centers = mesh.vertices_world[mesh.faces].mean(dim=1)
    return mesh.replace(faces=mesh.faces[centers @ torch.tensor(direction) < cosine])


DOWN, BACK = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)


@pytest.mark.parametrize(
    ("removed", "given", "named"),
    [
        ((), cameras(15, 360), []),
        ((DOWN,), cameras(15, 360), ["underside"]),
        ((DOWN,), cameras(-40, 360), []),
        (((0.0, 1.0, 0.0),), cameras(0, 360), ["top"]),
        ((BACK, DOWN), cameras(15, 1), ["back", "underside"]),
        ((DOWN,), cameras(15, 1), ["underside"]),
        ((BACK,), cameras(15, 360), []),
    ],
)
def test_an_open_side_without_cameras_is_named(removed, given, named):
    mesh = ball(level=3).to(torch.float32)
    for direction in removed:
        mesh = without(mesh, direction)
    assert unphotographed(mesh, given) == named
