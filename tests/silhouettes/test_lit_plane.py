"""The light, albedo and level of shadow of a plane, from photographs of known ones."""

import pytest
import torch

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.projection import rays_through
from pimper_torch.geometry.supporting_plane import Plane, fixation
from pimper_torch.stages.silhouettes.lit_plane import lit_plane
from pimper_torch.stages.silhouettes.parallax import working_pictures

PLANE = Plane(normal_world=torch.tensor([0.0, 0, 1]), offset=torch.tensor(0.0))


@pytest.fixture(scope="module")
def lit(staged):
    """Return a plane under another light in every view, with a moving shadow and a pale disc.

    Also the logarithms of albedo and light, and where the shadow and the disc are.
    """
    cameras = staged.scene.cameras
    pixels = pixel_centers(240, 180, like=cameras.intrinsics).reshape(-1, 2)
    rays = rays_through(pixels, cameras.cam_from_world, cameras.intrinsics)
    places = (
        cameras.centers_world[:, None] - rays * (cameras.centers_world[:, None, 2:] / rays[..., 2:])
    )[..., :2]
    x, y = places.unbind(dim=-1)
    albedo = 0.4 * torch.sin(9 * x) * torch.sin(7 * y)
    slope = torch.linspace(-0.3, 0.3, 12)[:, None]
    light = slope * x + 0.1 * y - 0.1 * slope.abs() * x * y
    angle = torch.linspace(0, 5.8, 12)[:, None]
    shadow = (x - 0.5 * angle.cos()) ** 2 + (y - 0.5 * angle.sin()) ** 2 < 0.22**2
    disc = x**2 + y**2 < 0.15**2
    grey = albedo + light - 1.5 - 1.2 * shadow + 0.8 * disc
    images = grey.exp().reshape(12, 1, 180, 240).expand(-1, 3, -1, -1)
    pictures = working_pictures(staged.scene.views.replace(images=images), cameras, 240)
    masks = [mask.reshape(12, 180, 240) for mask in (shadow, disc)]
    target = fixation(pictures.cameras.cam_from_world)
    return pictures, lit_plane(pictures, PLANE, target, masks[1]), masks


def test_a_lit_plane_leaves_no_residual(lit):
    pictures, plane, (shadow, disc) = lit
    for view in range(0, 12, 3):
        residual, support = plane.residual(view, pictures.grey[view])
        known = (support > 0.9) & ~disc[view]
        assert known.float().mean() > 0.5
        assert residual[known & ~shadow[view]].abs().median() < 0.06
        assert (residual[known & ~shadow[view]].abs() < 0.15).float().mean() > 0.9


def test_the_level_of_cast_shadow_is_found(lit):
    pictures, plane, (shadow, disc) = lit
    assert (plane.shadow + 1.2).abs().max() < 0.2
    residual, support = plane.residual(5, pictures.grey[5])
    dark = shadow[5] & (support > 0.9) & ~disc[5]
    assert ((residual[dark] - plane.shadow[5]).abs() < 0.25).float().mean() > 0.9


def test_what_masks_hide_is_unknown(lit):
    pictures, plane, (_, disc) = lit
    for view in (2, 9):
        _, support = plane.residual(view, pictures.grey[view])
        assert (support[disc[view]] == 0).float().mean() > 0.7


def test_few_views_leave_the_plane_unknown(staged):
    cameras = staged.scene.cameras.take([0, 1])
    views = staged.scene.views
    two = views.replace(
        images=views.images[:2], sizes_px=views.sizes_px[:2], names=views.names[:2],
        focals_px=views.focals_px[:2],
    )  # fmt: skip
    pictures = working_pictures(two, cameras, 240)
    plane = lit_plane(pictures, PLANE, fixation(cameras.cam_from_world))
    residual, support = plane.residual(0, pictures.grey[0])
    assert not residual.any()
    assert not support.any()
