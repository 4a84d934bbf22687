import pytest
import torch
from torch.nn.functional import interpolate, normalize
from torch.testing import assert_close

from pimper_torch.errors import InputError, PimperWarning
from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.priors.settled import settled
from pimper_torch.records import DepthPrior, NormalPrior
from pimper_torch.records.priors import AXES


def noisy(normals, degrees, seed=1):
    """Turn unit normals by so much, root mean square; where there are none, leave none."""
    generator = torch.Generator().manual_seed(seed)
    off = torch.randn(normals.shape, generator=generator) * torch.deg2rad(torch.tensor(degrees))
    there = normals.norm(dim=-1, keepdim=True) > 0.5
    return normalize(normals + off / 2**0.5, dim=-1) * there


def of_normals(scene, normals, **meaning):
    known = normals.norm(dim=-1) > 0.5
    return NormalPrior(
        names=scene.views.names,
        sizes_px=scene.views.sizes_px,
        normals=normals,
        variance=torch.where(known, 0.1, torch.inf),
        **meaning,
    )


def of_depth(scene, depth, **meaning):
    known = depth.isfinite()
    return DepthPrior(
        names=scene.views.names,
        sizes_px=scene.views.sizes_px,
        depth=torch.where(known, depth, 0),
        variance=torch.where(known, 0.01, torch.inf),
        **meaning,
    )


def settle(scene, prior, silhouettes=None):
    given = scene.replace(views=scene.views.replace(priors=(prior,)))
    (found,) = settled(given, silhouettes).views.priors
    assert found.undistorted
    return found


@pytest.mark.parametrize("outlines", [False, True])
@pytest.mark.parametrize("degrees", [0.0, 20.0])
@pytest.mark.parametrize("axes", [*AXES, "world"])
def test_axes_that_are_left_open_are_found_and_told(rendered, axes, degrees, outlines):
    scene, silhouettes = rendered.scene, rendered.silhouettes if outlines else None
    camera = noisy(rendered.camera, degrees)
    given = noisy(rendered.world, degrees)
    if axes != "world":
        given = camera * torch.tensor(AXES[axes][0])
    with pytest.warns(PimperWarning, match="are taken to be (camera|world) normals"):
        found = settle(scene, of_normals(scene, given, axes=None), silhouettes)
    assert found.axes == "opencv"
    assert found.frame == ("world" if axes == "world" else "camera")
    known = found.variance.isfinite()
    assert_close(found.normals[known], (given if axes == "world" else camera)[known])


@pytest.mark.parametrize(
    ("stated", "given", "what"),
    [
        ({}, "world", "world normals, given as camera normals in axes of OpenCV"),
        ({}, "lub", "in axes of DSINE .left, up, back., given as .* OpenCV"),
        ({"axes": "opengl"}, "lub", "in axes of DSINE .*, given as .* OpenGL"),
        ({"axes": "lub"}, "opencv", "axes of OpenCV, given as .* DSINE"),
        ({"frame": "world"}, "opengl", "axes of OpenGL, given as world normals"),
        ({"axes": None}, (-1, 1, 1), "OpenCV but for x, turned round, as no known estimator"),
        ({"axes": None}, (1, 1, -1), "OpenCV but for z, turned round"),
        ({}, "other world", "agree between views as they stand: they are world normals of another"),
    ],
)
@pytest.mark.parametrize("outlines", [False, True])
def test_normals_that_mean_something_else_are_refused_by_name(
    rendered, stated, given, what, outlines
):
    scene, silhouettes = rendered.scene, rendered.silhouettes if outlines else None
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(5))).Q
    if given == "world":
        normals = rendered.world
    elif given == "other world":
        normals = rendered.world @ turn
    else:
        normals = rendered.camera * torch.tensor(AXES[given][0] if given in AXES else given)
    with pytest.raises(InputError, match=what):
        settle(scene, of_normals(scene, noisy(normals, 10.0), **stated), silhouettes)


def test_stated_axes_that_fit_are_believed_without_a_word(rendered):
    scene = rendered.scene
    camera = noisy(rendered.camera, 20.0)
    found = settle(scene, of_normals(scene, -camera, axes="lub"))
    known = found.variance.isfinite()
    assert_close(found.normals[known], camera[known])
    found = settle(scene, of_normals(scene, rendered.world, frame="world"), rendered.silhouettes)
    assert found.frame == "world"


def test_where_nothing_tells_axes_are_to_be_stated(rendered):
    scene = rendered.scene
    bare = scene.replace(
        points_world=scene.points_world[:0],
        reprojection_errors_px=scene.reprojection_errors_px[:0],
        observation_point=scene.observation_point[:0],
        observation_view=scene.observation_view[:0],
        observation_pixels=scene.observation_pixels[:0],
    )
    upside_down = of_normals(bare, -rendered.camera)
    assert torch.equal(settle(bare, upside_down).normals, upside_down.normals)
    with pytest.raises(InputError, match=r"nothing tells whether they are .* State `axes`"):
        settle(bare, upside_down.replace(axes=None))
    depth = of_depth(bare, rendered.depth, inverse=True)
    assert torch.equal(settle(bare, depth).depth, depth.depth)
    with pytest.raises(InputError, match=r"too few points of the cloud tell .*`inverse`"):
        settle(bare, depth.replace(inverse=None))
    # Outlines alone tell the axes, too.
    with pytest.warns(PimperWarning, match="in axes of DSINE"):
        found = settle(bare, upside_down.replace(axes=None), rendered.silhouettes)
    assert_close(found.normals, rendered.camera)


def test_maps_of_some_photographs_and_of_another_size_tell_as_well(rendered):
    scene = rendered.scene
    small = interpolate(rendered.camera.movedim(-1, 1), (60, 80), mode="area").movedim(1, -1)
    there = small.norm(dim=-1, keepdim=True) > 0.9
    prior = of_normals(
        scene.replace(views=scene.views.replace(sizes_px=scene.views.sizes_px // 2)),
        -normalize(small, dim=-1) * there,
        axes=None,
    )
    with pytest.warns(PimperWarning, match="The normals of 4 photographs .* DSINE"):
        found = settle(scene, prior.take([9, 2, 5, 7]))
    assert found.names == tuple(scene.views.names[view] for view in (9, 2, 5, 7))


def lengths_of_rays(scene):
    K = scene.cameras.intrinsics[0]
    pixels = homogeneous(pixel_centers(160, 120, like=K))
    return (pixels @ torch.linalg.inv(K).mT).norm(dim=-1)


DEPTHS = {
    "metres": (lambda depth, _: 3 * depth, (False, "axis", "scale")),
    "affine": (lambda depth, _: 0.3 * depth - 0.5, (False, "axis", "affine")),
    "scene": (lambda depth, _: depth, (False, "axis", "scene")),
    "disparity": (lambda depth, _: 4 / depth - 0.1, (True, "axis", "affine")),
    "inverse": (lambda depth, _: 4 / depth, (True, "axis", "scale")),
    "distance": (lambda depth, rays: 2 * depth * rays, (False, "ray", "scale")),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_depth_that_is_left_open_is_found_and_told(rendered, kind):
    values, (inverse, along, gauge) = DEPTHS[kind]
    given = values(rendered.depth, lengths_of_rays(rendered.scene))
    prior = of_depth(rendered.scene, given, inverse=None)
    with pytest.warns(PimperWarning, match="is taken to be .* as the cloud shows: its median err"):
        found = settle(rendered.scene, prior)
    assert (found.inverse, found.along, found.gauge) == (inverse, along, gauge)
    assert torch.equal(found.depth, prior.depth)
    # Stated as what it is, it is believed without a word.
    assert settle(rendered.scene, found) == found


@pytest.mark.parametrize(
    ("kind", "stated", "what"),
    [
        ("disparity", {}, r"one over depth \(disparity\) .*, given as depth along the camera"),
        ("affine", {"inverse": True}, "is depth .*, given as one over depth"),
        ("distance", {}, "is depth along the ray, given as depth along the camera's axis"),
        ("affine", {"gauge": "scale"}, "is no depth up to a factor a map: its median error"),
        ("metres", {"gauge": "scene"}, "is no depth in the scene's unit"),
    ],
)
def test_depth_that_means_something_else_is_refused_by_name(rendered, kind, stated, what):
    given = DEPTHS[kind][0](rendered.depth, lengths_of_rays(rendered.scene))
    with pytest.raises(InputError, match=what):
        settle(rendered.scene, of_depth(rendered.scene, given, **stated))


@pytest.mark.parametrize("inverse", [None, False, True])
def test_depth_that_knows_nothing_of_the_scene_is_refused(rendered, inverse):
    """Such as maps of half the photograph that were stretched over all of it, upside down."""
    generator = torch.Generator().manual_seed(8)
    noise = torch.rand(12, 1, 6, 8, generator=generator)
    given = 1 + interpolate(noise, (120, 160), mode="bilinear", align_corners=False)[:, 0]
    with pytest.raises(InputError, match="fits the cloud no better than a plane"):
        settle(rendered.scene, of_depth(rendered.scene, given, inverse=inverse))


def test_a_relief_too_flat_to_tell_depth_is_believed_as_stated(rendered):
    """Such as a wall from the front, of which the cloud has one depth."""
    scene = rendered.scene
    points = scene.points_world
    pose = scene.cameras.cam_from_world[5]
    cam = points @ pose[:3, :3].mT + pose[:3, 3]
    flat = torch.cat([cam[:, :2] / cam[:, 2:], torch.ones_like(cam[:, 2:])], dim=1) * 7.0
    here = scene.observation_view == 5
    wall = scene.replace(
        points_world=(flat - pose[:3, 3]) @ pose[:3, :3],
        observation_point=scene.observation_point[here],
        observation_view=scene.observation_view[here],
        observation_pixels=scene.observation_pixels[here],
    )
    generator = torch.Generator().manual_seed(8)
    given = 1 + torch.rand(12, 120, 160, generator=generator)
    prior = of_depth(wall, given, inverse=True)
    assert torch.equal(settle(wall, prior).depth, prior.depth)
    with pytest.raises(InputError, match="too few points of the cloud tell what it is"):
        settle(wall, prior.replace(inverse=None))


def test_normals_that_know_nothing_of_the_scene_are_doubted(rendered):
    """Stated axes are believed with a warning; to find them is refused."""
    generator = torch.Generator().manual_seed(8)
    coarse = torch.randn(12, 3, 6, 8, generator=generator)
    random = interpolate(coarse, (120, 160), mode="bilinear", align_corners=False)
    random[:, 2] = -random[:, 2].abs() - 0.5
    normals = normalize(random.movedim(1, -1), dim=-1)
    with pytest.warns(PimperWarning, match="hardly fit cloud, outlines and cameras, to 0.0"):
        settle(rendered.scene, of_normals(rendered.scene, normals))
    with pytest.raises(InputError, match=r"nothing tells whether they .* State `axes`"):
        settle(rendered.scene, of_normals(rendered.scene, normals, axes=None))


def test_gradients_reach_what_was_given(rendered):
    normals = (-rendered.camera).requires_grad_()
    found = settle(rendered.scene, of_normals(rendered.scene, normals, axes="lub"))
    found.normals.sum().backward()
    assert (normals.grad == -1).all()


def test_without_priors_a_scene_stays_as_it_is(rendered):
    assert settled(rendered.scene) is rendered.scene
