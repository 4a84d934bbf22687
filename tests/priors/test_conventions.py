import pytest
import torch
from scenes import observing, without_points
from torch.nn.functional import interpolate, normalize
from torch.testing import assert_close

from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.io.decode import rotated
from pimper_torch.priors.at_points import reoriented, reoriented_vectors
from pimper_torch.priors.conventions import resolve_prior_conventions
from pimper_torch.records import DepthPrior, NormalPrior
from pimper_torch.records.priors import AXES
from pimper_torch.records.scene import with_views
from pimper_torch.runtime.errors import InputError, PimperWarning


def noisy(normals, degrees, seed=1):
    """Rotate unit normals by ``degrees``, root mean square; missing ones stay missing."""
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
    (found,) = resolve_prior_conventions(given, silhouettes).views.priors
    assert found.undistorted
    return found


@pytest.mark.parametrize(("degrees", "outlines"), [(0.0, False), (20.0, True)])
@pytest.mark.parametrize("axes", [*AXES, "world"])
def test_unstated_axes_are_found_and_reported(rendered, axes, degrees, outlines):
    scene, silhouettes = rendered.scene, rendered.silhouettes if outlines else None
    camera = noisy(rendered.camera, degrees)
    given = noisy(rendered.world, degrees)
    if axes != "world":
        given = camera * torch.tensor(AXES[axes][0])
    with pytest.warns(PimperWarning, match="are interpreted as (camera|world) normals"):
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
        ({"axes": None}, (-1, 1, 1), "OpenCV with x reversed, as no known network"),
        ({"axes": None}, (1, 1, -1), "OpenCV with z reversed"),
        ({}, "other world", "are consistent, but in a different world frame"),
    ],
)
@pytest.mark.parametrize("outlines", [False, True])
def test_normals_of_a_different_convention_are_refused_by_name(
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


@pytest.mark.parametrize("outlines", [False, True])
@pytest.mark.parametrize("stated", [None, "opengl"])
@pytest.mark.parametrize("axes", AXES)
def test_exchanged_channels_are_corrected_and_reported(rendered, axes, stated, outlines):
    scene, silhouettes = rendered.scene, rendered.silhouettes if outlines else None
    camera = noisy(rendered.camera, 20.0)
    written = (camera * torch.tensor(AXES[axes][0])).flip(-1)  # BGR, as OpenCV writes RGB
    if stated not in (None, axes):
        with (
            pytest.warns(PimperWarning, match="exchanged"),
            pytest.raises(InputError, match="given"),
        ):
            settle(scene, of_normals(scene, written, axes=stated), silhouettes)
        return
    with pytest.warns(PimperWarning) as caught:
        found = settle(scene, of_normals(scene, written, axes=stated), silhouettes)
    assert "have red and blue exchanged, as in images that OpenCV" in str(caught[0].message)
    assert len(caught) == 1 + (stated is None)
    known = found.variance.isfinite()
    assert_close(found.normals[known], camera[known])


def stored(maps, tags):
    """Return maps as stored, before EXIF rotates them by 180 degrees or mirrors them."""
    flips = {1: (), 2: (1,), 3: (0, 1), 4: (0,)}
    return torch.stack([one.flip(flips[tag]) for one, tag in zip(maps, tags, strict=True)])


TURNED = {
    "mirrored left to right": ([2] * 12, False),
    "mirrored top to bottom": ([4] * 12, False),
    "for the pixels as stored, without EXIF's orientation": ([3, 1, 3] * 4, True),
}


@pytest.mark.parametrize("outlines", [False, True])
@pytest.mark.parametrize("alone", [False, True])  # the object without its table
@pytest.mark.parametrize("what", TURNED)
def test_rotated_normal_maps_are_refused_with_the_reason(rendered, what, alone, outlines):
    tags, in_files = TURNED[what]
    scene, silhouettes = rendered.scene, rendered.silhouettes if outlines else None
    camera = noisy(rendered.camera, 20.0)
    if alone:
        camera = camera * (rendered.silhouettes.inside > 0.5)[..., None]
    signs = torch.tensor([[1 - 2 * (tag in (2, 3)), 1 - 2 * (tag in (3, 4)), 1] for tag in tags])
    found_by_network = stored(camera, tags) * signs[:, None, None]  # of the image as stored
    if in_files:
        scene = scene.replace(views=scene.views.replace(orientations=torch.tensor(tags)))
    for given, axes in ((stored(camera, tags), None), (found_by_network, "opencv")):
        with pytest.raises(InputError, match=f"are {what}, as cloud.* Orient maps and vectors"):
            settle(scene, of_normals(scene, given, axes=axes), silhouettes)


def test_consistent_stated_axes_give_no_warning(rendered):
    scene = rendered.scene
    camera = noisy(rendered.camera, 20.0)
    found = settle(scene, of_normals(scene, -camera, axes="lub"))
    known = found.variance.isfinite()
    assert_close(found.normals[known], camera[known])
    found = settle(scene, of_normals(scene, rendered.world, frame="world"), rendered.silhouettes)
    assert found.frame == "world"


def test_undetermined_axes_must_be_stated(rendered):
    scene = rendered.scene
    bare = without_points(scene)
    upside_down = of_normals(bare, -rendered.camera)
    assert torch.equal(settle(bare, upside_down).normals, upside_down.normals)
    with pytest.raises(InputError, match=r"the scene does not show if they are .* State `axes`"):
        settle(bare, upside_down.replace(axes=None))
    depth = of_depth(bare, rendered.depth, gauge="scene")
    assert torch.equal(settle(bare, depth).depth, depth.depth)
    with pytest.raises(InputError, match=r"too few points of the cloud determine .*`inverse`"):
        settle(bare, depth.replace(inverse=None))
    # Contours alone also determine the axes.
    with pytest.warns(PimperWarning, match="in axes of DSINE"):
        found = settle(bare, upside_down.replace(axes=None), rendered.silhouettes)
    assert_close(found.normals, rendered.camera)


def test_axes_are_found_from_maps_of_some_photographs_and_of_a_different_size(rendered):
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
    "metres": (lambda depth, _: 3 * depth, "depth along the camera's axis up to a factor per map"),
    "affine": (lambda depth, _: 0.3 * depth - 0.5, "axis up to a factor and an offset per map"),
    "scene": (lambda depth, _: depth, "depth along the camera's axis in the scene's unit"),
    "disparity": (lambda z, _: 4 / z - 0.1, "disparity. along the camera's .* an offset per map"),
    "inverse": (lambda z, _: 4 / z, "disparity. along the camera's axis up to a factor per map"),
    "distance": (lambda z, rays: 2 * z * rays, "depth along the ray up to a factor per map"),
}


@pytest.mark.parametrize("kind", DEPTHS)
def test_unstated_depth_conventions_are_found_reported_and_converted(rendered, kind):
    values, what = DEPTHS[kind]
    given = values(rendered.depth, lengths_of_rays(rendered.scene))
    given = torch.where(rendered.depth.isfinite(), given, torch.inf)
    # 1 % of depth is also 1 % of values proportional to depth or to its inverse.
    spread = {"affine": 0.3 * rendered.depth, "disparity": 4 / rendered.depth}.get(kind, given)
    prior = of_depth(rendered.scene, given, inverse=None)
    known = prior.variance.isfinite()
    prior = prior.replace(variance=torch.where(known, (0.01 * spread) ** 2, torch.inf))
    with pytest.warns(PimperWarning, match=f"is interpreted as .*{what}, which fits .* best: its "):
        found = settle(rendered.scene, prior)
    assert (found.inverse, found.along, found.gauge) == (False, "axis", "scene")
    assert torch.equal(found.variance.isfinite(), known)
    ratio = found.depth[known] / rendered.depth[known]
    assert_close(ratio, torch.ones_like(ratio), rtol=0, atol=0.005)
    assert_close(
        found.variance[known].sqrt() / rendered.depth[known], 0.01 * ratio, rtol=0.01, atol=0
    )
    again = settle(rendered.scene, found)
    assert again.depth is found.depth
    assert again.variance is found.variance


def test_a_standard_error_is_at_least_the_error_at_the_cloud(rendered):
    generator = torch.Generator().manual_seed(6)
    noise = 1 + 0.04 * torch.randn(rendered.depth.shape, generator=generator)
    prior = of_depth(rendered.scene, rendered.depth * noise, gauge="scale")
    found = settle(rendered.scene, prior.replace(variance=1e-4 * prior.variance))
    known = found.variance.isfinite()
    errors = found.variance[known].sqrt() / found.depth[known]
    assert errors.min() > 0.025
    assert errors.max() < 0.055


def test_maps_of_removed_photographs_are_ignored(rendered):
    scene = rendered.scene
    ray = 2 * rendered.depth * lengths_of_rays(scene)
    depth = of_depth(scene, ray, along="ray", gauge="scale").replace(undistorted=True)
    normals = of_normals(scene, -rendered.camera, axes="lub").replace(undistorted=True)
    kept = torch.arange(12) % 3 > 0
    fewer = with_views(scene.replace(views=scene.views.replace(priors=(depth, normals))), kept)
    depth, normals = resolve_prior_conventions(fewer).views.priors
    assert depth.names == normals.names == fewer.views.names
    known = depth.variance.isfinite()
    assert_close(depth.depth[known], rendered.depth[kept][known], rtol=0.005, atol=0)
    none = scene.replace(views=scene.views.replace(names=tuple("abcdefghijkl")))
    alone = none.replace(views=none.views.replace(priors=(depth,)))
    assert resolve_prior_conventions(alone) == alone
    assert resolve_prior_conventions(rendered.scene) is rendered.scene


def test_a_depth_map_without_observed_points_is_ignored(rendered):
    scene = rendered.scene
    there = scene.observation_view != 4
    scene = observing(scene, there)
    depth = (3 * rendered.depth).requires_grad_()
    found = settle(scene, of_depth(scene, depth, gauge="scale"))
    assert found.variance[4].isinf().all()
    assert found.variance[3].isfinite().any()
    known = found.variance.isfinite()
    found.depth[known].sum().backward()
    assert (depth.grad[4] == 0).all()
    assert_close(depth.grad[known], torch.full_like(depth.grad[known], 1 / 3), rtol=0.01, atol=0)


@pytest.mark.parametrize(
    ("kind", "stated", "what"),
    [
        ("disparity", {}, r"inverse depth \(disparity\) .*, given as depth along the camera"),
        ("affine", {"inverse": True}, "is depth .*, given as inverse depth"),
        ("distance", {}, "is depth along the ray, given as depth along the camera's axis"),
        ("affine", {"gauge": "scale"}, "is not depth up to a factor per map: its median error"),
        ("metres", {"gauge": "scene"}, "is not depth in the scene's unit"),
    ],
)
def test_depth_of_a_different_convention_is_refused_by_name(rendered, kind, stated, what):
    given = DEPTHS[kind][0](rendered.depth, lengths_of_rays(rendered.scene))
    with pytest.raises(InputError, match=what):
        settle(rendered.scene, of_depth(rendered.scene, given, **stated))


@pytest.mark.parametrize("kind", ["metres", "disparity"])
@pytest.mark.parametrize("alone", [False, True])
@pytest.mark.parametrize("what", TURNED)
def test_rotated_depth_maps_are_refused_with_the_reason(rendered, what, alone, kind):
    tags, in_files = TURNED[what]
    scene = rendered.scene
    given = DEPTHS[kind][0](rendered.depth, lengths_of_rays(scene))
    if alone:
        given = torch.where(rendered.silhouettes.inside > 0.5, given, torch.nan)
    if in_files:
        scene = scene.replace(views=scene.views.replace(orientations=torch.tensor(tags)))
    prior = of_depth(scene, stored(given, tags), inverse=None if kind == "metres" else True)
    with pytest.raises(InputError, match=f"The depth of .* is {what}, as the cloud shows"):
        settle(scene, prior)


@pytest.mark.parametrize("tag", range(1, 9))
def test_pixels_and_vectors_are_transformed_like_rotated_maps(rendered, tag):
    width = 5 if tag < 5 else 4
    maps = torch.arange(2 * 4 * width).reshape(2, 4, width)
    upright = torch.stack([torch.from_numpy(rotated(one.numpy(), tag)) for one in maps])
    prior = of_normals(rendered.scene, rendered.camera).take([0, 1])
    prior = prior.replace(sizes_px=torch.tensor([[width, 4]] * 2))
    place = torch.cartesian_prod(torch.arange(2), torch.arange(4), torch.arange(width))
    found = reoriented(place, prior, torch.tensor([tag, tag]))
    assert torch.equal(maps[found.unbind(dim=1)], upright[place.unbind(dim=1)])
    # Vectors in pixels: the transformed steps to the right and down.
    corners = torch.tensor([[0, 0, 0], [0, 0, 1], [0, 1, 0]])
    row, column = (
        torch.stack([(upright[0] == maps[tuple(one)]).nonzero()[0] for one in corners])
    ).T
    steps = torch.stack([column[1:] - column[0], row[1:] - row[0]], dim=1).float()
    found = reoriented_vectors(torch.eye(3)[:2], torch.tensor([tag, tag]))
    assert torch.equal(found[:, :2], steps)


@pytest.mark.parametrize("inverse", [None, False, True])
def test_depth_unrelated_to_the_scene_is_refused(rendered, inverse):
    """For example maps of half the photograph, stretched over all of it and upside down."""
    generator = torch.Generator().manual_seed(8)
    noise = torch.rand(12, 1, 6, 8, generator=generator)
    given = 1 + interpolate(noise, (120, 160), mode="bilinear", align_corners=False)[:, 0]
    with pytest.raises(InputError, match="fits the point cloud no better than"):
        settle(rendered.scene, of_depth(rendered.scene, given, inverse=inverse))


def test_on_a_flat_relief_stated_depth_conventions_are_used(rendered):
    """For example a frontal wall: all points have the same depth."""
    scene = rendered.scene
    points = scene.points_world
    pose = scene.cameras.cam_from_world[5]
    cam = points @ pose[:3, :3].mT + pose[:3, 3]
    flat = torch.cat([cam[:, :2] / cam[:, 2:], torch.ones_like(cam[:, 2:])], dim=1) * 7.0
    here = scene.observation_view == 5
    wall = observing(scene, here).replace(points_world=(flat - pose[:3, 3]) @ pose[:3, :3])
    generator = torch.Generator().manual_seed(8)
    given = 1 + torch.rand(12, 120, 160, generator=generator)
    prior = of_depth(wall, given, inverse=True)
    found = settle(wall, prior)
    assert found.gauge == "scene"
    known = found.variance[5].isfinite()
    assert known.any()
    assert_close(
        found.depth[5][known], torch.full_like(found.depth[5][known], 7), rtol=1e-3, atol=0
    )
    with pytest.raises(InputError, match="too few points of the cloud determine its"):
        settle(wall, prior.replace(inverse=None))


def test_normals_unrelated_to_the_scene_give_a_warning_or_error(rendered):
    """Stated axes give a warning; unstated ones an error."""
    generator = torch.Generator().manual_seed(8)
    coarse = torch.randn(12, 3, 6, 8, generator=generator)
    random = interpolate(coarse, (120, 160), mode="bilinear", align_corners=False)
    random[:, 2] = -random[:, 2].abs() - 0.5
    normals = normalize(random.movedim(1, -1), dim=-1)
    with pytest.warns(PimperWarning, match="hardly fit cloud, outlines and cameras, to 0.0"):
        settle(rendered.scene, of_normals(rendered.scene, normals))
    with pytest.raises(InputError, match=r"hardly fit .* of 1, in any axes. .* mixed up.$"):
        settle(rendered.scene, of_normals(rendered.scene, normals, axes=None))


def test_the_advice_to_state_axes_is_given_where_they_can_be_stated(rendered):
    for given, end in (
        ((1, -1, -1), "State `axes`, or convert them."),
        ((-1, 1, 1), "Convert them."),
    ):
        written = rendered.camera * torch.tensor(given)
        with pytest.raises(InputError) as refused:
            settle(rendered.scene, of_normals(rendered.scene, written))
        assert str(refused.value).endswith(f"show. {end}")


@pytest.mark.parametrize("given", ["lub", "world", "mirrored", "exchanged", "random"])
def test_normals_of_a_network_in_training_are_used_as_stated(rendered, given):
    scene, camera = rendered.scene, rendered.camera
    random = torch.randn(camera.shape, generator=torch.Generator().manual_seed(0))
    written = {
        "lub": -camera,
        "world": rendered.world,
        "mirrored": camera.flip(2),
        "exchanged": camera.flip(-1),
        "random": normalize(random, dim=-1),
    }[given].requires_grad_()
    with pytest.warns(PimperWarning, match="require gradients contradict the scene") as caught:
        found = settle(scene, of_normals(scene, written, axes="opengl"))
    assert len({str(one.message) for one in caught}) == 1
    known = found.variance.isfinite()
    assert_close(found.normals[known], (written * torch.tensor([1.0, -1.0, -1.0]))[known])


def test_unstated_axes_of_a_network_in_training_are_refused(rendered):
    random = torch.randn(rendered.camera.shape, generator=torch.Generator().manual_seed(0))
    normals = normalize(random, dim=-1).requires_grad_()
    with pytest.raises(InputError, match="State `axes`"):
        settle(rendered.scene, of_normals(rendered.scene, normals, axes=None))


@pytest.mark.parametrize("given", ["inverse", "constant", "mirrored"])
def test_depth_of_a_network_in_training_is_used_as_stated(rendered, given):
    scene, depth = rendered.scene, rendered.depth
    written = (
        {
            "inverse": 1 / depth,
            "constant": torch.full_like(depth, 2.0)
            + torch.rand(depth.shape, generator=torch.Generator().manual_seed(0)),
            "mirrored": depth.flip(2),
        }[given]
        .nan_to_num(1.0, 1.0, 1.0)
        .requires_grad_()
    )
    with pytest.warns(PimperWarning, match="require gradients contradict the scene"):
        found = settle(scene, of_depth(scene, written, gauge="affine"))
    found.depth.sum().backward()
    assert written.grad.isfinite().all()
    with pytest.raises(InputError):
        settle(scene, of_depth(scene, written.detach(), gauge="affine"))


def test_gradients_reach_the_given_maps(rendered):
    normals = (-rendered.camera).requires_grad_()
    found = settle(rendered.scene, of_normals(rendered.scene, normals, axes="lub"))
    found.normals.sum().backward()
    assert (normals.grad == -1).all()
