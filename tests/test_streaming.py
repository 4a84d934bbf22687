import pytest
import torch
from probes import small_scene
from torch.testing import assert_close
from twins import using

import pimper_torch as pt
from pimper_torch.chains.photometric import Photometric
from pimper_torch.geometry.pyramids import build_pyramids
from pimper_torch.lighting.lights import thinned
from pimper_torch.records import StageReport
from pimper_torch.runtime.reporting import SilentObserver
from pimper_torch.stages.patches.patches_config import DecomposeConfig

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")


@pytest.fixture(scope="module")
def given():
    """Photographs of a sphere, cameras, and facets in buckets of a few patches each."""
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=96))
    patches = pt.Decompose(DecomposeConfig(bucket_entries=12_000))(coarse, scene.cameras)
    assert len(patches.buckets) > 3
    return scene.views, scene.cameras, patches


def streamed(given):
    views, cameras, patches = given
    light = pt.FitLight()(pt.Warp()(views, cameras, thinned(patches)))
    return Photometric()(
        (pt.Warp(), pt.Factorize(), pt.Sweep()), *given, light, build_pyramids(views)
    )


def values(swept):
    for photometry, heights in zip(swept.photometric.buckets, swept.buckets, strict=True):
        yield from (photometry.normals_patch, photometry.albedo, photometry.lights_patch)
        yield from (photometry.valid, photometry.information, heights.offset, heights.information)


def test_streamed_buckets_give_the_result_of_all_patches(given):
    views, cameras, patches = given
    light = pt.FitLight()(pt.Warp()(views, cameras, thinned(patches)))
    seen = pt.Warp()(views, cameras, patches)
    photometric = pt.Factorize()(seen, light)
    expected = pt.Sweep()(views, cameras, seen, photometric)
    found = streamed(given)
    assert found.averaged == expected.averaged
    for one, other in zip(values(found), values(expected), strict=True):
        # Rounding of the windows' convolutions depends on the batches.
        size = float(other.double().abs().max())
        assert_close(one, other, rtol=0, atol=0 if other.dtype == torch.bool else 1e-4 * size)


class Listener(SilentObserver):
    def __init__(self) -> None:
        self.heard: list[str] = []
        self.reports: list[StageReport] = []

    def started(self, stage):
        self.heard.append(stage)

    def progressed(self, done, total):
        self.heard.append(f"{done}/{total}")

    def finished(self, report):
        self.reports.append(report)


def in_iterations(listener, **changes):
    chain = pt.load_chain("default", {"scales": [0.5, 1.0], **changes}, listener)
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=64))
    chain.reconstruct = pt.Given(scene)
    chain.silhouettes = pt.Given(pt.Silhouettes.everything(scene.views))
    chain.coarse_surface = pt.Given(coarse)
    return chain, scene


def test_steps_have_the_records_of_every_pass_and_end_with_the_result():
    chain, scene = in_iterations(SilentObserver())
    shown = []
    chain.preview = lambda _, coarse: shown.append(coarse)
    steps = list(chain.steps(scene.views))
    assert shown == [chain.coarse_surface.record]
    result = chain(scene.views)
    assert [(step.scale, step.last) for step in steps] == [(0.5, False), (1.0, True)]
    names = [report.name for step in steps for report in step.reports]
    assert names.count("between stages") == len(steps)
    stages = [name for name in names if name != "between stages"]
    assert [report.name for report in result.report] == [
        *stages,
        "extract",
        "judge",
        "between stages",
    ]
    assert torch.equal(chain.extract(steps[-1].surface).vertices_world, result.mesh.vertices_world)
    # The second pass uses facets remeshed on the surface of the first.
    assert steps[0].coarse is chain.coarse_surface.record
    contours = pt.Contours.none(steps[0].silhouettes, scene.cameras)
    remeshed = chain.remesh(steps[0].heights, steps[0].surface, contours)
    assert torch.equal(steps[1].coarse.mesh.faces, remeshed.mesh.faces)


def test_an_observer_receives_cameras_and_every_pass_and_changes_nothing():
    chain, scene = in_iterations(SilentObserver())
    expected = chain(scene.views)
    seen = []
    chain.watch = seen.append
    found = chain(scene.views)
    assert [type(one) for one in seen] == [pt.SparseScene, pt.Step, pt.Step]
    assert seen[0].views.names == scene.views.names
    assert [one.scale for one in seen[1:]] == [0.5, 1.0]
    assert [report.name for report in found.report].count("view") == 3
    assert torch.equal(found.mesh.vertices_world, expected.mesh.vertices_world)
    assert torch.equal(found.mesh.albedo, expected.mesh.albedo)


def test_a_pass_reports_photometry_once_with_the_time_of_each_part():
    listener = Listener()
    chain, scene = in_iterations(listener, decompose={"bucket_entries": 6000})
    result = chain(scene.views)
    reports = [report for report in result.report if report.name == "photometry"]
    assert len(reports) == 2
    assert not {"factorize", "sweep"} & set(listener.heard)
    parts = [reports[1].figures[f"{part}_seconds"] for part in ("warp", "factorize", "sweep")]
    assert min(parts) > 0
    assert sum(parts) < torch.get_num_threads() * reports[1].seconds
    patches = result.patches.patches
    samples = 6 * sum(int(bucket.inside.sum()) for bucket in patches.buckets)
    assert reports[1].figures["samples"] == samples
    seen = pt.Warp()(scene.views, scene.cameras, patches)
    valid = sum(int(bucket.valid.sum()) for bucket in seen.buckets)
    assert reports[1].figures["missing_samples"] == pytest.approx(samples - valid, rel=0.05)
    count = len(patches.buckets)
    assert f"{count}/{count}" in listener.heard


def test_gradients_reach_the_photographs_through_the_buckets(given):
    views, cameras, patches = given
    patches = patches.replace(buckets=patches.buckets[:4])
    images = views.images.clone().requires_grad_()
    whole = streamed((views.replace(images=images), cameras, patches))
    light = whole.photometric.buckets[0].lights_patch.square().sum()
    (gradient,) = torch.autograd.grad(light, images)
    assert gradient.isfinite().all()
    assert gradient.abs().max() > 0


def with_others(given):
    """Interleave photographs that do not see the buckets with those that do."""
    views, cameras, patches = given
    order = torch.tensor([0, 0, 1, 2, 5, 3, 4, 3, 5, 2])
    own = torch.tensor([1, 0, 1, 1, 0, 1, 1, 0, 1, 0]) > 0
    more = views.take(order).replace(names=tuple(f"{row}.png" for row in range(len(order))))
    buckets = tuple(bucket.replace(views=own) for bucket in patches.buckets)
    return (more, cameras.take(order), patches.replace(buckets=buckets)), own


@pytest.mark.parametrize("kernels", ["numba", "torch"])
def test_photographs_that_do_not_see_a_bucket_change_no_bit_of_it(given, kernels):
    (views, cameras, patches), own = with_others(given)
    with using(kernels):
        seen = pt.Warp()(*given)
        among = pt.Warp()(views, cameras, patches)
        light = pt.FitLight()(seen)
        field = light.field
        spread = {
            name: torch.zeros(len(own), *value.shape[1:]).index_copy(0, own.nonzero()[:, 0], value)
            for name in ("soft", "point_light", "inverse_distance", "gain", "exposure")
            if (value := getattr(field, name)) is not None
        }
        of_all = light.replace(field=field.replace(**spread))
        found = []
        for one, shown, lit in ((given, seen, light), ((views, cameras), among, of_all)):
            solved = pt.Factorize()(shown, lit)
            found.append(list(values(pt.Sweep()(one[0], one[1], shown, solved))))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)


def test_light_is_fitted_as_if_unused_photographs_were_missing(given):
    views, cameras, patches = given
    masks = torch.tensor([[1, 1, 1, 1, 1, 0], [0, 1, 1, 1, 1, 1]]) > 0
    own = [masks[number % 2] for number in range(len(patches.buckets))]
    every = pt.Warp()(*given)
    missing = every.replace(
        buckets=tuple(
            bucket.replace(
                valid=bucket.valid & mask[:, None, None],
                radiance=bucket.radiance * mask[:, None, None, None],
            )
            for bucket, mask in zip(every.buckets, own, strict=True)
        )
    )
    buckets = tuple(
        bucket.replace(views=mask) for bucket, mask in zip(patches.buckets, own, strict=True)
    )
    found = pt.FitLight()(pt.Warp()(views, cameras, patches.replace(buckets=buckets))).field
    expected = pt.FitLight()(missing).field
    for name in ("soft", "point_light", "inverse_distance", "gain", "exposure", "origin"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_gradients_reach_only_the_photographs_that_see_a_bucket(given):
    (views, cameras, patches), own = with_others(given)

    def gradient(views, cameras, patches):
        images = views.images.clone().requires_grad_()
        seen = pt.Warp()(views.replace(images=images), cameras, patches)
        sum((bucket.radiance**2).sum() for bucket in seen.buckets).backward()
        return images.grad

    found = gradient(views, cameras, patches)
    assert not found[~own].any()
    assert torch.equal(found[own], gradient(*given))
