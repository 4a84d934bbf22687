import pytest
import torch
from torch.testing import assert_close
from twins import using

from pimper_torch.geometry.pyramids import build_pyramids
from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import Mesh
from pimper_torch.stages.patches.patches_config import WarpConfig
from pimper_torch.stages.patches.warp import Warp
from pimper_torch.stages.sweep.costs import Hypotheses, costs_of
from pimper_torch.stages.sweep.sweep import Sweep


def height_field(templates):
    """Return waves: the pyramid level of a sample depends on neighbouring depths."""
    x, y = templates.points_patch[..., 0], templates.points_patch[..., 1]
    return 0.5 * templates.spacing[:, None, None] * torch.sin(30 * x) * torch.cos(20 * y)


def waved(patches):
    """Return templates with a surface, and a screen in front of part of it."""
    buckets = tuple(
        bucket.replace(
            depth=height_field(bucket),
            normals_patch=torch.nn.functional.normalize(
                torch.stack(
                    [height_field(bucket), 0 * height_field(bucket), height_field(bucket) * 0 - 1],
                    dim=-1,
                ),
                dim=-1,
            ),
        )
        for bucket in patches.buckets
    )
    vertices, faces = patches.coarse.mesh.vertices_world, patches.coarse.mesh.faces
    outward = face_normals(vertices, faces)[0]
    screen = 0.5 * vertices + 0.3 * outward / outward.norm()
    both = Mesh(
        vertices_world=torch.cat([vertices, screen]),
        faces=torch.cat([faces, faces + len(vertices)]),
    )
    return patches.replace(buckets=buckets, surface=both)


@pytest.fixture
def photographed(lift):
    """Noisy photographs of odd size with a mask, and templates."""
    lifted = lift(0.4)
    views = lifted.scene.views
    drawn = torch.rand(views.images.shape, generator=torch.Generator().manual_seed(7))
    images = (views.images + 0.05 * drawn).float()
    images[0, 1, 40, 50] = torch.nan
    images[1, :, 30:40, 40:60] = 1.0
    masks = views.inside.clone()
    masks[2, :, :50] = False
    views = views.replace(images=images[..., :89, :117].contiguous(), masks=masks[:, :89, :117])
    views = views.replace(sizes_px=views.sizes_px.clamp_max(torch.tensor([117, 89])))
    return views, lifted.scene.cameras.replace(sizes_px=views.sizes_px), lifted


@pytest.mark.parametrize("finer", [1.0, 0.3])
def test_resampled_views_agree_with_torch(photographed, finer):
    views, cameras, lifted = photographed
    patches = waved(lifted.seen.patches)
    wide = tuple(
        bucket.replace(spacing=bucket.spacing / finer, origin=bucket.origin)
        for bucket in patches.buckets
    )
    patches = patches.replace(buckets=wide)
    warp = Warp(WarpConfig(max_tilt_deg=60.0, occlusion_stride=3))
    with using("torch"):
        wanted = warp(views, cameras, patches)
    found = warp(views, cameras, patches)
    hidden = warp(views, cameras, patches.replace(surface=None))
    for one, other, free in zip(found.buckets, wanted.buckets, hidden.buckets, strict=True):
        assert torch.equal(one.valid, other.valid)
        assert one.valid.any()
        assert not one.valid.all()
        assert (free.valid & ~one.valid).any()  # the screen hides samples
        # Torch projects in float64, the kernel in the dtype of the cameras; images are float32.
        assert_close(one.radiance, other.radiance, rtol=0, atol=2e-6)


def test_the_adjoint_of_resampling_agrees_with_torch(photographed):
    views, cameras, lifted = photographed
    patches = waved(lifted.seen.patches)
    names = "depth", "spacing", "origin", "patch_from_world"
    slopes = []
    for how in ("numba", "torch"):
        images, poses, intrinsics = (
            each.clone().requires_grad_()
            for each in (views.images, cameras.cam_from_world, cameras.intrinsics)
        )
        moved = [
            bucket.replace(
                **{name: getattr(bucket, name).clone().requires_grad_() for name in names}
            )
            for bucket in patches.buckets
        ]
        with using(how):
            seen = Warp(WarpConfig(max_tilt_deg=60.0))(
                views.replace(images=images),
                cameras.replace(cam_from_world=poses, intrinsics=intrinsics),
                patches.replace(buckets=tuple(moved)),
            )
        probes = torch.Generator().manual_seed(5)
        total = sum(
            (torch.randn(one.radiance.shape, generator=probes) * one.radiance).sum()
            for one in seen.buckets
        )
        leaves = [images, poses, intrinsics]
        leaves += [getattr(bucket, name) for bucket in moved for name in names]
        slopes.append(torch.autograd.grad(total, leaves))
    for one, other in zip(*slopes, strict=True):
        assert (other != 0).any()
        # Torch's geometry is float32: sums of thousands of samples.
        assert_close(one, other, rtol=0, atol=2e-4 * float(other.abs().max()))


def test_swept_heights_agree_with_torch(photographed):
    views, cameras, lifted = photographed
    sources = build_pyramids(views)
    with using("torch"):
        wanted = Sweep()(views, cameras, lifted.seen, lifted.photometric, sources)
    found = Sweep()(views, cameras, lifted.seen, lifted.photometric, sources)
    for one, other in zip(found.buckets, wanted.buckets, strict=True):
        known = other.information > 0
        assert torch.equal(one.information > 0, known)
        assert known.any()
        spacing = float(lifted.seen.patches.buckets[0].spacing[0])
        assert_close(one.offset, other.offset, rtol=0, atol=1e-3 * spacing)
        assert_close(one.information[known], other.information[known], rtol=1e-2, atol=0)
        assert torch.equal(one.num_views, other.num_views)


def hypotheses(views, cameras, lifted, coarser):
    """Return the inputs of the sweep of a bucket, and the leaves of its gradients."""
    bucket, photometry = lifted.seen.patches.buckets[0], lifted.photometric.buckets[0]
    generator = torch.Generator().manual_seed(3)
    drawn = torch.rand(photometry.lights_patch.shape[:2], generator=generator)
    given = {
        "images": views.images,
        "cam_from_world": cameras.cam_from_world,
        "intrinsics": cameras.intrinsics,
        "depth": height_field(bucket),
        "spacing": coarser * bucket.spacing,
        "origin": bucket.origin,
        "turned": torch.zeros_like(bucket.patch_from_world),
        "outward": photometry.normals_patch + 0.1,
        "normals": photometry.normals_patch,
        "lights": photometry.lights_patch,
        "exposure": 0.8 + 0.4 * drawn,
        "scale": 0.02 + 0.01 * torch.rand(len(bucket.depth), generator=generator),
    }
    leaves = {name: each.detach().clone().requires_grad_() for name, each in given.items()}
    turned = torch.matrix_exp(leaves["turned"] - leaves["turned"].mT)[:, :3]
    rigid = torch.cat([turned @ bucket.patch_from_world, bucket.patch_from_world[:, 3:]], dim=1)
    placed = {name: leaves[name] for name in ("depth", "spacing", "origin")}
    found = Hypotheses(
        templates=bucket.replace(patch_from_world=rigid, **placed),
        registered=lifted.seen.buckets[0],
        photometry=photometry.replace(
            normals_patch=leaves["normals"],
            lights_patch=leaves["lights"],
            exposure=leaves["exposure"],
        ),
        outward=torch.nn.functional.normalize(leaves["outward"], dim=-1),
        cameras=cameras.replace(**{n: leaves[n] for n in ("cam_from_world", "intrinsics")}),
        sources=build_pyramids(views.replace(images=leaves["images"])),
        images=torch.arange(cameras.num_views),
        poses=None,
        ladder=torch.arange(-3, 4.0),
        scale=leaves["scale"],
    )
    return found, leaves


@pytest.mark.parametrize("coarser", [1.0, 2.5])
def test_costs_of_heights_and_their_gradients_agree_with_torch(photographed, coarser):
    views, cameras, lifted = photographed
    found = []
    for how in ("numba", "torch"):
        given, leaves = hypotheses(views, cameras, lifted, coarser)
        with using(how):
            cost, swept = costs_of(given, num_views=6, min_views=3)
        probes = torch.randn(cost.shape, generator=torch.Generator().manual_seed(5))
        slopes = torch.autograd.grad((probes * cost).sum(), [*leaves.values()])
        found.append((cost, swept, dict(zip(leaves, slopes, strict=True))))
    (one, own, kernel), (other, wanted, reference) = found
    assert own.any()
    assert torch.equal(own, wanted)
    assert_close(one, other, rtol=0, atol=1e-5 * float(other.detach().max()))
    for name, slope in reference.items():
        off = float((kernel[name] - slope).norm() / slope.norm())
        assert off < 1e-4, name


def test_the_photographs_are_not_copied(photographed):
    views, _, _ = photographed
    whole = views.replace(images=views.images.nan_to_num())
    sources = build_pyramids(whole)
    assert sources.images.finest.data_ptr() == whole.images.data_ptr()
    assert build_pyramids(views).images.finest.isfinite().all()
