import pytest
import torch
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo import photometric_stereo
from tests.single_view.scenes import BALL, BUMPY, angles_deg, strong_lights

COLOURS = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)


def photographed(scene, lights, albedo=1.0):
    """Return colour images and the true shadows."""
    shade = (lights @ scene.columns).clamp_min(0)
    return COLOURS[:, None, None] * scene.raster(albedo * shade), shade > 0


@pytest.mark.parametrize(
    ("method", "resolve"), [("calibrated", None), ("integrability", "equal_strength")]
)
def test_equal_light_strengths_determine_normals(generator, method, resolve):
    lights = 1.3 * strong_lights(generator, 16, spread=0.5)
    images, lit = photographed(BUMPY, lights, BUMPY.patchwork)
    known = lights if method == "calibrated" else None
    found = photometric_stereo(images, BUMPY.mask, method=method, resolve=resolve, lights=known)
    some = found.valid[BUMPY.mask]
    assert some.double().mean() > 0.97
    off = angles_deg(found.normals[BUMPY.mask].mT, BUMPY.columns)[some]
    # Without lights, integrability is as exact as cells of 1/56 of the surface.
    assert off.mean() < (0.01 if method == "calibrated" else 0.7)
    assert angles_deg(found.lights.mT, lights.mT).mean() < 0.7
    scale = 1.0 if method == "calibrated" else 1.3
    albedo = COLOURS * BUMPY.patchwork[:, None]
    ratio = found.albedo[BUMPY.mask][some] / (scale * albedo[some])
    assert_close(ratio.median(), torch.ones((), dtype=torch.float64), atol=0.02, rtol=0)
    assert (found.lit[:, BUMPY.mask] == lit)[:, some].double().mean() > 0.99


def test_without_a_cue_a_convention_is_used_and_named(generator):
    images, _ = photographed(BALL, strong_lights(generator, 12, spread=0.5))
    found = photometric_stereo(images, BALL.mask, method="integrability", resolve="rounded")
    assert "bas-relief" in found.free
    assert angles_deg(found.normals[BALL.mask].mT, BALL.columns).mean() < 2.5
    assert found.applied.lam.isfinite()


def test_missing_samples_may_be_nan_or_have_no_weight(generator):
    lights = strong_lights(generator, 14, spread=0.3)
    images, _ = photographed(BUMPY, lights)
    gone, unwanted = torch.rand(2, 14, 56, 56, generator=generator) < 0.2
    weight = torch.where(unwanted, 0.0, 1.0).double()
    images = torch.where(unwanted[:, None], 1e3, images)
    images[:, 1] = torch.where(gone, torch.nan, images[:, 1])  # one colour is enough
    given = {"mask": BUMPY.mask, "weight": weight}
    found = photometric_stereo(images, method="calibrated", lights=lights, **given)
    assert angles_deg(found.normals[found.valid].mT, BUMPY.normals[found.valid].mT).max() < 0.1
    assert not found.lit[gone | unwanted].any()
    blind = photometric_stereo(images, method="integrability", **given)
    assert blind.valid[BUMPY.mask].double().mean() > 0.9


@pytest.mark.parametrize("method", ["calibrated", "integrability"])
def test_a_view_without_samples_has_no_light(generator, method):
    lights = strong_lights(generator, 9, spread=0.3)
    images = photographed(BUMPY, lights)[0].float()
    images[4] = torch.nan
    known = lights.float() if method == "calibrated" else None
    found = photometric_stereo(images, BUMPY.mask, method=method, lights=known)
    assert (found.lights[4] == 0).all()
    assert (found.lights[5] != 0).any()
    assert not found.lit[4].any()
    assert found.normals.dtype == found.albedo.dtype == found.lights.dtype == torch.float32


def test_pixels_that_cannot_be_determined_are_not_valid():
    flat = [[0.0, 0, -1], [0.6, 0, -0.8], [-0.6, 0, -0.8]]
    lights = torch.tensor([*flat, [0.0, 0.6, -0.8]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, -1]] * 5 + [[0.3, 0, 0.954]], dtype=torch.float64)
    # The radiance of the last one is that of an averted normal, without clamping.
    images = (lights @ normals.mT)[:, None, None]
    images[:, :, :, 1] = 0
    weight = torch.ones(4, 1, 6, dtype=torch.float64)
    weight[1:3, 0, 2] = 0  # two samples
    weight[3, 0, 3] = 0  # lights in a plane
    mask = torch.tensor([[True, True, True, True, False, True]])
    found = photometric_stereo(
        images, mask, method="calibrated", lights=lights, weight=weight, robust=False
    )
    # Determined, black, too few samples, coplanar lights, outside, averted.
    assert found.valid[0].tolist() == [True, False, False, False, False, False]
    assert (found.normals[0, 4] == 0).all()


SIX = strong_lights(torch.Generator().manual_seed(6), 6)
IN_A_PLANE = SIX * SIX.new_tensor([1, 0, 1])
EYE = torch.eye(3).double()


@pytest.mark.parametrize(
    ("settings", "needed"),
    [
        ({"method": "woodhem"}, "needed: one of calibrated, integrability"),
        ({}, "0 lights for 6 photographs; needed: one light per"),
        (
            {"method": "integrability", "lights": SIX},
            "6 lights for 6 photographs; .* no lights otherwise",
        ),
        ({"lights": SIX[:5]}, "5 lights for 6 photographs"),
        ({"lights": SIX / 0}, "lights are not finite"),
        ({"lights": SIX, "intrinsics": EYE}, "intrinsics are given; .* orthographic"),
        ({"method": "perspective"}, "intrinsics are not given"),
        ({"lights": SIX, "resolve": "rounded"}, "needed: none"),
        ({"method": "integrability", "resolve": "ball"}, "needed: albedo_entropy, rounded"),
        ({"lights": SIX, "mask": BUMPY.mask & False}, "the mask is empty"),
        ({"lights": SIX, "mask": BUMPY.mask[:50]}, "resize the mask"),
        ({"lights": SIX, "weight": torch.ones(6, 56, 50).double()}, r"weights are \(6, 56, 50\)"),
        ({"lights": SIX, "weight": -torch.ones(6, 56, 56).double()}, "some weights are negative"),
        ({"lights": IN_A_PLANE}, "in one plane"),
        ({"lights": SIX, "dark": 4}, "2 photographs have samples"),
        ({"method": "integrability", "dark": 4}, "2 photographs have samples"),
        ({"method": "perspective", "intrinsics": EYE, "dark": 4}, "2 photographs have samples"),
    ],
)
def test_impossible_requests_are_rejected(settings, needed):
    images, _ = photographed(BUMPY, SIX)
    images[: settings.get("dark", 0)] = torch.nan
    given = {"mask": BUMPY.mask, "method": "calibrated", **settings}
    given.pop("dark", None)
    with pytest.raises(InputError, match=needed):
        photometric_stereo(images, **given)


@pytest.mark.parametrize(
    ("wrong", "needed"),
    [
        (lambda images: images.movedim(1, -1), r"channels last; .*`images\.movedim\(-1, 1\)`"),
        (lambda images: images[:, 0], r"without channels; .*`images\[:, None\]`"),
        (lambda images: images[..., 1:], r"images are \(56, 55\), the mask \(56, 56\)"),
    ],
)
def test_a_wrong_layout_of_images_is_named_with_its_remedy(wrong, needed):
    images, _ = photographed(BUMPY, SIX)
    with pytest.raises(InputError, match=needed):
        photometric_stereo(wrong(images), BUMPY.mask, method="calibrated", lights=SIX)


def test_arrays_are_taken_like_tensors():
    images, _ = photographed(BUMPY, SIX)
    found = photometric_stereo(images, BUMPY.mask, method="calibrated", lights=SIX)
    arrays = images.numpy(), BUMPY.mask.numpy()
    same = photometric_stereo(*arrays, method="calibrated", lights=SIX.numpy())
    assert torch.equal(found.normals, same.normals)
