"""Features of points in photographs, in random order, and their matches."""

import torch
from torch import Tensor

from pimper_bench.scenes.scene_cameras import FRONT, UP, arc_cameras
from pimper_torch.geometry.projection import project
from pimper_torch.records import Cameras
from pimper_torch.stages.sfm.static_background import StaticBackground, find_static_background

WIDTH, HEIGHT, FOCAL = 640, 480, 1000.0


class Captured:
    """Features with matches of all common points, one in ten of which is wrong.

    Args:
        generator: Draws the order, the noise of 0.2 px and the wrong matches.
        pixels: Pixels of points, ``view thing 2``; NaN if not seen.
    """

    def __init__(self, generator: torch.Generator, pixels: Tensor) -> None:
        self.thing, self.keypoints = [], []
        for view in pixels:
            seen = torch.nonzero(view.isfinite().all(dim=1))[:, 0]
            order = seen[torch.randperm(len(seen), generator=generator)]
            self.thing.append(order)
            noise = 0.2 * torch.randn(len(order), 2, generator=generator, dtype=torch.float64)
            self.keypoints.append((view[order] + noise).float())
        self.pairs = {
            (first, second): self._matches(first, second, generator)
            for second in range(len(pixels))
            for first in range(second)
        }

    def _matches(self, first: int, second: int, generator: torch.Generator) -> Tensor:
        one, other = torch.nonzero(self.thing[first][:, None] == self.thing[second], as_tuple=True)
        (wrong,) = torch.nonzero(torch.rand(len(one), generator=generator) < 0.1, as_tuple=True)
        other[wrong] = other[wrong][torch.randperm(len(wrong), generator=generator)]
        return torch.stack([one, other], dim=1)

    def right(self, pair: tuple[int, int], rows: Tensor) -> Tensor:
        """Return which matches are correct, as after verification."""
        one, other = rows.unbind(dim=1)
        return self.thing[pair[0]][one] == self.thing[pair[1]][other]

    def rest(self) -> StaticBackground:
        """Find the static background."""
        return find_static_background(
            self.keypoints,
            self.pairs,
            lambda pairs: {pair: rows[self.right(pair, rows)] for pair, rows in pairs.items()},
            max_error_px=2.0,
        )


def orbit(count: int, span_deg: float, elevation_deg: float = 25.0) -> Cameras:
    """Return cameras around the origin that look down on it."""
    return arc_cameras(
        count,
        width=WIDTH,
        height=HEIGHT,
        focal_px=FOCAL,
        distance=8.0,
        span_deg=span_deg,
        elevation_deg=elevation_deg,
        sway_deg=0.0,
        front=FRONT,
        up=UP,
    )


def seen_of_ball(generator: torch.Generator, count: int, cameras: Cameras) -> Tensor:
    """Return pixels ``view point 2`` of random points on a unit ball; NaN on its far side."""
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points = points / points.norm(dim=1, keepdim=True)
    pixels, _ = project(points, cameras.cam_from_world, cameras.intrinsics)
    toward = cameras.centers_world[:, None] - points
    hidden = torch.einsum("vpi,pi->vp", toward, points) < 0
    return pixels.masked_fill(hidden[..., None], torch.nan)


def turntable(
    generator: torch.Generator,
    *,
    turning: int = 500,
    resting: int = 200,
    elevation_deg: float = 25.0,
    count: int = 12,
    span_deg: float = 330.0,
) -> Captured:
    """Turn a ball in front of a static background, whose points start at ``turning``.

    Args:
        generator: Random generator.
        turning: Number of points of the ball.
        resting: Number of points of the background.
        elevation_deg: Elevation of the camera.
        count: Number of photographs.
        span_deg: Total rotation of the ball.
    """
    cameras = orbit(count, span_deg, elevation_deg)
    ball = seen_of_ball(generator, turning, cameras)
    detected = torch.rand(resting, 2, generator=generator, dtype=torch.float64)
    detected = detected * detected.new_tensor([WIDTH, HEIGHT])
    return Captured(generator, torch.cat([ball, detected.expand(count, -1, -1)], dim=1))
