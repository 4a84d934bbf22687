"""Every gradient of the chain agrees with finite differences."""

import dataclasses

import pytest
import torch
from probes import probes, rendered_scene, small_scene
from torch import nn
from torch.nn.functional import normalize

import pimper_torch as pt
from pimper_bench.derivatives import check_derivatives
from pimper_bench.scenes import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_torch.lighting import lights
from pimper_torch.lighting.light_field import harmonics
from pimper_torch.records import Silhouettes
from pimper_torch.stages.photometry.factor_priors import FactorPrior, PriorTerms
from pimper_torch.stages.stage import Given

# Tolerances; single stages agree far better. Kinks at borders of pixels that are too small to
# separate from slopes remain, and a complete scene has more of them.
STAGE, SCENE, WHOLE = 0.002, 0.005, 0.02


# Light does not determine some of the few patches: these keep their initial normals.
pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")


# No step of the differences changes a discrete choice here, such as whether a patch is fitted.
FEW = {"seed": 36, "num_views": 5, "width": 32, "num_points": 11}


def chain_of(preset, **changes):
    return pt.load_chain(preset, changes)


def assert_agree(stage, pairs, tolerance):
    for (source, target), check in pairs.items():
        text = f"{stage}, {target} by {source}: {check.ratios}, {check.jumped} jump"
        assert check.smooth.any(), text
        assert abs(check.ratio - 1) < tolerance, text


def in_iterations(**changes):
    return chain_of("default", scales=[0.5, 1.0], **changes)


@pytest.fixture(scope="module")
def iterations():
    """Probes of the stages of the second pass, which starts from a surface."""
    return probes(in_iterations(), *small_scene(num_views=5, width=40, num_points=16))


@pytest.fixture(scope="module")
def published():
    return probes(chain_of("paper"), *small_scene(num_views=4, width=32, num_points=12))


@pytest.mark.parametrize("stage", ["warp", "decompose", "sweep", "fuse", "repair", "remesh"])
def test_stages_of_the_second_pass_agree_with_finite_differences(iterations, stage, generator):
    # Inputs with a small effect on the surface need longer steps because of rounding.
    steps = (3e-6, 1e-6) if stage == "fuse" else (1e-6, 1e-7)
    found = iterations[stage].check(generator, directions=1, steps=steps)
    assert_agree(stage, found, STAGE)


@pytest.mark.parametrize("stage", ["integrate", "align", "refine"])
def test_stages_of_the_published_chain_agree_with_finite_differences(published, stage, generator):
    assert_agree(stage, published[stage].check(generator, directions=1), STAGE)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["soft", "point_light"])
@pytest.mark.parametrize("loss", ["squares", "cauchy"])
def test_factorization_agrees_with_finite_differences(light, loss, generator):
    few = small_scene(**FEW)
    chain = in_iterations(light={"model": light}, factorize={"loss": loss})
    found = probes(chain, *few)["factorize"].check(generator, directions=1)
    assert_agree("factorize", found, STAGE)


def with_constant_soft_light(probe, monkeypatch):
    """Return a probe that keeps the soft light of its first evaluation.

    For autograd these harmonics are constants (see ``fit_light_field``), but not for finite
    differences: 1 % of the mug's derivatives of albedo.
    """
    rooms, left, fit_room = [], [], lights._fit_room

    def constant(*arguments):
        if left:
            return left.pop(0)
        rooms.append(fit_room(*arguments))
        return rooms[-1]

    def function(inputs):
        left[:] = rooms
        return probe.function(inputs)

    monkeypatch.setattr(lights, "_fit_room", constant)
    return dataclasses.replace(probe, function=function)


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "specular"), [("potatoes", 0.0), ("balls", 0.3), ("mug", 0.0)])
def test_stages_agree_with_finite_differences_on_whole_scenes(
    tmp_path, scene, specular, generator, monkeypatch
):
    config = SceneConfig(num_views=8, width=240, height=180, specular=specular)
    render_scene(scene, tmp_path, config)
    stages = probes(chain_of("default", scales=[0.25, 0.5]), *rendered_scene(tmp_path))
    del stages["chain"]  # a step may change the set of vertices
    assert len(stages) == 7
    stages["factorize"] = with_constant_soft_light(stages["factorize"], monkeypatch)
    for stage, probe in stages.items():
        steps = (3e-6, 1e-6) if stage == "fuse" else (1e-6, 1e-7)
        pairs = probe.check(generator, directions=1, weights=0, steps=steps)
        # A removed sample may change which one is the percentile of albedo that fixes the gauge,
        # and a ray that hits a different cell of a template may move the surface.
        smooth = {key: check for key, check in pairs.items() if check.smooth.all()}
        assert len(smooth) > len(pairs) / 2
        assert_agree(stage, smooth, SCENE)


@pytest.mark.slow
def test_the_complete_chain_agrees_with_finite_differences(generator):
    few = small_scene(**FEW)
    found = probes(in_iterations(), *few)["chain"].check(generator, directions=2, weights=4)
    assert_agree("chain", found, WHOLE)


class Network(FactorPrior):
    """Predicts inliers by a layer shared by all entries, and normals from their mean."""

    def __init__(self):
        super().__init__()
        torch.manual_seed(5)
        self.entry, self.inlier, self.tilt = (nn.Linear(*size) for size in ((2, 4), (4, 1), (4, 3)))

    def forward(self, samples):
        predicted = samples.albedo[:, None] * (samples.lights @ harmonics(samples.normals).mT)
        inner = self.entry(torch.stack([samples.radiance - predicted, predicted], dim=-1)).tanh()
        shown = samples.seen[..., None]
        mean = (inner * shown).sum(dim=1) / shown.sum(dim=1).clamp_min(1)
        return PriorTerms(
            normals=normalize(samples.normals + 0.1 * self.tilt(mean), dim=-1),
            normal_weight=torch.full_like(samples.albedo, 0.5),
            inlier=self.inlier(inner)[..., 0].sigmoid(),
        )


@pytest.mark.slow
def test_gradients_of_prior_parameters_agree_through_factorization_and_sweep(generator):
    scene, coarse = small_scene(**FEW)
    chain = chain_of("default", scales=[1.0])
    chain.silhouettes = Given(Silhouettes.everything(scene.views))
    chain.coarse_surface = Given(coarse)
    prior = Network().double()
    chain.factorize.priors.append(prior)
    where = f"factorize.priors.{len(chain.factorize.priors) - 1}."
    parameters = {name: value for name, value in prior.named_parameters() if "weight" in name}
    parts = [value.numel() for value in parameters.values()]

    def found(x):
        values = torch.split(x["parameters"], parts)
        moved = {
            where + name: value.reshape(own.shape)
            for (name, own), value in zip(parameters.items(), values, strict=True)
        }
        swept = torch.func.functional_call(chain, moved, (scene,)).patches
        normals, offsets = [], []
        for photometric, heights in zip(swept.photometric.buckets, swept.buckets, strict=True):
            known = photometric.valid.flatten(1).any(dim=1)  # lights of other patches are constants
            normals.append(photometric.normals_patch[known].flatten())
            offsets.append(heights.offset[known].flatten())
        return {"normals": torch.cat(normals), "offset": torch.cat(offsets)}

    flat = torch.cat([value.flatten() for value in parameters.values()])
    pairs = check_derivatives(found, {"parameters": flat}, generator, directions=1)
    assert_agree("prior", pairs, STAGE)


def test_a_detached_part_is_detected(generator):
    found = check_derivatives(
        lambda x: {"sum": x["a"] * x["b"] + x["a"].detach() ** 2},
        {name: torch.rand(7, generator=generator, dtype=torch.float64) + 1 for name in ("a", "b")},
        generator,
    )
    assert found["a", "sum"].spread > 0.1
    assert found["b", "sum"].spread < 1e-6


def test_jumps_are_distinguished_from_errors(generator):
    places = torch.linspace(0.05, 0.95, 19, dtype=torch.float64)
    places[4] = 1 / 3  # a step of either size moves it across the edge of a bin

    def binned(x):
        return {"y": (3 * x["x"]).floor() + x["x"] ** 2}

    check = check_derivatives(binned, {"x": places}, generator)["x", "y"]
    assert check.jumped == pytest.approx(1 / 19)
    assert check.smooth.all()
    assert check.spread < 1e-6


def test_a_discontinuous_direction_gives_no_ratio(generator):
    def counted(x):
        return {"y": x["x"] + (x["x"].sum() > 0)}

    at_the_edge = torch.tensor([1.0, -1.0], dtype=torch.float64)
    check = check_derivatives(counted, {"x": at_the_edge}, generator)["x", "y"]
    assert not check.smooth.any()
    assert check.median != check.median  # NaN
