import math
import warnings
from functools import cache

import pytest
import torch
from scenes import each_bucket
from torch import nn
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_torch as pt
from pimper_torch.chains.photometric import warn_of_priors
from pimper_torch.geometry.pinholes import pinholes
from pimper_torch.geometry.rigid import rotate
from pimper_torch.geometry.topology import face_edges
from pimper_torch.records import ContourPoints, FacetPoints, PatchPriors
from pimper_torch.stages.fusion.equations import Equations
from pimper_torch.stages.fusion.fuse_config import KINDS, FuseConfig
from pimper_torch.stages.fusion.terms import (
    TERMS,
    KeptSlopes,
    Normals,
    SweptHeights,
    Term,
    TouchedRays,
)


def without(*names: str) -> tuple[str, ...]:
    return tuple(name for name in FuseConfig().terms if name not in names)


# Silhouettes without constraint.
FREE = pt.Contours.none(
    pt.Silhouettes(
        inside=torch.ones(1, 1, 1), reliable=torch.zeros(1, dtype=torch.bool), source="everything"
    ),
    pinholes(torch.eye(4)[None], 1.0, 1, 1),
)


@pytest.fixture(scope="session")
def swept(lift):
    @cache
    def make(height: float):
        lifted = lift(height)
        scene = lifted.scene
        return lifted, pt.Sweep()(scene.views, scene.cameras, lifted.seen, lifted.photometric)

    return make


def off_plane(lifted, surface) -> torch.Tensor:
    """Distances from the plane, in samples."""
    spacing = lifted.seen.patches.buckets[0].spacing[0]
    return (surface.vertices_world.double() @ lifted.normal) / spacing


def test_facets_off_a_plane_are_moved_onto_it(swept):
    lifted, given = swept(-1.5)
    surface = pt.Fuse()(given, FREE)
    off = off_plane(lifted, surface).abs()
    assert off.quantile(0.9) < 0.05
    assert off.max() < 0.3
    cosine = (surface.normals_world.double() @ lifted.normal).clamp(-1, 1)
    assert cosine.acos().rad2deg().quantile(0.9) < 0.5
    spacing = float(lifted.seen.patches.buckets[0].spacing[0])
    assert abs(float(surface.convergence.residual) / spacing - abs(lifted.height)) < 0.1


def test_heights_alone_move_facets_and_slopes_alone_do_not(swept):
    lifted, given = swept(1.0)
    heights = pt.Fuse(FuseConfig(terms=without("normals")))(given, FREE)
    assert off_plane(lifted, heights).abs().median() < 0.05
    slopes = pt.Fuse(FuseConfig(terms=without("swept_heights", "cloud_points")))(given, FREE)
    # Heights are undetermined: the facets, which are parallel, stay a sample above.
    assert (off_plane(lifted, slopes) - lifted.height).abs().max() < 0.05


def test_normal_bias_of_a_facet_does_not_tilt_it(swept):
    lifted, given = swept(0.5)

    def tilt(found):
        wrong = found.normals_patch + torch.tensor([0.15, 0.0, 0.0]).double()
        return found.replace(normals_patch=normalize(wrong, dim=-1))

    tilted = given.replace(photometric=each_bucket(given.photometric, tilt))
    kept = off_plane(lifted, pt.Fuse()(tilted, FREE))
    trusting = off_plane(lifted, pt.Fuse(FuseConfig(bias_iterations=0))(tilted, FREE))
    assert kept.std() < 0.1
    assert kept.std() < 0.5 * trusting.std()


def test_normals_perpendicular_to_the_heights_raise_no_fold(swept):
    lifted, given = swept(1.0)

    def spoil(found):
        normals = found.normals_patch.clone()
        size = normals.shape[1] // 3
        wrong = normalize(torch.tensor([1.0, 0.0, -0.05], dtype=torch.float64), dim=0)
        normals[:, size : 2 * size, size : 2 * size] = wrong
        return found.replace(normals_patch=normals)

    wrong = given.replace(photometric=each_bucket(given.photometric, spoil))
    surface = pt.Fuse(FuseConfig(terms=without("swept_heights")))(wrong, FREE)
    assert (off_plane(lifted, surface) - lifted.height).abs().max() < 1.0  # a fold: 5.6


def spoiled(given, **changes):
    """Change one sample of the photometry of facet 1."""
    buckets = []
    for templates, found in zip(given.patches.buckets, given.photometric.buckets, strict=True):
        new = {name: getattr(found, name).clone() for name in changes}
        for name, value in changes.items():
            new[name][templates.facet == 1, 3, 3] = value
        buckets.append(found.replace(**new))
    return given.replace(photometric=given.photometric.replace(buckets=tuple(buckets)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"normals_patch": torch.tensor([0.0, 0, 1]).double()}, "1 of .* face away"),
        ({"normals_patch": torch.tensor([1.0, 0, 0]).double()}, "1 of .* face away"),
        ({"normals_patch": torch.full((3,), torch.nan).double()}, "1 of .* NaN"),
        ({"information": -0.1}, "information has 1 .* such as -0.1"),
        ({"information": torch.nan}, "such as nan"),
    ],
)
def test_impossible_normals_and_information_are_rejected(swept, changes, message):
    _, given = swept(0.5)
    with pytest.raises(pt.InputError, match=message):
        pt.Fuse()(spoiled(given, valid=True, **changes), FREE)


def test_invalid_normals_may_face_away(swept):
    _, given = swept(0.5)
    away = spoiled(given, valid=False, normals_patch=torch.tensor([0.0, 0, 1]).double())
    assert pt.Fuse()(away, FREE).vertices_world.isfinite().all()


def with_points(given, points, claimed: float):
    """Add cloud points to the coarse mesh, with `claimed` as their standard error."""
    covariance = claimed**2 * torch.eye(3).double().expand(len(points), 3, 3)
    facet = (points[:, 1] > points[:, 0]).long()
    cloud = FacetPoints(points_world=points, covariance_world=covariance, facet=facet)
    patches = given.patches
    patches = patches.replace(coarse=patches.coarse.replace(points=cloud))
    return given.replace(photometric=given.photometric.replace(patches=patches))


def near_plane(lifted, noise: float, count: int = 24) -> torch.Tensor:
    """Return points near the plane, with noise in scene units."""
    generator = torch.Generator().manual_seed(75)
    xy = torch.tensor([0.5, 0.4]) * (torch.rand(count, 2, generator=generator) - 0.5)
    xy, normal = xy.double(), lifted.normal
    points = torch.cat([xy, -(xy @ normal[:2, None]) / normal[2]], dim=1)
    return points + noise * torch.randn(points.shape, generator=generator).double()


def test_biased_heights_do_not_outvote_points(swept):
    lifted, given = swept(0.5)
    spacing = float(given.patches.buckets[0].spacing[0])
    known = with_points(given, near_plane(lifted, 0.1 * spacing), 0.1 * spacing)
    # Wrong shading shifts all heights at which views agree.
    wrong = tuple(b.replace(offset=b.offset + 1.5 * spacing) for b in given.buckets)
    misled = known.replace(buckets=wrong)
    off = off_plane(lifted, pt.Fuse()(misled, FREE))
    assert off.abs().quantile(0.9) < 0.1
    assert off_plane(lifted, pt.Fuse(FuseConfig(bias_iterations=0))(misled, FREE)).median() > 0.5
    # Correct heights still help: they carry more information than a few points.
    assert off_plane(lifted, pt.Fuse()(known, FREE)).abs().quantile(0.9) < 0.05


class Touching(pt.Contours):
    """Contours with given tangent points, independent of the surface."""

    def __init__(self, points, normal, sigma):
        tangent = ContourPoints(
            points_world=points,
            normals_world=normal.expand_as(points),
            variance=torch.full_like(points[:, 0], sigma**2),
            view=torch.zeros(len(points), dtype=torch.long),
            ray=torch.arange(len(points)),
        )
        for name in ("silhouettes", "rays", "cameras", "hull"):
            object.__setattr__(self, name, getattr(FREE, name))
        object.__setattr__(self, "tangent", tangent)

    def touching(self, points_world, normals_world):
        return self.tangent


def test_contours_pull_the_surface_to_tangency(swept):
    lifted, given = swept(1.0)
    spacing = float(given.patches.buckets[0].spacing[0])
    along = torch.tensor([1.0, 0.0, 0.0]).double()
    ray = normalize(along - (along @ lifted.normal) * lifted.normal, dim=0)
    points = near_plane(lifted, 0.0, count=60)
    # The tangent point may be anywhere on its ray, which is in the plane.
    points = points + 3 * spacing * torch.linspace(-1, 1, 60).double()[:, None] * ray
    contours = Touching(points, lifted.normal, 0.1 * spacing)
    silent = FuseConfig(terms=without("swept_heights", "cloud_points"))
    assert off_plane(lifted, pt.Fuse(silent)(given, contours)).abs().quantile(0.9) < 0.1
    deaf = FuseConfig(terms=without("swept_heights", "cloud_points", "contour_rays"))
    unheard = pt.Fuse(deaf)(given, contours)
    assert (off_plane(lifted, unheard) - lifted.height).abs().max() < 0.05
    # A tenth of them are off the object: the others outvote them.
    points[::10] += 5 * spacing * lifted.normal
    wrong = pt.Fuse(silent)(given, Touching(points, lifted.normal, 0.1 * spacing))
    assert off_plane(lifted, wrong).abs().quantile(0.9) < 0.3


def test_overconfident_points_raise_no_pimples(swept):
    lifted, given = swept(0.5)
    spacing = float(given.patches.buckets[0].spacing[0])
    # Facets tilted against each other: tilts that cannot be blended must not cost detail.
    buckets = []
    for found, templates in zip(given.photometric.buckets, given.patches.buckets, strict=True):
        lean = 0.1 * (1 - 2 * templates.facet.double())[:, None, None]
        wrong = found.normals_patch + torch.stack([lean, 0 * lean, 0 * lean], dim=-1)
        buckets.append(found.replace(normals_patch=normalize(wrong, dim=-1)))
    tilted = given.replace(photometric=given.photometric.replace(buckets=tuple(buckets)))
    points = near_plane(lifted, 0.3 * spacing, count=60)
    surface = pt.Fuse(FuseConfig(max_lost=0.0))(with_points(tilted, points, 0.02 * spacing), FREE)
    off = off_plane(lifted, surface)
    edges = face_edges(surface.faces)[0]
    edges = torch.cat([edges, edges.flip(1)])
    around = torch.zeros_like(off).index_add(0, edges[:, 0], off[edges[:, 1]])
    pimple = off - around / torch.bincount(edges[:, 0])
    assert pimple.abs().max() < 0.1


def test_an_unlit_surface_keeps_its_shape(swept):
    lifted, given = swept(0.8)
    dark = each_bucket(unlit(given), lambda found: found.replace(information=0 * found.information))
    surface = pt.Fuse()(dark, FREE)
    off = off_plane(lifted, surface)
    assert off.std() < 1e-4  # as flat as the facets, and not moved
    assert abs(float(off.mean()) - lifted.height) < 0.02
    assert (surface.confidence == 0).all()


def in_the_centre_of_each(found, spoiled):
    """Make a square in the centre of every template dark, and apply ``spoiled`` to it."""
    valid = found.valid.clone()
    centre = valid.shape[-1] // 2
    square = (slice(None), slice(centre - 4, centre + 4), slice(centre - 4, centre + 4))
    valid[square] = False
    spoiled(square)
    return found.replace(valid=valid, information=found.information * valid)


def test_albedo_of_unlit_surface_is_inpainted_from_its_surroundings(swept):
    _, given = swept(0.8)
    photometric = each_bucket(
        given.photometric, lambda found: in_the_centre_of_each(found, lambda square: None)
    )
    whole, holed = pt.Fuse()(given, FREE), pt.Fuse()(given.replace(photometric=photometric), FREE)
    dark = holed.confidence == 0
    assert dark.any()
    off = (holed.albedo - whole.albedo)[dark].abs()
    assert off.median() < 0.1 * whole.albedo.mean()
    assert off.max() < 0.5 * whole.albedo.mean()


def with_dark_dents(given, spacings: float):
    """Add a dent without light or swept heights to the centre of every template."""
    spacing = float(given.patches.buckets[0].spacing[0])
    templates, found, heights = [], [], []
    buckets = zip(given.patches.buckets, given.photometric.buckets, given.buckets, strict=True)
    for template, photometry, swept_there in buckets:
        depth, known = template.depth.clone(), swept_there.information.clone()

        def dent(square, depth=depth, known=known):
            depth[square] += spacings * spacing
            known[square] = 0

        found.append(in_the_centre_of_each(photometry, dent))
        templates.append(template.replace(depth=depth))
        heights.append(swept_there.replace(information=known))
    patches = given.patches.replace(buckets=tuple(templates))
    photometric = given.photometric.replace(buckets=tuple(found), patches=patches)
    return given.replace(photometric=photometric, buckets=tuple(heights))


def test_a_dent_without_evidence_is_bridged(swept):
    lifted, given = swept(0.0)
    surface = pt.Fuse()(with_dark_dents(given, 5.0), FREE)
    assert (surface.confidence == 0).any()
    assert off_plane(lifted, surface).abs().max() < 0.5


def test_inpainted_normals_do_not_outvote_points(swept):
    lifted, given = swept(0.0)
    spacing = float(given.patches.buckets[0].spacing[0])
    holed = with_dark_dents(given, 0.0)
    fuse = pt.Fuse(FuseConfig(max_lost=0.0))  # the same vertex spacing in the holes as elsewhere
    flat = fuse(holed, FREE)
    (dark,) = torch.nonzero((flat.confidence == 0) & (flat.facet == 0), as_tuple=True)
    places = flat.vertices_world[dark].double()
    inner = (places - places.mean(dim=0)).norm(dim=1) < 2.5 * spacing
    raised = places[inner] + 0.5 * spacing * lifted.normal
    # The raised points are a sixth of all: too many to count as noise of the cloud.
    points = torch.cat([near_plane(lifted, 0.0, count=240), raised])
    surface = fuse(with_points(holed, points, 0.02 * spacing), FREE)
    off = off_plane(lifted, surface)
    assert off[dark[inner]].median() > 0.4  # as stiff as the lit surface: 0.14
    assert off[surface.confidence > 0].median() < 0.01


def test_fusion_without_terms_is_rejected():
    with pytest.raises(pt.ConfigError, match=r"fuse\.terms"):
        FuseConfig(terms=())


class At(Term):
    """Equations that place all vertices at one height above the facets."""

    def __init__(self, height: float) -> None:
        super().__init__()
        self.height = nn.Parameter(torch.tensor(height, dtype=torch.float64))

    def equations(self, problem):
        vertex = torch.arange(len(problem.points))[:, None]
        ones = torch.ones_like(problem.blend.heights)
        return [
            Equations(
                unknowns=vertex,
                coefficients=ones[:, None],
                targets=self.height * ones,
                information=1e6 * ones / problem.spacing**2,
                correlated=ones,
                evaluated=False,
            )
        ]


def test_a_custom_term_is_fused_and_its_parameters_have_gradients(swept):
    lifted, given = swept(1.0)
    spacing = float(given.patches.buckets[0].spacing[0])
    own = At(0.7 * spacing)
    fuse = pt.Fuse(FuseConfig(noise_iterations=1, error_draws=0), [KeptSlopes(), own])
    surface = fuse(given, FREE)
    assert_close(
        off_plane(lifted, surface), torch.full_like(surface.information, 1.7), atol=1e-2, rtol=0
    )
    surface.vertices_world.sum().backward()
    # All facets are raised together: every vertex moves along its direction.
    assert own.height.grad.abs() > 0.9 * len(surface.information) * abs(float(lifted.normal.sum()))
    with pytest.raises(pt.ConfigError, match="modules derived from Term"):
        pt.Fuse(terms=[nn.Identity()])


class WithEveryMethod(At):
    """The same with an error that all heights share, known slopes and a list of calls."""

    rank = 1

    def __init__(self, height: float, calls: list[str], variance: float = 0.0) -> None:
        super().__init__(height)
        self.calls, self.variance = calls, variance

    def bound(self, problem, contours):
        assert contours is FREE
        self.calls.append("bound")
        self.size = len(problem.points)
        return self

    def sloped(self, problem):
        self.calls.append("sloped")
        return torch.full_like(problem.lit, self.variance > 0)

    def equations(self, problem):
        full = len(problem.points) > self.size
        self.calls.append("equations at full size" if full else "equations")
        assert bool(problem.sloped.all()) == (self.variance > 0)
        (kind,) = super().equations(problem)
        return [kind.replace(information=1 / (1 / kind.information + self.variance))]

    def reestimate(self, problem, heights, trusted):
        self.calls.append("reestimate")
        error = float((heights[trusted] - self.height).median().detach())
        term = WithEveryMethod(float(self.height.detach()), self.calls, error**2)
        term.size = self.size
        return term


def test_methods_of_a_term_are_called_in_the_documented_order(swept):
    lifted, given = swept(0.0)
    spacing = float(given.patches.buckets[0].spacing[0])
    given = with_points(with_dark_dents(given, 0.0), near_plane(lifted, 0.0), 0.1 * spacing)
    calls, wrong = [], 3 * spacing
    terms = [*pt.Fuse().terms, WithEveryMethod(wrong, calls)]
    surface = pt.Fuse(FuseConfig(bias_iterations=1, error_draws=0), terms)(given, FREE)
    assert calls == [
        *("bound", "sloped", "equations"),
        # The term now determines all slopes, so all terms are assembled again.
        *("reestimate", "sloped", "sloped", "equations"),
        *("sloped", "equations at full size"),
    ]
    # Its common error of three spacings is estimated from the points, which outvote it.
    assert off_plane(lifted, surface).abs().quantile(0.9) < 0.1
    sure = pt.Fuse(FuseConfig(error_draws=0), [*pt.Fuse().terms, At(wrong)])(given, FREE)
    assert off_plane(lifted, sure).median() > 1


def test_named_terms_equal_listed_terms(swept):
    _, given = swept(1.0)
    named = pt.Fuse(FuseConfig(terms=without("cloud_points")))(given, FREE)
    listed = [KeptSlopes(), TouchedRays(), SweptHeights(), Normals()]
    assert torch.equal(named.vertices_world, pt.Fuse(terms=listed)(given, FREE).vertices_world)


def with_prior_normals(lifted, given, lean: float, error_deg: float):
    """Add priors of the plane's normal, all with the same tilt."""
    buckets = []
    for own, templates in zip(given.buckets, given.patches.buckets, strict=True):
        axis = torch.tensor([1.0, 0.0, 0.0]).double()
        across = normalize(axis - (axis @ lifted.normal) * lifted.normal, dim=0)
        normal = normalize(lifted.normal + lean * across, dim=0)
        rotated = rotate(templates.patch_from_world, normal.expand(len(templates.facet), 1, 3))
        priors = PatchPriors(
            normals_patch=rotated[:, :, None].expand(*own.offset.shape, 3),
            normal_information=torch.full_like(own.offset, math.radians(error_deg) ** -2),
            offset=torch.zeros_like(own.offset),
            offset_information=torch.zeros_like(own.offset),
            albedo=torch.zeros_like(own.offset),
            albedo_variance=torch.full_like(own.offset, math.inf),
        )
        buckets.append(own.replace(priors=priors))
    return given.replace(buckets=tuple(buckets))


def unlit(given):
    def dark(found):
        return found.replace(valid=found.valid & False, information=0 * found.information)

    return given.replace(photometric=each_bucket(given.photometric, dark))


def test_a_contradicted_prior_is_overruled_despite_its_small_error(swept):
    lifted, given = swept(0.5)
    surface = pt.Fuse()(given, FREE)
    plain = off_plane(lifted, surface).abs()
    for error_deg in (5.0, 1.0):
        wrong = with_prior_normals(lifted, given, lean=0.3, error_deg=error_deg)
        off = off_plane(lifted, pt.Fuse()(wrong, FREE)).abs()
        assert off.quantile(0.9) < plain.quantile(0.9) + 0.05
    deaf = pt.Fuse(FuseConfig(terms=without("prior_normals")))(wrong, FREE)
    assert torch.equal(deaf.vertices_world, surface.vertices_world)


def test_normal_priors_determine_slopes_of_unlit_surface(swept):
    lifted, given = swept(0.5)
    axis = torch.tensor([1.0, 0.0, 0.0]).double()
    across = normalize(axis - (axis @ lifted.normal) * lifted.normal, dim=0)
    silent = FuseConfig(terms=without("swept_heights", "cloud_points"), bias_iterations=0)
    surface = pt.Fuse(silent)(with_prior_normals(lifted, unlit(given), 0.1, 0.5), FREE)
    away = off_plane(lifted, surface)
    along = surface.vertices_world.double() @ across
    along = along / float(given.patches.buckets[0].spacing[0])
    slope = ((along - along.mean()) * away).mean() / along.var(correction=0)
    assert -0.1 < slope < -0.08  # kept slopes pull against it


def test_disagreement_of_priors_is_reported_and_warned_of(swept):
    lifted, given = swept(0.5)
    assert given.figures() == {}
    right = with_prior_normals(lifted, given, lean=0.0, error_deg=1.0).figures()
    assert right["prior_normals_deg"] < 0.1
    wrong = with_prior_normals(lifted, given, lean=0.3, error_deg=1.0).figures()
    assert abs(wrong["prior_normals_deg"] - math.degrees(math.atan(0.3))) < 0.5
    with pytest.warns(pt.PimperWarning, match=r"Prior normals deviate .* 7\.0 times"):
        warn_of_priors(wrong)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_priors(right)


def test_settings_list_the_kinds_of_terms():
    assert tuple(TERMS) == KINDS
