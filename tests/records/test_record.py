import dataclasses
from dataclasses import dataclass

import pytest
import torch
from sparse_models import views_of
from torch.utils import _pytree as pytree

from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_torch.records import Cameras, Convergence, Photometry, Record, SparseScene, Views
from pimper_torch.records.patches import Templates
from pimper_torch.runtime.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Box(Record):
    inside: Cameras
    many: tuple[torch.Tensor, ...]
    label: str
    nothing: torch.Tensor | None = None


@pytest.fixture
def cameras():
    return arc_cameras(2, width=6, height=4, focal_px=5.0, distance=3.0)


@pytest.fixture
def views():
    return views_of(torch.zeros(2, 3, 4, 6))


@pytest.mark.parametrize("device", [None, "cpu", "meta"])
@pytest.mark.parametrize("dtype", [None, torch.float64])
def test_moving_a_record_moves_all_nested_tensors(cameras, device, dtype):
    many = (torch.zeros(2), torch.ones(3) > 0, torch.arange(4))
    box = Box(inside=cameras.to(torch.float32), many=many, label="box")
    moved = box.to(device or dtype or "cpu", dtype if device else None)
    kind = dtype or torch.float32  # only of floating-point tensors
    assert moved.inside.intrinsics.dtype == kind
    assert moved.inside.sizes_px.dtype == torch.int64
    assert [tensor.dtype for tensor in moved.many] == [kind, torch.bool, torch.int64]
    tensors = (moved.inside.intrinsics, moved.inside.sizes_px, *moved.many)
    assert {tensor.device.type for tensor in tensors} == {device or "cpu"}
    assert (moved.label, moved.nothing) == ("box", None)
    assert box.inside.intrinsics.device.type == "cpu"


def test_replace_changes_only_a_copy(cameras):
    farther = cameras.replace(sizes_px=cameras.sizes_px * 2)
    assert farther.sizes_px[0].tolist() == [12, 8]
    assert cameras.sizes_px[0].tolist() == [6, 4]
    assert farther.intrinsics is cameras.intrinsics
    with pytest.raises(TypeError):
        cameras.replace(extrinsics=cameras.cam_from_world)


def test_a_record_cannot_be_rebound_or_extended(cameras):
    with pytest.raises(dataclasses.FrozenInstanceError):
        cameras.intrinsics = cameras.intrinsics * 2
    with pytest.raises((AttributeError, TypeError)):
        cameras.note = "frontal"


def test_a_record_shows_shapes_instead_of_numbers(cameras):
    shown = repr(Box(inside=cameras, many=tuple(torch.zeros(n) for n in range(5)), label="box"))
    assert "intrinsics=float64[2, 3, 3]" in shown
    assert "(float32[0], ... 5 in all)" in shown
    assert "label='box'" in shown
    assert len(shown) < 300


@pytest.mark.usefixtures("shapes_unchecked")
def test_tensors_of_the_wrong_shape_or_kind_are_refused(cameras, views):
    with pytest.raises(InputError, match=r"Cameras.cam_from_world is float64\[1, 4, 4\]; needed: "):
        cameras.replace(cam_from_world=cameras.cam_from_world[:1])  # one camera, two intrinsics
    with pytest.raises(InputError, match=r"sizes_px is float64\[2, 2\]; needed: Int of shape"):
        cameras.replace(sizes_px=cameras.sizes_px.double())  # sizes are integers
    with pytest.raises(InputError, match=r"shape \(view channel height width\)"):
        views.replace(images=torch.zeros(3, 3))
    with pytest.raises(InputError, match=r"masks is 3; needed: Bool .* or None, next to images"):
        views.replace(masks=3)


def test_take_and_concatenate_are_inverse(cameras):
    views = views_of(torch.arange(3.0)[:, None, None, None].expand(3, 3, 4, 6))
    some = views.take([2, 0])
    assert some.names == ("2.png", "0.png")
    assert some.images[:, 0, 0, 0].tolist() == [2, 0]
    assert some.masks is None
    assert views.take(torch.tensor([False, True, False])).names == ("1.png",)
    assert views.take(slice(1, None)).names == ("1.png", "2.png")
    assert views.take([0, 1, 2]) is views  # photographs are not copied
    whole = Views.cat([some, views.take([1])])
    assert whole.names == ("2.png", "0.png", "1.png")
    assert torch.equal(whole.take([1, 2, 0]).images, views.images)
    both = Cameras.cat([cameras, cameras])
    assert torch.equal(both.take([2, 3]).cam_from_world, cameras.cam_from_world)
    with pytest.raises(InputError, match="some records have masks and others do not"):
        Views.cat([views, views.replace(masks=torch.ones(3, 4, 6, dtype=torch.bool))])


def test_take_applies_to_nested_records():
    convergence = Convergence(
        iterations=torch.arange(3), residual=torch.zeros(3), cause=torch.zeros(3).long()
    )
    photometry = Photometry(
        normals_patch=torch.zeros(3, 2, 2, 3),
        albedo=torch.zeros(3, 2, 2, 1),
        lights_patch=torch.zeros(3, 5, 4),
        valid=torch.zeros(3, 2, 2, dtype=torch.bool),
        information=torch.zeros(3, 2, 2),
        status=torch.zeros(3).long(),
        convergence=convergence,
    )
    assert photometry.take([2]).convergence.iterations.tolist() == [2]
    assert Photometry.cat([photometry, photometry]).convergence.iterations.tolist() == [0, 1, 2] * 2


def test_a_record_is_a_pytree(cameras):
    leaves, spec = pytree.tree_flatten(cameras)
    assert [leaf.shape for leaf in leaves] == [(2, 3, 3), (2, 4, 4), (2, 2)]
    again = pytree.tree_unflatten(leaves, spec)
    assert torch.equal(again.intrinsics, cameras.intrinsics)
    axes = pytree.tree_map(lambda _: 0, cameras)  # leaves of any type, as for vmap's `in_dims`
    far = torch.func.vmap(lambda one: one.cam_from_world[:3, 3].norm(), in_dims=(axes,))(cameras)
    assert far.shape == (2,)


def test_detached_records_have_no_graph(cameras):
    moved = cameras.replace(intrinsics=cameras.intrinsics.requires_grad_())
    assert not moved.detach().intrinsics.requires_grad


def test_camera_centres_map_to_the_origin_of_their_camera(cameras):
    homogeneous = torch.cat([cameras.centers_world, torch.ones(2, 1).double()], dim=1)
    in_cam = torch.einsum("vij,vj->vi", cameras.cam_from_world, homogeneous)
    torch.testing.assert_close(in_cam[:, :3], torch.zeros(2, 3).double())


def test_padding_is_outside_the_photographs(views):
    views = views.replace(sizes_px=torch.tensor([[6, 4], [3, 2]]))
    assert views.inside[0].all()
    assert views.inside[1].nonzero().tolist() == [[r, c] for r in range(2) for c in range(3)]


def test_the_table_of_observations_has_view_and_point_pairs(cameras, views):
    scene = SparseScene(
        views=views,
        cameras=cameras,
        points_world=torch.zeros(3, 3),
        reprojection_errors_px=torch.zeros(3),
        observation_point=torch.tensor([0, 2, 2]),
        observation_view=torch.tensor([1, 0, 1]),
        observation_pixels=torch.zeros(3, 2),
        lenses=(),
    )
    assert scene.observed.tolist() == [[False, True], [False, False], [True, True]]


def test_template_samples_follow_x_right_y_down_z_inward():
    templates = Templates(
        facet=torch.tensor([0]),
        patch_from_world=torch.eye(4)[None],
        origin=torch.tensor([[1.0, 2.0]]),
        spacing=torch.tensor([0.5]),
        depth=torch.arange(6.0).reshape(1, 2, 3),
        barycentric=torch.zeros(1, 2, 3, 3),
        inside=torch.ones(1, 2, 3, dtype=torch.bool),
    )
    points = templates.points_patch[0]
    assert points[0, 0].tolist() == [1.0, 2.0, 0.0]
    assert points[0, 2].tolist() == [2.0, 2.0, 2.0]
    assert points[1, 0].tolist() == [1.0, 2.5, 3.0]
