r"""Damped Gauss-Newton on cameras, with albedo eliminated.

View g shows sample i as :math:`\rho_i (a_g s_{gi} + o_g)` where its camera puts it: ``s`` is the
shading that light and normal give, gain ``a`` and ambient offset ``o`` take up what the light is
wrong by all over the view, and the albedo :math:`\rho_i` is the best one in closed form. The
surface is held.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.bundle.motions import (
    MOTION,
    common_motions,
    middles_cam,
    motion_between,
    move,
    pixel_slopes,
    scale_focals,
)
from pimper_torch.bundle.samples import Samples, look_up
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.projection import project
from pimper_torch.photometry.lights import CAUCHY_TUNING
from pimper_torch.photometry.robust import cauchy_weights, spread
from pimper_torch.records import Cameras, Record

# A camera's motion, the gain and the offset of its view.
_OWN = MOTION + 2

# The spread of a view's residuals is taken as at least this share of its radiance.
_LEAST_SPREAD = 1e-3

# Rounds of reweighting that an albedo takes to leave outliers behind.
_ALBEDO_ROUNDS = 4

_MOST_DAMPING = 1e8

# Share of the cost that another step must promise.
_LEAST_FALL = 1e-3

# A pixel of a motion that is held costs so much for every residual, in Cauchy's scale squared.
_HOLD = 10.0

# Light is never known better than this: what smaller residuals tell of a motion that all
# cameras share, an error of the light may tell as well.
_LIGHT_ERROR = 0.02


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Guess(Record):
    """Cameras in float64, with what their views are brighter by.

    Attributes:
        cameras: Poses and focal lengths.
        gain: ``a``.
        offset: ``o``.
    """

    cameras: Cameras
    gain: Float[Tensor, " view"]
    offset: Float[Tensor, " view"]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Residuals(Record):
    """What cameras leave unexplained.

    Attributes:
        value: Radiance minus prediction.
        radiance: As found; 0 where not usable.
        slope: Of the radiance by the pixel.
        usable: True where the view has the sample.
        albedo: The best for these cameras.
        weight: Cauchy's, 1 at no residual; 0 where not usable.
    """

    value: Float[Tensor, "sample view"]
    radiance: Float[Tensor, "sample view"]
    slope: Float[Tensor, "sample view 2"]
    usable: Bool[Tensor, "sample view"]
    albedo: Float[Tensor, " sample"]
    weight: Float[Tensor, "sample view"]

    @property
    def level(self) -> Float[Tensor, " view"]:
        """Each view's mean radiance."""
        count = self.usable.sum(dim=0).clamp_min(1)
        return (self.radiance * self.usable).sum(dim=0) / count

    def costs(self, scale: Float[Tensor, " view"]) -> Float[Tensor, " view"]:
        """Give each view's mean of Cauchy's loss in units of the scale squared."""
        loss = torch.log1p((self.value / scale).square()) * self.usable
        return loss.sum(dim=0) / self.usable.sum(dim=0).clamp_min(1)

    def scale(self, least_spread: float = _LEAST_SPREAD) -> Float[Tensor, " view"]:
        """Measure where Cauchy's weight is to be a half: 2.385 spreads of each view.

        Args:
            least_spread: Share of the radiance that a spread is taken to have at least.
        """
        least = (least_spread * self.level).clamp_min(1e-12)
        return CAUCHY_TUNING * torch.maximum(spread(self.value.mT, self.usable.mT), least)


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Held(Record):
    """Motions that cameras are not to make, as seen from where they started.

    Attributes:
        start: The cameras there.
        measure: What each motion is in terms of every view's own numbers, in pixels.
    """

    start: Cameras
    measure: Float[Tensor, "own held"]

    def made(self, guess: Guess, middle_world: Float[Tensor, " 3"]) -> Float[Tensor, " held"]:
        """Give how much of each motion cameras have made, in pixels."""
        ours, theirs = self.start.cam_from_world, guess.cameras.cam_from_world
        total = self.measure.new_zeros(len(ours), _OWN)
        total[:, :6] = motion_between(ours, theirs, middle_world)
        return self.measure.mT @ total.flatten()


def residuals(
    guess: Guess,
    samples: Samples,
    pyramid: list[Float[Tensor, "view 2 _ _"]],
    levels: Float[Tensor, "view sample"],
    scale: Float[Tensor, " view"] | None = None,
) -> Residuals:
    """Look all samples up and compare; without a scale outliers are told by the spread."""
    cameras = guess.cameras
    pixels, depth = project(samples.points_world[:, 0], cameras.cam_from_world, cameras.intrinsics)
    looked = [look_up(pyramid, view, pixels[view], levels[view]) for view in range(len(pixels))]
    radiance, slope, usable = (torch.stack(part, dim=1) for part in zip(*looked, strict=True))
    usable = usable & (depth > 0).mT & samples.seen
    radiance = torch.where(usable, radiance, 0)
    shown = guess.gain * samples.shading + guess.offset
    usable = usable & (shown > 0)
    albedo, weight = samples.albedo, usable.to(radiance)
    for _ in range(_ALBEDO_ROUNDS):
        heavy = weight * shown
        own = (heavy * shown).sum(dim=1)
        albedo = (heavy * radiance).sum(dim=1) / torch.where(own > 0, own, 1)
        value = torch.where(usable, radiance - albedo[:, None] * shown, 0)
        found = Residuals(
            value=value, radiance=radiance, slope=slope, usable=usable, albedo=albedo, weight=weight
        )
        weight = usable * cauchy_weights(value, found.scale() if scale is None else scale)
    return found.replace(weight=weight)


def adjust(
    guess: Guess,
    samples: Samples,
    pyramid: list[Float[Tensor, "view 2 _ _"]],
    levels: Float[Tensor, "view sample"],
    lens: Int[Tensor, " view"],
    *,
    poses: bool,
    focals: bool,
    iterations: int,
    held: Held | None = None,
) -> Guess:
    """Take damped Gauss-Newton steps until the robust cost falls no more.

    Args:
        guess: Where to start.
        samples: What to explain.
        pyramid: See :func:`~pimper_torch.bundle.samples.gray_pyramid`.
        levels: Where in it each sample is looked up.
        lens: Which lens each view was taken with; focal lengths of one grow together.
        poses: Whether cameras may move; if not, only gains and offsets are fitted.
        focals: Whether focal lengths may change too.
        iterations: At most.
        held: Motions they may not make together.
    """
    middle = samples.points_world[:, 0].mean(dim=0)
    scale = residuals(guess, samples, pyramid, levels).scale()
    tie = ties(lens, poses=poses, focals=focals)
    stiff = _HOLD * float(samples.seen.sum())

    def cost_of(found: Residuals, where: Guess) -> Float[Tensor, ""]:
        loss = (torch.log1p((found.value / scale).square()) * found.usable).sum()
        return loss if held is None else loss + stiff * held.made(where, middle).square().sum()

    here = residuals(guess, samples, pyramid, levels, scale)
    cost, damping = cost_of(here, guess), 1e-3
    for _ in range(iterations):
        matrix, rhs = normal_equations(guess, samples, here, scale, middle)
        if held is not None:
            matrix = matrix + stiff * held.measure @ held.measure.mT
            rhs = rhs - stiff * held.measure @ held.made(guess, middle)
        matrix, rhs = tie.mT @ matrix @ tie, tie.mT @ rhs
        diagonal = matrix.diagonal()
        floor = 1e-9 * diagonal.amax() + 1e-30
        damped = matrix + torch.diag(damping * diagonal + floor)
        step = torch.linalg.solve(damped, rhs)
        if step @ rhs < _LEAST_FALL * cost:  # what the quadratic model promises
            break
        trial = moved(guess, (tie @ step).reshape(-1, _OWN), middle)
        there = residuals(trial, samples, pyramid, levels, scale)
        after = cost_of(there, trial)
        if after < cost:
            guess, here, cost = trial, there, after
            damping = max(damping / 5, 1e-9)
        elif damping > _MOST_DAMPING:
            break
        else:
            damping *= 10
    return guess


def moved(guess: Guess, step: Float[Tensor, "view 9"], middle_world: Float[Tensor, " 3"]) -> Guess:
    """Take a step: motions, growth of focal lengths, gains and offsets."""
    cameras = guess.cameras.replace(
        cam_from_world=move(guess.cameras.cam_from_world, step[:, :6], middle_world),
        intrinsics=scale_focals(guess.cameras.intrinsics, step[:, 6]),
    )
    return Guess(cameras=cameras, gain=guess.gain + step[:, 7], offset=guess.offset + step[:, 8])


def ties(lens: Int[Tensor, " view"], *, poses: bool, focals: bool) -> Float[Tensor, "own free"]:
    """Give the matrix from what is free to every view's own numbers."""
    views = len(lens)
    own = torch.eye(views * _OWN, dtype=torch.float64, device=lens.device)
    place = torch.arange(views * _OWN, device=lens.device) % _OWN
    free = own[:, (place > 6) | ((place < 6) & poses)]
    if not (focals and poses):
        return free
    shared = own.new_zeros(views * _OWN, int(lens.max()) + 1)
    shared[torch.arange(views, device=lens.device) * _OWN + 6, lens] = 1
    return torch.cat([free, shared], dim=1)


def normal_equations(
    guess: Guess,
    samples: Samples,
    here: Residuals,
    scale: Float[Tensor, " view"],
    middle_world: Float[Tensor, " 3"],
) -> tuple[Float[Tensor, "own own"], Float[Tensor, " own"]]:
    """Collect the equations for all views' numbers, albedos eliminated (Schur)."""
    by_motion = _motion_slopes(guess.cameras, samples, middle_world).transpose(0, 1)
    by_camera = (here.slope[:, :, None] @ by_motion)[:, :, 0]
    by_offset = -here.albedo[:, None, None].expand(-1, len(guess.gain), 1)
    slopes = torch.cat([by_camera, by_offset * samples.shading[..., None], by_offset], dim=2)
    J = torch.where(here.usable[..., None], slopes, 0)
    by_albedo = -(guess.gain * samples.shading + guess.offset)
    weight = here.weight / scale.square()
    heavy = weight[..., None] * J
    blocks = heavy.permute(1, 2, 0) @ J.transpose(0, 1)
    cross = (heavy * by_albedo[..., None]).flatten(1)
    own = (weight * by_albedo.square()).sum(dim=1)
    inverse = torch.where(own > 0, 1 / torch.where(own > 0, own, 1), 0)
    matrix = _on_diagonal(blocks) - cross.mT @ (inverse[:, None] * cross)
    on_albedo = (weight * by_albedo * here.value).sum(dim=1)
    rhs = (heavy * here.value[..., None]).sum(dim=0).flatten() - cross.mT @ (inverse * on_albedo)
    return matrix, -rhs


def pixel_motion(before: Cameras, after: Cameras, samples: Samples) -> Float[Tensor, " view"]:
    """Give how far samples move in each view, in the mean over those it sees; pixels."""
    points = samples.points_world[:, 0]
    ours, _ = project(points, before.cam_from_world, before.intrinsics)
    theirs, _ = project(points, after.cam_from_world, after.intrinsics)
    seen = samples.seen.mT
    distance = torch.where(seen, (theirs - ours).norm(dim=-1), 0)
    return distance.sum(dim=1) / seen.sum(dim=1).clamp_min(1)


def untold_motions(
    start: Cameras,
    guess: Guess,
    samples: Samples,
    here: Residuals,
    lens: Int[Tensor, " view"],
    *,
    focals: bool,
    min_rise: float,
) -> Held:
    r"""Find the motions that all cameras share and the photographs do not tell.

    With albedo free, texture may slide over the surface with the cameras: a sphere lets all of
    them turn about it. A direction among the seven of a similarity is told when a pixel of it
    (root mean square over samples and views) raises the mean squared residual by ``min_rise`` of
    the noise's at least, everything else being refitted. As noise counts what is left, and no
    less than 2 % of the radiance: no light is known better.

    Args:
        start: The cameras before.
        guess: The best there are.
        samples: What was explained.
        here: The residuals.
        lens: Of each view.
        focals: Whether focal lengths are free.
        min_rise: Share.
    """
    middle = samples.points_world[:, 0].mean(dim=0)
    noise = here.scale(_LIGHT_ERROR) / CAUCHY_TUNING
    matrix, _ = normal_equations(guess, samples, here, noise, middle)
    tie = ties(lens, poses=True, focals=focals)
    common = torch.zeros(len(lens), _OWN, 7).to(matrix)
    common[:, :6] = common_motions(guess.cameras, middle)
    common = common.flatten(0, 1)
    # Squared pixels make turns and shifts comparable.
    metric = _pixel_metric(guess.cameras, samples, middle)
    length, axes = torch.linalg.eigh(common.mT @ metric @ common)
    able = length > 1e-9 * length.amax()
    basis = common @ (axes[:, able] / length[able].sqrt())  # a pixel each
    inner = tie.mT @ matrix @ tie
    ridge = 1e-9 * inner.diagonal().amax() * torch.eye(len(inner)).to(inner)
    measure = (basis.mT @ metric @ tie).mT
    covariance = measure.mT @ torch.linalg.solve(inner + ridge, measure)
    variance, turn = torch.linalg.eigh((covariance + covariance.mT) / 2)
    rise = 1 / variance.clamp_min(1e-30) / here.usable.sum().clamp_min(1)
    loose = basis @ turn[:, rise < min_rise]
    return Held(start=start, measure=metric @ loose)


def _pixel_metric(
    cameras: Cameras, samples: Samples, middle_world: Float[Tensor, " 3"]
) -> Float[Tensor, "own own"]:
    """Give the quadratic form of the mean squared motion of pixels over samples and views."""
    slopes = _motion_slopes(cameras, samples, middle_world) * samples.seen.mT[..., None, None]
    slopes = slopes.flatten(1, 2)
    blocks = slopes.new_zeros(len(slopes), _OWN, _OWN)
    blocks[:, :MOTION, :MOTION] = slopes.mT @ slopes
    return _on_diagonal(blocks) / samples.seen.sum().clamp_min(1)


def _motion_slopes(
    cameras: Cameras, samples: Samples, middle_world: Float[Tensor, " 3"]
) -> Float[Tensor, "view sample 2 7"]:
    frames = cameras.cam_from_world
    points = transform(frames, samples.points_world[:, 0])
    return pixel_slopes(points, cameras.intrinsics, middles_cam(frames, middle_world))


def _on_diagonal(blocks: Float[Tensor, "view size size"]) -> Float[Tensor, "own own"]:
    """Put blocks on the diagonal of one matrix."""
    views, size = blocks.shape[:2]
    view = torch.arange(views, device=blocks.device)
    whole = blocks.new_zeros(views, size, views, size)
    whole[view, :, view] = blocks
    return whole.reshape(views * size, -1)
