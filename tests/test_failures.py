"""A failed patch, view or solver is skipped with a warning and does not affect the others."""

import warnings
from functools import partial

import pytest
import torch
from probes import small_scene

import pimper_torch as pt
from pimper_torch.chains.photometric import Photometric
from pimper_torch.export.reports import summary_report
from pimper_torch.linalg.prepared import SingularSystemError
from pimper_torch.records import Failure, PatchStatus, Silhouettes
from pimper_torch.runtime.errors import OutOfMemoryError, PimperWarning, ReconstructionError
from pimper_torch.runtime.failures import failures_of, skipped, skipping, solved_or, warn_of
from pimper_torch.stages.fusion import estimate
from pimper_torch.stages.patches.decompose import Decompose
from pimper_torch.stages.patches.patches_config import DecomposeConfig
from pimper_torch.stages.patches.warp import Warp
from pimper_torch.stages.photometry import factor_solve
from pimper_torch.stages.photometry.factorize import Factorize
from pimper_torch.stages.photometry.fit_light import FitLight
from pimper_torch.stages.sfm.sparse_scene import sound
from pimper_torch.stages.silhouettes.find import FindSilhouettes
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig
from pimper_torch.stages.stage import Given
from pimper_torch.stages.sweep.sweep import Sweep

# torch's message on the CPU.
NO_MEMORY = "DefaultCPUAllocator: can't allocate memory: you tried to allocate 123456789 bytes."
FAILURE = Failure(stage="fuse", what="solver", name="it", reason="NaN", done="Kept")


def test_each_kind_of_failure_gives_one_warning_with_its_count():
    failures = [
        Failure(stage="sweep", what="patch", name=str(name), reason="NaN", done="Kept")
        for name in (11, 2, 2, *range(20, 27))
    ]
    with pytest.warns(PimperWarning) as caught:
        warn_of(failures)
    (warning,) = caught
    assert "sweep: 9 failed (patch 2, 11, 20, 21, 22, ...): NaN. Kept." in str(warning.message)
    assert [each.name for each in failures_of(failures)][:3] == ["2", "11", "20"]


def test_outside_a_chain_a_failure_warns_immediately():
    with pytest.warns(PimperWarning, match="fuse: 1 failed"):
        skipped(FAILURE)


def test_earlier_failures_are_warned_of_before_a_fatal_error():
    def broken(error):
        with skipping():
            skipped(FAILURE)
            raise error

    with pytest.warns(PimperWarning, match="fuse: 1 failed"), pytest.raises(KeyError):
        broken(KeyError("wrong"))
    for error in (MemoryError(), RuntimeError(NO_MEMORY)):
        with (
            pytest.warns(PimperWarning, match="fuse: 1 failed"),
            pytest.raises(OutOfMemoryError, match=r"Memory ran out.*--max-size-px"),
        ):
            broken(error)


def test_a_fallback_replaces_singular_equations():
    def singular():
        raise SingularSystemError("singular")

    given = {"stage": "fuse", "name": "the fusion", "done": "Kept"}
    with skipping() as entries:
        assert solved_or(singular, lambda: 3, **given) == 3
    assert failures_of(entries)[0].reason == "SingularSystemError: singular"
    with pytest.raises(ReconstructionError, match="solver the fusion"), skipping("fail"):
        solved_or(singular, lambda: 3, **given)
    with pytest.raises(ZeroDivisionError), skipping():  # a programming error
        solved_or(lambda: 1 / 0, lambda: 3, **given)


# --- views and points of a scene ---------------------------------------------------------------


@pytest.fixture(scope="module")
def scene():
    return small_scene(num_views=6, width=64)[0].to(torch.float32)


def with_image(scene, view, value):
    images = scene.views.images.clone()
    images[view] = value
    return scene.replace(views=scene.views.replace(images=images))


def with_pose(scene, view, change):
    frames = scene.cameras.cam_from_world.clone()
    frames[view] = change(frames[view])
    return scene.replace(cameras=scene.cameras.replace(cam_from_world=frames))


def with_empty_mask(scene, view):
    masks = scene.views.inside.clone()
    masks[view] = False
    return scene.replace(views=scene.views.replace(masks=masks))


def moved(frame):
    frame = frame.clone()
    frame[:3, 3] += 1000
    return frame


def turned(frame):
    return torch.diag(frame.new_tensor([-1.0, 1.0, -1.0, 1.0])) @ frame


FAULTS = {
    "not finite everywhere": partial(with_image, value=torch.nan),
    "it is black": partial(with_image, value=0.0),
    "saturated or": partial(with_image, value=1.0),
    "in its frame": partial(with_pose, change=moved),
    "0% of the points": partial(with_pose, change=turned),
    "not finite": partial(with_pose, change=lambda frame: frame * torch.nan),
    "its mask is empty": with_empty_mask,
}


@pytest.mark.parametrize("reason", FAULTS)
def test_an_unusable_view_is_removed_and_the_others_are_unchanged(scene, reason):
    with skipping() as entries:
        found = sound(FAULTS[reason](scene, 2))
    others = [0, 1, 3, 4, 5]
    assert found.views.names == tuple(scene.views.names[view] for view in others)
    assert found.unregistered == (scene.views.names[2],)
    assert torch.equal(found.views.images, scene.views.images[others])
    assert torch.equal(found.cameras.cam_from_world, scene.cameras.cam_from_world[others])
    assert torch.equal(found.observed, scene.observed[:, others])
    assert len(found.lenses) == 5
    found.check("test")
    (failure,) = failures_of(entries)
    assert (failure.what, failure.name) == ("view", scene.views.names[2])
    assert reason in failure.reason
    with pytest.raises(ReconstructionError, match=reason), skipping("fail"):
        sound(FAULTS[reason](scene, 2))


def test_a_scene_without_faults_stays_the_same(scene):
    assert sound(scene) is scene


def test_points_that_are_not_finite_are_removed(scene):
    points = scene.points_world.clone()
    points[[3, 5]] = torch.nan
    kept = torch.ones(len(points), dtype=torch.bool)
    kept[[3, 5]] = False
    with skipping() as entries:
        found = sound(scene.replace(points_world=points))
    assert torch.equal(found.points_world, scene.points_world[kept])
    assert torch.equal(found.observed, scene.observed[kept])
    assert [each.what for each in failures_of(entries)] == ["points"]


def test_too_few_views_are_refused_with_the_reason_of_each(scene):
    blank = scene
    for view in range(4):
        blank = with_image(blank, view, 0.0)
    with pytest.raises(ReconstructionError, match=r"2 of 6 views.*needed: 3.*black, saturated"):
        sound(blank)


def test_an_empty_silhouette_does_not_constrain_the_surface(scene):
    with skipping() as entries:
        found = FindSilhouettes()(with_empty_mask(scene, 2))
    assert found.reliable.tolist() == [True, True, False, True, True, True]
    assert [each.name for each in failures_of(entries)] == [scene.views.names[2]]


# --- patches -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def given():
    """Photographs of a sphere, cameras, and facets in buckets of a few patches each."""
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=64))
    patches = Decompose(DecomposeConfig(bucket_entries=12_000))(coarse, scene.cameras)
    assert len(patches.buckets) > 1
    assert max(len(each.facet) for each in patches.buckets) > 3
    return scene.views, scene.cameras, patches


def streamed(given):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PimperWarning)  # patches with too little light
        light = FitLight()(Warp()(*given))
        return Photometric()((Warp(), Factorize(), Sweep()), *given, light)


@pytest.fixture(scope="module")
def expected(given):
    return streamed(given)


def by_bucket(swept):
    for photometry, found in zip(swept.photometric.buckets, swept.buckets, strict=True):
        yield (
            *(photometry.normals_patch, photometry.albedo, photometry.lights_patch),
            *(photometry.valid, photometry.information, found.offset, found.information),
        )


def test_a_solution_that_is_not_finite_affects_only_its_patch(given, expected, monkeypatch):
    name = "variable-projection"
    solve = factor_solve.SOLVERS[name]

    def spoiled(problem, *limits):
        found = solve(problem, *limits)
        lights = found.lights.clone()
        lights[-1] = torch.nan
        residual = found.convergence.residual.clone()
        residual[-1] = torch.nan
        return found.replace(
            lights=lights, convergence=found.convergence.replace(residual=residual)
        )

    monkeypatch.setattr(factor_solve, "SOLVERS", {**factor_solve.SOLVERS, name: spoiled})
    with (
        pytest.raises(ReconstructionError, match=r"factorize: patch \d+ failed"),
        skipping("fail"),
    ):
        streamed(given)
    with skipping() as entries:
        found = streamed(given)
    lost = {int(each.name) for each in failures_of(entries)}
    facets = torch.cat([bucket.facet for bucket in given[2].buckets])
    status = torch.cat([bucket.status for bucket in found.photometric.buckets])
    assert lost == set(facets[status == int(PatchStatus.FAILED)].tolist()) != set()
    assert all(each.stage == "factorize" for each in failures_of(entries))
    for index, (one, other) in enumerate(zip(by_bucket(found), by_bucket(expected), strict=True)):
        kept = [int(facet) not in lost for facet in given[2].buckets[index].facet]
        assert all(part.isfinite().all() for part in one)
        rows = torch.tensor(kept).nonzero()[:, 0]
        # All patches together determine the scale of albedo.
        for place in (0, 3, 4):
            assert torch.equal(one[place][rows], other[place][rows])


def test_heights_that_are_not_finite_become_invalid(given, expected, monkeypatch):
    sweep = Sweep._sweep

    def spoiled(self, *handed):
        found = sweep(self, *handed)
        offset = found.offset.clone()
        offset[0] = torch.nan
        return found.replace(offset=offset)

    monkeypatch.setattr(Sweep, "_sweep", spoiled)
    with skipping() as entries:
        found = streamed(given)
    assert {each.stage for each in failures_of(entries)} == {"sweep"}
    for one, other in zip(found.buckets, expected.buckets, strict=True):
        assert not one.offset[0].any()
        assert not one.information[0].any()
        assert torch.equal(one.offset[1:], other.offset[1:])


# --- complete runs --------------------------------------------------------------------------------


def chain_of(scene, coarse, on_failure="skip"):
    chain = pt.load_chain("default", {"scales": [0.5], "on_failure": on_failure})
    chain.reconstruct = Given(scene)
    chain.silhouettes = Given(Silhouettes.everything(scene.views))
    chain.coarse_surface = Given(coarse)
    return chain


@pytest.mark.filterwarnings("always::pimper_torch.runtime.errors.PimperWarning")
def test_a_bad_view_gives_a_warning_and_a_line_in_the_summary(recwarn):
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=64))
    name = scene.views.names[2]
    bad = with_image(scene, 2, torch.nan)
    chain = chain_of(bad, coarse)
    chain.silhouettes = FindSilhouettes(SilhouetteConfig(object="everything"))
    result = chain(bad.views)
    messages = [
        str(each.message) for each in recwarn.list if "cameras: 1 failed" in str(each.message)
    ]
    assert len(messages) == 1
    assert name in messages[0]
    (line,) = summary_report(result, {})["failures"]
    assert (line["stage"], line["what"], line["names"]) == ("cameras", "view", [name])
    assert name in result.scene.unregistered
    chain = chain_of(bad, coarse, on_failure="fail")
    with pytest.raises(ReconstructionError, match=f"view {name} failed"):
        chain(bad.views)


@pytest.mark.filterwarnings("always::pimper_torch.runtime.errors.PimperWarning")
@pytest.mark.parametrize("broken", [1, 3])
def test_a_failed_fusion_keeps_the_previous_surface(monkeypatch, broken):
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=6, width=64))
    solve, calls = estimate.solve_compressed, []

    def singular(*args, **settings):
        calls.append(1)
        if len(calls) >= broken:
            raise SingularSystemError("singular")
        return solve(*args, **settings)

    monkeypatch.setattr(estimate, "solve_compressed", singular)
    result = chain_of(scene, coarse)(scene.views)
    assert result.mesh.vertices_world.isfinite().all()
    assert ("fuse", "the fusion") in {(each.stage, each.name) for each in result.failures}
    calls.clear()
    with pytest.raises(ReconstructionError, match="solver the fusion failed"):
        chain_of(scene, coarse, on_failure="fail")(scene.views)


@pytest.mark.filterwarnings("always::pimper_torch.runtime.errors.PimperWarning")
def test_a_facet_without_area_is_skipped_and_the_others_are_unchanged(given):
    _, cameras, patches = given
    coarse = patches.coarse
    faces = coarse.mesh.faces
    flat = torch.cat([faces[:7], faces[7:8, [0, 0, 1]], faces[7:]])
    bad = coarse.replace(mesh=coarse.mesh.replace(faces=flat), points=None, support=None)
    decompose = Decompose(DecomposeConfig(bucket_entries=12_000))
    with skipping() as entries:
        found = decompose(bad, cameras)
    assert [(each.stage, each.name) for each in failures_of(entries)] == [("decompose", "7")]
    assert torch.equal(found.coarse.mesh.faces, faces)
    for one, other in zip(found.buckets, patches.buckets, strict=True):
        assert torch.equal(one.facet, other.facet)
        assert torch.equal(one.depth, other.depth)
    with pytest.raises(ReconstructionError, match="patch 7 failed"), skipping("fail"):
        decompose(bad, cameras)
