"""Materials from highlights: photographed radiance above the matte surface near mirror directions.

Directions of the lights are given; their strengths are fitted again for every candidate material,
so a material is compared only by its loss. Every addition to the model (a highlight at all, its
colour, another cluster) must improve photographs that did not select it: the material that suits
one half of them best has to lower the loss of the other half by more than the variation between
photographs. Otherwise the surface stays matte.
"""

import warnings
from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2, vq
from torch import Tensor

from pimper_torch.radiometry import srgb_from_linear
from pimper_torch.records import Materials, ViewLights
from pimper_torch.runtime.parallel import side_by_side
from pimper_torch.stages.relighting.fit_lights import Observed, fit_strengths, loss_scale
from pimper_torch.stages.relighting.lit_surface import LitSurface, diffuse_color, response

_MATTE = (0.0, 1.0, 0.0)
# Initial grid. Highlights of lower roughness cover few pixels; diamond has a specular of 4.
_ROUGHNESS, _SPECULAR = (0.12, 0.2, 0.33, 0.55, 0.9), (0.1, 0.3, 1.0)
_LEAST_ROUGHNESS, _MOST_SPECULAR = 0.08, 4.0
_METALLIC = (0.25, 0.5, 0.75, 1.0)
# Successive factors around the best roughness and specular.
_STEPS = (1.5, 1.22, 1.1, 1.05)

_CLUSTERS = 4

# Metallic, roughness and specular.
_Materials = Float[Tensor, "cluster 3"]
_Candidates = Float[Tensor, "candidate 3"]
_Clusters = Int[Tensor, " vertex"]

# Minimum gain: this fraction of the loss, and this number of standard errors of its mean.
_LEAST_GAIN, _SIGNIFICANT = 2e-3, 1.0


def materials_under(
    surface: LitSurface, observed: Sequence[Observed], lights: ViewLights
) -> Materials:
    """Fit the materials of a surface to its photographs, under lights of given directions."""
    trial = _Trial(surface, observed, lights)
    cluster = torch.zeros(len(surface.base_color), dtype=torch.long)
    values = torch.tensor([_MATTE])
    if len(trial.observed) < 2:
        return Materials.of(cluster, values)
    grid = torch.cartesian_prod(torch.zeros(1), torch.tensor(_ROUGHNESS), torch.tensor(_SPECULAR))
    values = trial.improved(cluster, values, 0, grid)
    if bool((values == torch.tensor(_MATTE)).all()):
        return Materials.of(cluster, values)
    # Metals, whose highlights increasingly have the surface's colour.
    roughness = (values[0, 1] * torch.tensor([0.8, 1.0, 1.25])).clamp(_LEAST_ROUGHNESS, 1)
    metals = torch.cartesian_prod(torch.tensor(_METALLIC), roughness, values[0, 2:])
    shared = values = trial.improved(cluster, values, 0, metals)
    for count in range(2, _CLUSTERS + 1):
        finer = colour_clusters(surface.base_color, count)
        split = shared.repeat(count, 1)
        for index in range(count):
            split = trial.improved(finer, split, index, _around(split[index], 2.0))
        if len({tuple(row) for row in split.tolist()}) < count:
            break
        cluster, values = finer, split
    return Materials.of(cluster, values)


class _Trial:
    """Photographs by which candidate materials are compared."""

    def __init__(
        self, surface: LitSurface, observed: Sequence[Observed], lights: ViewLights
    ) -> None:
        views = [view for view, pixels in enumerate(observed) if len(pixels.radiance)]
        most = min(3000, max(1, 20_000 // max(1, len(views))))
        self.observed = [observed[view].thinned(most) for view in views]
        self.scales = [loss_scale(seen) for seen in self.observed]
        self.incidence = [
            surface.incidence(
                seen.pixels, lights.direction_world[[view]], lights.inverse_distance[[view]]
            )
            for view, seen in zip(views, self.observed, strict=True)
        ]

    def losses(
        self, cluster: _Clusters, candidates: Float[Tensor, "candidate cluster 3"]
    ) -> Float[Tensor, "view candidate"]:
        """Return the loss of every photograph for every candidate."""

        def of_view(view: int) -> Float[Tensor, " candidate"]:
            seen = self.observed[view]
            material = candidates[:, cluster[seen.pixels.vertex]]
            lit = response(seen.pixels, self.incidence[view], material)
            diffuse = diffuse_color(seen.pixels, material)
            return fit_strengths(seen, diffuse, lit, self.scales[view])[2]

        return torch.stack(list(side_by_side(of_view, range(len(self.observed)), tracked=False)))

    def improved(
        self, cluster: _Clusters, values: _Materials, index: int, candidates: _Candidates
    ) -> _Materials:
        """Return materials with a better one for a cluster if the photographs agree on it."""

        def with_rows(rows: _Candidates) -> Float[Tensor, "candidate cluster 3"]:
            changed = values.repeat(len(rows), 1, 1)
            changed[:, index] = rows
            return changed

        tried = with_rows(torch.cat([values[index][None], candidates]))
        losses = self.losses(cluster, tried)
        for step in _STEPS:
            best = tried[losses.mean(dim=0).argmin(), index]
            neighbours = with_rows(_around(best, step))
            tried = torch.cat([tried, neighbours])
            losses = torch.cat([losses, self.losses(cluster, neighbours)], dim=1)
        return tried[losses.mean(dim=0).argmin()] if _agreed(losses) else values


def _agreed(losses: Float[Tensor, "view candidate"]) -> bool:
    """Return whether the best candidate of each half of the views beats the first in the other."""
    halves = losses[0::2].double(), losses[1::2].double()
    gains = torch.cat(
        [test[:, 0] - test[:, fit.mean(dim=0).argmin()] for fit, test in (halves, halves[::-1])]
    )
    gain, before = float(gains.mean()), float(losses[:, 0].mean())
    error = float(gains.std()) / len(gains) ** 0.5
    return gain > _LEAST_GAIN * before and gain > _SIGNIFICANT * error


def _around(value: Float[Tensor, " 3"], step: float) -> _Candidates:
    """Return materials with roughness and specular multiplied and divided by a factor."""
    factors = torch.tensor([1 / step, 1.0, step])
    specular = (value[2] * factors) if value[2] > 0 else factors
    return torch.cartesian_prod(
        value[:1],
        (value[1] * factors).clamp(_LEAST_ROUGHNESS, 1),
        specular.clamp(0, _MOST_SPECULAR),
    )


def colour_clusters(base_color: Float[Tensor, "vertex channel"], count: int) -> _Clusters:
    """Cluster vertices by their sRGB colour; a cluster may be empty."""
    colors = srgb_from_linear(base_color.double())
    sample = colors[:: -(-len(colors) // 4096)]
    order = sample.sum(dim=1).argsort(stable=True)
    start = sample[order[(torch.arange(count) * 2 + 1) * len(order) // (2 * count)]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # raised if colours are fewer than clusters
        centers, _ = kmeans2(sample.numpy(), start.numpy(), minit="matrix")
    return torch.from_numpy(vq(colors.numpy(), centers)[0]).long()
