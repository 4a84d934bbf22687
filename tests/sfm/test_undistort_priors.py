import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from pimper_torch.geometry.pixels import pixel_centers
from pimper_torch.geometry.undistortion import photograph_pixels
from pimper_torch.priors.undistort import with_undistorted_priors
from pimper_torch.records import (
    AlbedoPrior,
    CameraModel,
    DepthPrior,
    InlierPrior,
    LightPrior,
    NormalPrior,
    SilhouettePrior,
)

SIZE = 60, 40
BARREL = CameraModel(
    camera=1, model="SIMPLE_RADIAL", params=(90.0, 31.0, 19.0, -0.2), width=60, height=40
)
PINCUSHION = BARREL.replace(params=(40.0, 31.0, 19.0, 2.0))  # extends beyond the edge


@pytest.fixture
def scene(reconstruction):
    return reconstruction.scene.replace(lenses=(BARREL, PINCUSHION, BARREL))


def placed(scene, *priors):
    scene = scene.replace(views=scene.views.replace(priors=priors))
    found = with_undistorted_priors(scene).views.priors
    assert all(prior.undistorted for prior in found)
    return found


def of_one(kind, size=SIZE, name="a.png", **maps):
    """Return a prior of one photograph."""
    return kind(names=(name,), sizes_px=torch.tensor([size]), **maps)


@pytest.mark.parametrize("size", [(60, 40), (30, 20), (90, 80)])
def test_maps_of_any_size_are_undistorted_like_the_photograph(scene, size):
    """A ramp gives the source of every pixel; both ends are in pixels of the map."""
    width, height = size
    ramp = pixel_centers(width, height, like=torch.zeros(()))
    raster = torch.full((1, height + 3, width + 5), torch.nan)
    raster[:, :height, :width] = ramp[..., 0]
    prior = of_one(DepthPrior, size, depth=raster, variance=torch.full_like(raster, 0.01))
    (found,) = placed(scene, prior)
    factor = torch.tensor([60 / width, 40 / height], dtype=torch.float64)
    expected = photograph_pixels(BARREL, width, height)
    whole = photograph_pixels(BARREL)
    if size == (60, 40):
        assert_close(expected, whole)
    # The camera model, in pixels of the photograph: f (1 + k r^2) x + c.
    f, cx, cy, k = BARREL.params
    plane = (ramp.double() * factor - torch.tensor([cx, cy])) / f
    lens = f * (1 + k * plane.square().sum(-1, keepdim=True)) * plane + torch.tensor([cx, cy])
    assert_close(expected, lens / factor, rtol=0, atol=1e-9)
    inner = (expected >= 0.5).all(-1) & (expected <= torch.tensor(size) - 0.5).all(-1)
    assert inner.float().mean() > 0.95
    got = found.depth[0, :height, :width].double()
    assert_close(got[inner], expected[..., 0][inner], rtol=0, atol=1e-4)
    assert (found.sizes_px == prior.sizes_px).all()
    # Neighbours on a ramp differ by at most 1: a quarter of its square is added.
    assert (found.variance[0, :height, :width] >= 0.01 - 1e-6).all()
    assert (found.variance[0, :height, :width] <= 0.26 + 1e-6).all()


def test_pixels_beyond_the_edge_are_unknown(scene):
    ones = torch.ones(1, 40, 60)
    depth, inside, inlier = placed(
        scene,
        of_one(DepthPrior, name="b.png", depth=ones, variance=ones),
        of_one(SilhouettePrior, name="b.png", inside=ones),
        of_one(InlierPrior, name="b.png", probability=ones),
    )
    source = photograph_pixels(PINCUSHION)
    past = ~((source >= 0) & (source <= torch.tensor(SIZE))).all(-1)
    assert 0.02 < past.float().mean() < 0.5
    assert torch.equal(depth.variance[0].isinf(), past)
    assert_close(depth.variance[0][~past], ones[0][~past])
    for probability in (inside.inside, inlier.probability):
        assert (probability[0][past] == 0.5).all()
        assert_close(probability[0][~past], ones[0][~past])


def test_values_are_weighted_by_their_precision(scene):
    """An unknown column has no weight; a column of large variance has little more."""
    columns = torch.arange(60.0).expand(1, 40, 60)
    odd = (columns % 2 == 1) & (columns > 0)
    values = torch.where(odd, 7.0, 3.0)

    def resampled(variance):
        weight = torch.where(odd, variance, 0.04)
        (found,) = placed(scene, of_one(AlbedoPrior, albedo=values[:, None], variance=weight))
        return found.albedo[:, 0], found.variance

    unknown, variance = resampled(torch.inf)
    known = variance.isfinite()
    assert known.float().mean() > 0.8
    assert_close(unknown[known], torch.full_like(unknown[known], 3.0))
    assert (variance[known] >= 0.04 - 1e-6).all()
    (vague, _), (evenly, mixed) = resampled(4.0), resampled(0.04)
    assert ((vague - 3).abs() <= (evenly - 3).abs() + 1e-5).all()
    # Midway between 3 and 7, the mean is 2 off both.
    middle = (evenly - 5).abs() < 0.05
    assert middle.any()
    assert_close(mixed[middle], torch.full_like(mixed[middle], 4.04), rtol=0.01, atol=0)


def test_normals_stay_unit_and_their_spread_adds_variance(scene, generator):
    normals = torch.randn(2, 20, 30, 3, generator=generator)
    normals = normalize(normals, dim=-1)
    prior = NormalPrior(
        names=("z.png", "c.png"),
        sizes_px=torch.tensor([[30, 20], [30, 20]]),
        normals=normals,
        variance=torch.full((2, 20, 30), 0.01),
    )
    (found,) = placed(scene, prior)
    assert found.names == ("c.png",)  # photographs outside the scene are dropped
    found.check("test")
    # The mean square of unit vectors about their mean is 1 - |mean|^2.
    at = photograph_pixels(BARREL, 30, 20)[9, 14] - 0.5
    column, row = (int(value) for value in at.floor())
    part = at - at.floor()
    weights = torch.tensor([[1 - part[1]], [part[1]]]) * torch.tensor([1 - part[0], part[0]])
    corner = normals[1, row : row + 2, column : column + 2].double()
    mean = (weights[..., None] * corner).sum(dim=(0, 1))
    assert_close(found.normals[0, 9, 14].double(), normalize(mean, dim=0), rtol=0, atol=1e-5)
    expected = 0.01 + 1 - mean.square().sum()
    assert_close(found.variance[0, 9, 14].double(), expected, rtol=0, atol=1e-5)


def test_maps_of_undistorted_photographs_are_bitwise_unchanged(reconstruction, generator):
    depth = torch.rand(1, 13, 17, generator=generator)
    prior = of_one(DepthPrior, (17, 13), depth=depth, variance=depth + 1)
    for lenses in (reconstruction.scene.lenses, ()):
        (found,) = placed(reconstruction.scene.replace(lenses=lenses), prior)
        assert torch.equal(found.depth, depth)
        assert torch.equal(found.variance, depth + 1)


def test_undistorted_maps_and_lights_are_unchanged(scene):
    inside = of_one(SilhouettePrior, (4, 4), inside=torch.ones(1, 4, 4), undistorted=True)
    lights = LightPrior(lights=torch.ones(1, 4), variance=torch.ones(1), names=("a.png",))
    given = scene.replace(views=scene.views.replace(priors=(inside, lights)))
    assert with_undistorted_priors(given) is given


def test_gradients_reach_values_and_variances(scene):
    lens = BARREL.replace(width=6, height=5, params=(6.0, 3.0, 2.5, 1.0))
    scene = scene.replace(lenses=(lens,) * 3)

    def resampled(normals, variance):
        (found,) = placed(scene, of_one(NormalPrior, (6, 5), normals=normals, variance=variance))
        known = found.variance.isfinite()
        return found.normals[known], found.variance[known]

    generator = torch.Generator().manual_seed(3)
    normals = torch.randn(1, 5, 6, 3, generator=generator).double().requires_grad_()
    variance = torch.rand(1, 5, 6, generator=generator).double() + 1
    assert torch.autograd.gradcheck(resampled, (normals, variance.requires_grad_()))
    # Unknown values, even NaN, have no gradient.
    hole = variance.detach().clone()
    hole[0, 2, 3] = torch.inf
    broken = normals.detach().clone()
    broken[0, 2, 3] = torch.nan
    broken.requires_grad_()
    resampled(broken, hole)[0].sum().backward()
    assert broken.grad.isfinite().all()
    assert (broken.grad[0, 2, 3] == 0).all()
