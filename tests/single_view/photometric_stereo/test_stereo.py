import pytest
import torch
from torch.testing import assert_close

from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.photometric_stereo import photometric_stereo
from pimper_torch.single_view.photometric_stereo.stereo import METHODS

COLOURS = torch.tensor([0.9, 0.5, 0.2], dtype=torch.float64)


def photographed(scene, lights, albedo, colours=COLOURS):
    """Images in colour, and the truth about shadows."""
    shade = (lights @ scene.columns).clamp_min(0)
    return (colours[:, None, None] * scene.raster(albedo * shade)), shade > 0


@pytest.mark.parametrize(
    ("method", "resolve"),
    [
        ("calibrated", None),
        ("integrability", "equal_strength"),
    ],
)
def test_point_lights_of_one_strength_are_enough(
    bumpy, point_lights, patchwork, angles_deg, method, resolve
):
    lights = 1.3 * point_lights(16, spread=0.5)
    images, lit = photographed(bumpy, lights, patchwork(bumpy))
    known = lights if method == "calibrated" else None
    found = photometric_stereo(images, bumpy.mask, method=method, resolve=resolve, lights=known)
    some = found.valid[bumpy.mask]
    assert some.double().mean() > 0.97
    off = angles_deg(found.normals[bumpy.mask].mT, bumpy.columns)[some]
    # Without the lights, integrability is as exact as cells of 1/56 of the surface are.
    assert off.mean() < (0.01 if method == "calibrated" else 0.7)
    assert angles_deg(found.lights.mT, lights.mT).mean() < 0.7
    scale = 1.0 if method == "calibrated" else 1.3
    albedo = COLOURS * patchwork(bumpy)[:, None]
    ratio = found.albedo[bumpy.mask][some] / (scale * albedo[some])
    assert_close(ratio.median(), torch.ones((), dtype=torch.float64), atol=0.02, rtol=0)
    assert (found.lit[:, bumpy.mask] == lit)[:, some].double().mean() > 0.99


def test_without_knowledge_a_convention_is_taken_and_named(ball, point_lights, angles_deg):
    lights = point_lights(12, spread=0.5)
    images, _ = photographed(ball, lights, torch.ones(ball.columns.shape[1]).double())
    found = photometric_stereo(images, ball.mask, method="integrability", resolve="rounded")
    assert "bas-relief" in found.free
    assert angles_deg(found.normals[ball.mask].mT, ball.columns).mean() < 2.5
    assert found.applied.lam.isfinite()


def test_what_is_missing_may_be_no_number_or_without_weight(
    bumpy, point_lights, generator, angles_deg
):
    lights = point_lights(14, spread=0.3)
    images, _ = photographed(bumpy, lights, torch.ones(bumpy.columns.shape[1]).double())
    gone = torch.rand(14, 56, 56, generator=generator) < 0.2
    weight = torch.where(torch.rand(14, 56, 56, generator=generator) < 0.2, 0.0, 1.0).double()
    images = torch.where((weight == 0)[:, None], 1e3, images)
    images[:, 1] = torch.where(gone, torch.nan, images[:, 1])  # one colour is enough
    found = photometric_stereo(
        images, bumpy.mask, method="calibrated", lights=lights, weight=weight
    )
    assert angles_deg(found.normals[found.valid].mT, bumpy.normals[found.valid].mT).max() < 0.1
    assert not found.lit[gone | (weight == 0)].any()
    blind = photometric_stereo(images, bumpy.mask, method="integrability", weight=weight)
    assert blind.valid[bumpy.mask].double().mean() > 0.9


def test_a_view_without_samples_has_no_light(bumpy, point_lights):
    lights = point_lights(9, spread=0.3)
    images, _ = photographed(bumpy, lights, torch.ones(bumpy.columns.shape[1]).double())
    images[4] = torch.nan
    for method in ("calibrated", "integrability"):
        known = lights if method == "calibrated" else None
        found = photometric_stereo(images, bumpy.mask, method=method, lights=known)
        assert (found.lights[4] == 0).all()
        assert (found.lights[5] != 0).any()
        assert not found.lit[4].any()


def test_pixels_that_cannot_be_determined_are_not_valid():
    flat = [[0.0, 0, -1], [0.6, 0, -0.8], [-0.6, 0, -0.8]]
    lights = torch.tensor([*flat, [0.0, 0.6, -0.8]], dtype=torch.float64)
    normals = torch.tensor([[0.0, 0, -1]] * 5 + [[0.3, 0, 0.954]], dtype=torch.float64)
    # The last one is a fake: its radiance is what a normal from behind would have, unclamped.
    images = (lights @ normals.mT)[:, None, None]
    images[:, :, :, 1] = 0
    weight = torch.ones(4, 1, 6, dtype=torch.float64)
    weight[1:3, 0, 2] = 0  # two samples
    weight[3, 0, 3] = 0  # lights in a plane
    mask = torch.tensor([[True, True, True, True, False, True]])
    found = photometric_stereo(
        images, mask, method="calibrated", lights=lights, weight=weight, robust=False
    )
    # Found, black, too few samples, lights in a plane, outside, facing away.
    assert found.valid[0].tolist() == [True, False, False, False, False, False]
    assert (found.normals[0, 4] == 0).all()


def test_results_have_the_dtype_of_the_images(bumpy, point_lights):
    lights = point_lights(9)
    images, _ = photographed(bumpy, lights, torch.ones(bumpy.columns.shape[1]).double())
    found = photometric_stereo(images.float(), bumpy.mask, method="integrability")
    assert found.normals.dtype == found.albedo.dtype == found.lights.dtype == torch.float32


def test_impossible_requests_are_refused(bumpy, point_lights):
    lights = point_lights(6)
    images, _ = photographed(bumpy, lights, torch.ones(bumpy.columns.shape[1]).double())

    def refuse(match, images=images, mask=bumpy.mask, **settings):
        with pytest.raises(InputError, match=match):
            photometric_stereo(images, mask, **{"method": "calibrated", **settings})

    refuse("needed: one of calibrated, integrability", method="woodhem")
    refuse("there are no lights")
    refuse("finds the lights itself", method="integrability", lights=lights)
    refuse("is orthographic", lights=lights, intrinsics=torch.eye(3).double())
    refuse("needed: none", lights=lights, resolve="rounded")
    refuse("needed: albedo_entropy, rounded", method="integrability", resolve="entropy")
    refuse("the mask is empty", mask=bumpy.mask & False, lights=lights)
    refuse("Resize the mask", mask=bumpy.mask[:50], lights=lights)
    refuse("5 lights for 6 photographs", lights=lights[:5])
    refuse("weights are", lights=lights, weight=torch.ones(6, 56, 50).double())
    refuse("finite and not negative", lights=lights, weight=-torch.ones(6, 56, 56).double())
    refuse("2 photographs have samples", images=images[:2], lights=lights[:2])
    refuse("in one plane", lights=lights * torch.tensor([1.0, 0, 1]).double())


def test_every_method_needs_what_it_says(bumpy, point_lights):
    images, _ = photographed(bumpy, point_lights(9), torch.ones(bumpy.columns.shape[1]).double())
    for name in METHODS:
        few = 2
        with pytest.raises(InputError, match="photographs have samples"):
            photometric_stereo(
                images[:few],
                bumpy.mask,
                method=name,
                lights=point_lights(few) if name == "calibrated" else None,
                intrinsics=torch.eye(3).double() if name == "perspective" else None,
            )
