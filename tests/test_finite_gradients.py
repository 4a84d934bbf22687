"""Gradients are finite if values are: for complete scenes, by stage and through the chain."""

import pytest
import torch
from gradient_cost import STAGES, pulled_back, tracked
from priors import prior_of
from probes import calls, small_scene, stage_of

import pimper_torch as pt
from pimper_bench.datasets.rendered import read_rendered
from pimper_bench.scenes import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig

pytestmark = pytest.mark.filterwarnings(
    "ignore::pimper_torch.runtime.errors.PimperWarning",
    "ignore:Converting a tensor with requires_grad",
)

# The mug has surface that is unlit in all views.
SCENES = {
    "potatoes": {},
    "balls": {"specular": 0.3},
    "mug": {},
    "a black photograph": {},
    "a saturated photograph": {},
    "views without most facets": {},
}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Eight photographs of 240x180 pixels with true cameras, masks and normal priors."""

    def make(name):
        kind = name if name in ("potatoes", "balls", "mug") else "potatoes"
        folder = tmp_path_factory.getbasetemp() / f"finite-{kind}"
        if not folder.exists():
            config = SceneConfig(num_views=8, width=240, height=180, **SCENES[name])
            render_scene(kind, folder, config)
        views = pt.load_views(folder / "photos", masks=folder / "masks")
        images = views.images.clone()
        if name == "a black photograph":
            images[2] = 0
        if name == "a saturated photograph":
            images[2] = 1
        if name == "views without most facets":
            seen = (torch.arange(240) > 110) | (torch.arange(8)[:, None] < 4)
            views = views.replace(masks=views.masks & seen[:, None])
        views = views.replace(images=images, priors=prior_of("normals:5", read_rendered(folder)))
        chain = pt.load_chain("default", {"scales": [0.25]})
        return chain.reconstruct(views, folder / "truth" / "sparse")

    return make


def assert_finite(slopes, where):
    wrong = sum(int((~slope.isfinite()).sum()) for slope in slopes)
    assert slopes, where
    assert wrong == 0, f"{where}: {wrong} of {sum(slope.numel() for slope in slopes)}"


def assert_stages_finite(chain, scene):
    """Check every stage with its arguments in the chain; return the arguments by stage."""
    given = calls(chain, lambda: chain(scene))
    for stage in [stage for stage in STAGES if stage in given]:
        arguments, inputs = tracked(given[stage])
        assert_finite(pulled_back(stage_of(chain, stage)(*arguments), inputs), stage)
    return given


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_gradients_are_finite_with_a_black_or_saturated_photograph(level):
    scene, coarse = (each.to(torch.float32) for each in small_scene(num_views=5, width=40))
    scene.views.images[2] = level
    everything = pt.Given(pt.Silhouettes.everything(scene.views))
    given = {"silhouettes": everything, "coarse_surface": pt.Given(coarse)}
    chain = pt.load_chain("default", {"scales": [1.0]}, **given)
    assert_stages_finite(chain, scene)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("name", SCENES)
def test_gradients_are_finite_where_values_are(rendered, name, dtype):
    scene = rendered(name).to(dtype)
    chain = pt.load_chain("default", {"scales": [0.25, 0.5]})
    given = assert_stages_finite(chain, scene)
    (seen,), _ = tracked(given["factorize"])
    total = sum(
        bucket.albedo.square().sum() for bucket in stage_of(chain, "factorize")(seen).buckets
    )
    slopes = torch.autograd.grad(total, [bucket.radiance for bucket in seen.buckets])
    for slope, bucket, templates in zip(slopes, seen.buckets, seen.patches.buckets, strict=True):
        counts = (bucket.valid & templates.inside[:, None])[:, :, None]
        assert not slope[~counts.expand_as(slope)].any()
    mesh = given["decompose"][0].mesh
    (scene, mesh), inputs = tracked((scene, mesh))
    result = pt.load_chain("default", {"scales": [0.25]})(scene, mesh=mesh)
    assert_finite(pulled_back(result, inputs), "chain")
