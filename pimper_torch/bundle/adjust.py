"""Bundle after the fact: cameras, adjusted to what the photographs show on the surface."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pimper_torch.bundle.motions import lens_groups
from pimper_torch.bundle.samples import (
    Samples,
    choose_samples,
    footprint_levels,
    gray_pyramid,
)
from pimper_torch.bundle.solve import (
    Guess,
    Held,
    Residuals,
    adjust,
    pixel_motion,
    residuals,
    untold_motions,
)
from pimper_torch.config import require
from pimper_torch.errors import InputError
from pimper_torch.records import Cameras, Lens, PatchViews, PhotometricPatches, Record, Views

# Samples below which nothing is adjusted: a camera has six numbers.
_FEWEST_SAMPLES = 200

_PYRAMID_LEVELS = 5

_GAIN_ROUNDS = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class AdjustConfig:
    """Settings of :class:`Adjust`.

    Attributes:
        focals: Whether focal lengths are adjusted, one for all views of a lens.
        num_samples: Drawn at most; a quarter of the facets' are held out.
        held_out: Share of the facets whose samples judge and do not fit.
        min_confidence: Of the photometry, for a sample to be drawn.
        blur_levels: Levels of the image pyramid to begin above the samples' own: each doubles
            how far off cameras may start.
        iterations: On each level, at most.
        min_gain: Share by which the held-out residual must fall, in all and in each view.
        max_residual: Median residual over median radiance of held-out samples above which the
            photometry explains the photographs too badly to move cameras by it.
        max_motion_px: A camera that would move samples further, in the mean, keeps its place.
        min_rise: Share of the noise's variance by which a pixel of a motion that all cameras
            share must raise the mean squared residual, to count as told.
    """

    focals: bool = True
    num_samples: int = 12_000
    held_out: float = 0.25
    min_confidence: float = 0.1
    blur_levels: int = 1
    iterations: int = 12
    min_gain: float = 0.01
    max_residual: float = 0.15
    max_motion_px: float = 8.0
    min_rise: float = 0.5

    def __post_init__(self) -> None:
        few = _FEWEST_SAMPLES
        require(self.num_samples >= few, "adjust.num_samples", self.num_samples, f"{few} or more")
        require(0 < self.held_out < 1, "adjust.held_out", self.held_out, "in (0, 1)")
        least = self.min_confidence
        require(0 <= least <= 1, "adjust.min_confidence", least, "in [0, 1]")
        require(self.blur_levels >= 0, "adjust.blur_levels", self.blur_levels, "0 or more")
        require(self.iterations >= 1, "adjust.iterations", self.iterations, "1 or more")
        require(0 <= self.min_gain < 1, "adjust.min_gain", self.min_gain, "in [0, 1)")
        require(self.max_residual > 0, "adjust.max_residual", self.max_residual, "above 0")
        require(self.max_motion_px > 0, "adjust.max_motion_px", self.max_motion_px, "above 0")
        require(self.min_rise >= 0, "adjust.min_rise", self.min_rise, "0 or more")


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Adjustment(Record):
    """Cameras after the fact, and what speaks for them.

    Residuals are robust (Cauchy's loss, outliers bounded), as shares of the mean radiance.

    Attributes:
        cameras: Adjusted where that was kept, else as they came.
        kept: Views whose cameras changed.
        fit_before: Residual of the samples that were fitted, gains and offsets free.
        fit_after: With the adjusted cameras.
        held_before: Residual of each view's held-out samples.
        held_after: With the adjusted cameras, whether or not they were kept.
        motion_px: How far the adjustment moves samples in each view, in the mean.
        common: How many of the seven motions that all cameras share were told by nothing and
            taken out.
        focal_growth: Factor of each view's focal length.
        samples: How many were fitted, and how many held out.
        reason: Why cameras were kept as they came, or empty.
    """

    cameras: Cameras
    kept: Bool[Tensor, " view"]
    fit_before: float
    fit_after: float
    held_before: Float[Tensor, " view"]
    held_after: Float[Tensor, " view"]
    motion_px: Float[Tensor, " view"]
    common: int
    focal_growth: Float[Tensor, " view"]
    samples: tuple[int, int]
    reason: str = ""


class Adjust(nn.Module):
    r"""Move cameras so that what they show on the surface agrees with light and albedo.

    Structure from motion knows cameras by a few hundred points; the surface, once its albedo
    and light are known, has a comparison for every pixel. Residuals are
    :math:`I_g(\pi_g(X_i)) - \rho_i (a_g\, l_g \cdot (1, n_i) + o_g)`, robust (Cauchy); the image
    is looked up in a pyramid as registration does, its slope by autograd. Poses, focal lengths
    (one a lens), gains and offsets are solved by damped Gauss-Newton with all :math:`\rho_i`
    eliminated. The surface, its normals and the lights are held.

    What is kept is decided on facets that were not fitted: the residual must fall there, in
    all views together, and a view in which it does not keeps its camera. A view that goes its own
    way so no longer shares the focal length of its lens.

    The surface does not move, so cameras can only move with respect to it. Of the motions that
    all share (a similarity) those which the photographs do not tell are taken out; on a sphere,
    for instance, all cameras may turn about its centre, the texture with them.

    Where it fails: a surface that is wrong everywhere in the same way, such as flat facets on a
    ball, pulls cameras, and the facets held out do not object. Adjust on the surface of a late
    round. Albedo and lights that were found with the old cameras are blurred, so that not all is
    mended at once: 0.6 px become 0.15 on a ball of 60 facets, 1.5 px become 0.3.

    Cameras are constants to autograd: nothing here is differentiable. Lenses are not touched:
    the focal lengths are those of the undistorted pinholes. Templates and everything made with
    the old cameras should be made anew.

    Source: of direct alignment, Delaunoy & Pollefeys, Photometric bundle adjustment, CVPR 2014;
    that light is known, albedo eliminated and other facets judge is ours.
    """

    def __init__(self, config: AdjustConfig | None = None) -> None:
        super().__init__()
        self.config = config or AdjustConfig()

    @torch.no_grad()
    def forward(
        self,
        views: Views,
        cameras: Cameras,
        seen: PatchViews,
        found: PhotometricPatches,
        lenses: Sequence[Lens] = (),
        generator: torch.Generator | None = None,
    ) -> Adjustment:
        """Adjust the cameras.

        Args:
            views: Undistorted photographs.
            cameras: Theirs, with which ``seen`` was registered.
            seen: Which sample is seen in which view, and where on the surface it lies.
            found: Albedo, normals and lights of the same patches.
            lenses: One a view; without, every view has a focal length of its own.
            generator: On the CPU; draws samples and the facets held out.

        Raises:
            InputError: Records that do not belong together.
        """
        config = self.config
        _require_alike(views, cameras, seen, found, lenses)
        generator = generator or torch.Generator().manual_seed(0)
        drawn = choose_samples(seen, found, config.num_samples, config.min_confidence, generator)
        facets = torch.rand(len(seen.patches.coarse.mesh.faces), generator=generator)
        held = (facets < config.held_out).to(drawn.facet.device)[drawn.facet]
        fitted, judges = drawn.take(~held), drawn.take(held)
        ones = torch.ones(cameras.num_views).to(drawn.shading)
        begin = Guess(
            cameras=cameras.replace(
                intrinsics=cameras.intrinsics.double(),
                cam_from_world=cameras.cam_from_world.double(),
            ),
            gain=ones,
            offset=torch.zeros_like(ones),
        )
        enough = min(len(fitted.facet), 3 * len(judges.facet)) >= _FEWEST_SAMPLES
        if not enough:
            reason = f"{len(fitted.facet)} and {len(judges.facet)} samples are too few"
            return _unchanged(cameras, begin, fitted, judges, reason)
        lens = torch.arange(cameras.num_views)
        if lenses:
            lens = torch.tensor([each.camera for each in lenses])
        lens = lens_groups(lens.to(drawn.facet.device))
        trial = _Trial(config, gray_pyramid(views, _PYRAMID_LEVELS), lens)
        return trial.judge(cameras, begin, fitted, judges)


class _Trial:
    """One adjustment and its judgement."""

    def __init__(
        self,
        config: AdjustConfig,
        pyramid: list[Float[Tensor, "view 2 _ _"]],
        lens: Int[Tensor, " view"],
    ) -> None:
        self.config, self.pyramid, self.lens = config, pyramid, lens

    def judge(self, cameras: Cameras, begin: Guess, fitted: Samples, judges: Samples) -> Adjustment:
        """Fit on some samples, decide on others."""
        config = self.config
        levels = footprint_levels(fitted, begin.cameras)
        # The spread shrinks as gains come right, and outliers are told better: a few times over,
        # or cameras would have the merit of what better gains do.
        before = begin
        for _ in range(_GAIN_ROUNDS):
            before = self._solve(before, fitted, levels, poses=False)
        after = before
        for blur in range(config.blur_levels, -1, -1):
            after = self._solve(after, fitted, levels + blur, poses=True)
        held = untold_motions(
            begin.cameras,
            after,
            fitted,
            residuals(after, fitted, self.pyramid, levels),
            self.lens,
            focals=config.focals,
            min_rise=config.min_rise,
        )
        # Once more, with the spread that well-placed cameras leave.
        after = self._solve(after, fitted, levels, poses=True, held=held)

        motion = pixel_motion(before.cameras, after.cameras, judges)
        there = footprint_levels(judges, begin.cameras)
        first = residuals(before, judges, self.pyramid, there)
        scale = first.scale()
        first = residuals(before, judges, self.pyramid, there, scale)
        last = residuals(after, judges, self.pyramid, there, scale)
        # All views together first: views picked for their residual fall in any case.
        reason = self._objection(first, last, scale)
        chosen = motion <= config.max_motion_px
        for _ in range(len(chosen)):
            mixed = residuals(_mixed(before, after, chosen), judges, self.pyramid, there, scale)
            share = _shares(mixed, scale) / _shares(first, scale)
            worse = chosen & ~(share < 1 - config.min_gain)
            if not bool(worse.any()):
                break
            chosen = chosen & ~worse
        if not reason and not bool(chosen.any()):
            reason = "no view's residual falls on the facets held out"
        if reason:
            chosen = torch.zeros_like(chosen)
        fit_first = residuals(before, fitted, self.pyramid, levels)
        fit_scale = fit_first.scale()
        fit_last = residuals(after, fitted, self.pyramid, levels, fit_scale)
        growth = after.cameras.intrinsics[:, 0, 0] / before.cameras.intrinsics[:, 0, 0]
        final = _mixed(before, after, chosen).cameras
        keep = chosen[:, None, None]
        return Adjustment(
            cameras=cameras.replace(
                intrinsics=torch.where(
                    keep, final.intrinsics.to(cameras.intrinsics), cameras.intrinsics
                ),
                cam_from_world=torch.where(
                    keep, final.cam_from_world.to(cameras.cam_from_world), cameras.cam_from_world
                ),
            ),
            kept=chosen,
            fit_before=float(_shares(fit_first, fit_scale).mean()),
            fit_after=float(_shares(fit_last, fit_scale).mean()),
            held_before=_shares(first, scale),
            held_after=_shares(last, scale),
            motion_px=motion,
            common=held.measure.shape[1],
            focal_growth=growth,
            samples=(len(fitted.facet), len(judges.facet)),
            reason=reason,
        )

    def _solve(
        self,
        guess: Guess,
        samples: Samples,
        levels: Float[Tensor, "view sample"],
        *,
        poses: bool,
        held: Held | None = None,
    ) -> Guess:
        return adjust(
            guess,
            samples,
            self.pyramid,
            levels,
            self.lens,
            poses=poses,
            focals=self.config.focals,
            iterations=self.config.iterations,
            held=held,
        )

    def _objection(self, first: Residuals, last: Residuals, scale: Float[Tensor, " view"]) -> str:
        """Say what speaks against the adjustment, if anything does."""
        left = float(last.value.abs()[last.usable].median() / last.radiance[last.usable].median())
        if not left <= self.config.max_residual:
            return (
                f"the photometry leaves {left:.0%} of the radiance unexplained, more than "
                f"{self.config.max_residual:.0%}"
            )
        before, after = (_shares(one, scale).mean() for one in (first, last))
        if not bool(after < before * (1 - self.config.min_gain)):
            return (
                f"the residual on the facets held out falls by {float(1 - after / before):.2%}, "
                f"less than {self.config.min_gain:.2%}"
            )
        return ""


def _mixed(before: Guess, after: Guess, chosen: Bool[Tensor, " view"]) -> Guess:
    """Take the adjusted camera, gain and offset of the chosen views."""
    some = chosen[:, None, None]
    ours, theirs = before.cameras, after.cameras
    return Guess(
        cameras=ours.replace(
            intrinsics=torch.where(some, theirs.intrinsics, ours.intrinsics),
            cam_from_world=torch.where(some, theirs.cam_from_world, ours.cam_from_world),
        ),
        gain=torch.where(chosen, after.gain, before.gain),
        offset=torch.where(chosen, after.offset, before.offset),
    )


def _shares(found: Residuals, scale: Float[Tensor, " view"]) -> Float[Tensor, " view"]:
    """Give each view's robust residual as a share of its mean radiance."""
    return scale * found.costs(scale).sqrt() / torch.where(found.level > 0, found.level, torch.inf)


def _unchanged(
    cameras: Cameras, begin: Guess, fitted: Samples, judges: Samples, reason: str
) -> Adjustment:
    nothing = torch.zeros_like(begin.gain)
    return Adjustment(
        cameras=cameras,
        kept=nothing > 0,
        fit_before=0.0,
        fit_after=0.0,
        held_before=nothing,
        held_after=nothing,
        motion_px=nothing,
        common=0,
        focal_growth=torch.ones_like(nothing),
        samples=(len(fitted.facet), len(judges.facet)),
        reason=reason,
    )


def _require_alike(
    views: Views,
    cameras: Cameras,
    seen: PatchViews,
    found: PhotometricPatches,
    lenses: Sequence[Lens],
) -> None:
    counts = {"photographs": views.num_views, "cameras": cameras.num_views}
    if seen.buckets:
        counts["registered views"] = seen.buckets[0].valid.shape[1]
    if lenses:
        counts["lenses"] = len(lenses)
    shapes = [tuple(each.valid[:, 0].shape) for each in seen.buckets]
    theirs = [tuple(each.valid.shape) for each in found.buckets]
    if len(set(counts.values())) > 1 or shapes != theirs:
        listed = ", ".join(f"{count} {name}" for name, count in counts.items())
        raise InputError(
            f"adjust: {listed}, {len(shapes)} buckets registered and {len(theirs)} with "
            "photometry; needed: as many of each, in the same order. Hand over the records of "
            "one round."
        )
