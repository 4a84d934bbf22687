"""Materials from highlights: what photographs show above the matte surface near the mirror.

Where each light is, is known; how strong it is, is fitted anew for every material that is tried, so
that a material is judged by its loss alone. Whatever adds to the model (a highlight at all, its
colour, another cluster) must help photographs that it was not chosen by: the material that suits
one half of them best has to lower the loss of the other half, beyond what varies between
photographs. The surface stays matte otherwise.
"""

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2, vq
from torch import Tensor

from pimper_torch.ground.radiometry import srgb_from_linear
from pimper_torch.records import Materials, ViewLights
from pimper_torch.result.relighting.fit_lights import Observed, fit_strengths, loss_scale
from pimper_torch.result.relighting.lit_surface import LitSurface, diffuse_color, response
from pimper_torch.runtime.parallel import side_by_side

_MATTE = (0.0, 1.0, 0.0)
# Tried first. Highlights of less roughness have few pixels; diamond has a specular of 4.
_ROUGHNESS, _SPECULAR = (0.12, 0.2, 0.33, 0.55, 0.9), (0.1, 0.3, 1.0)
_LEAST_ROUGHNESS, _MOST_SPECULAR = 0.08, 4.0
_METALLIC = (0.25, 0.5, 0.75, 1.0)
# Factors from the best roughness and specular to those tried next.
_STEPS = (1.5, 1.22, 1.1, 1.05)

_CLUSTERS = 4

# Metallic, roughness and specular.
_Materials = Float[Tensor, "cluster 3"]
_Candidates = Float[Tensor, "candidate 3"]
_Clusters = Int[Tensor, " vertex"]

# A gain counts from this fraction of the loss, and this number of standard errors of its mean.
_LEAST_GAIN, _SIGNIFICANT = 2e-3, 1.0


def materials_under(
    surface: LitSurface, observed: Sequence[Observed], lights: ViewLights
) -> Materials:
    """Fit the materials of a surface to its photographs, under lights whose places are known."""
    trial = _Trial(surface, observed, lights)
    cluster = torch.zeros(len(surface.base_color), dtype=torch.long)
    values = torch.tensor([_MATTE])
    if len(trial.observed) < 2:
        return Materials.of(cluster, values)
    grid = torch.cartesian_prod(torch.zeros(1), torch.tensor(_ROUGHNESS), torch.tensor(_SPECULAR))
    values = trial.improved(cluster, values, 0, grid)
    if bool((values == torch.tensor(_MATTE)).all()):
        return Materials.of(cluster, values)
    # Metals, whose highlight has more and more the surface's colour.
    roughness = (values[0, 1] * torch.tensor([0.8, 1.0, 1.25])).clamp(_LEAST_ROUGHNESS, 1)
    metals = torch.cartesian_prod(torch.tensor(_METALLIC), roughness, values[0, 2:])
    shared = values = trial.improved(cluster, values, 0, metals)
    for count in range(2, _CLUSTERS + 1):
        finer = clusters(surface.base_color, count)
        split = shared.repeat(count, 1)
        for one in range(count):
            split = trial.improved(finer, split, one, _around(split[one], 2.0))
        if len({tuple(row) for row in split.tolist()}) < count:
            break
        cluster, values = finer, split
    return Materials.of(cluster, values)


class _Trial:
    """Photographs that materials are judged by."""

    def __init__(
        self, surface: LitSurface, observed: Sequence[Observed], lights: ViewLights
    ) -> None:
        shown = [view for view, seen in enumerate(observed) if len(seen.radiance)]
        most = min(3000, max(1, 20_000 // max(1, len(shown))))
        self.observed = [observed[view].thinned(most) for view in shown]
        self.scales = [loss_scale(seen) for seen in self.observed]
        self.incidence = [
            surface.incidence(
                seen.pixels, lights.direction_world[[view]], lights.inverse_distance[[view]]
            )
            for view, seen in zip(shown, self.observed, strict=True)
        ]

    def losses(
        self, cluster: _Clusters, tried: Float[Tensor, "candidate cluster 3"]
    ) -> Float[Tensor, "view candidate"]:
        """Return the loss of every photograph under materials."""

        def of_view(view: int) -> Float[Tensor, " candidate"]:
            seen = self.observed[view]
            material = tried[:, cluster[seen.pixels.vertex]]
            lit = response(seen.pixels, self.incidence[view], material)
            diffuse = diffuse_color(seen.pixels, material)
            return fit_strengths(seen, diffuse, lit, self.scales[view])[2]

        return torch.stack(list(side_by_side(of_view, range(len(self.observed)), tracked=False)))

    def improved(
        self, cluster: _Clusters, values: _Materials, one: int, tried: _Candidates
    ) -> _Materials:
        """Return materials with a better one for one cluster, if the photographs agree on it."""

        def with_one(rows: _Candidates) -> Float[Tensor, "candidate cluster 3"]:
            changed = values.repeat(len(rows), 1, 1)
            changed[:, one] = rows
            return changed

        candidates = with_one(torch.cat([values[one][None], tried]))
        losses = self.losses(cluster, candidates)
        for step in _STEPS:
            best = candidates[losses.mean(dim=0).argmin(), one]
            beside = with_one(_around(best, step))
            candidates = torch.cat([candidates, beside])
            losses = torch.cat([losses, self.losses(cluster, beside)], dim=1)
        return candidates[losses.mean(dim=0).argmin()] if _agreed(losses) else values


def _agreed(losses: Float[Tensor, "view candidate"]) -> bool:
    """Return whether the best candidate of each half of the views beats the first in the other."""
    halves = losses[0::2].double(), losses[1::2].double()
    gains = torch.cat(
        [other[:, 0] - other[:, one.mean(dim=0).argmin()] for one, other in (halves, halves[::-1])]
    )
    gain, before = float(gains.mean()), float(losses[:, 0].mean())
    error = float(gains.std()) / len(gains) ** 0.5
    return gain > _LEAST_GAIN * before and gain > _SIGNIFICANT * error


def _around(value: Float[Tensor, " 3"], step: float) -> _Candidates:
    """Return materials of more and less roughness and specular, by a factor."""
    factors = torch.tensor([1 / step, 1.0, step])
    specular = (value[2] * factors) if value[2] > 0 else factors
    return torch.cartesian_prod(
        value[:1],
        (value[1] * factors).clamp(_LEAST_ROUGHNESS, 1),
        specular.clamp(0, _MOST_SPECULAR),
    )


def clusters(base_color: Float[Tensor, "vertex channel"], count: int) -> _Clusters:
    """Divide vertices by their colour as sRGB shows it; a cluster may have none."""
    colors = srgb_from_linear(base_color.double())
    sample = colors[:: -(-len(colors) // 4096)]
    order = sample.sum(dim=1).argsort(stable=True)
    start = sample[order[(torch.arange(count) * 2 + 1) * len(order) // (2 * count)]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # where colours are fewer than clusters
        centers, _ = kmeans2(sample.numpy(), start.numpy(), minit="matrix")
    return torch.from_numpy(vq(colors.numpy(), centers)[0]).long()
