"""Gamma from the factorization's residual, of matrices with known gamma."""

from functools import partial

import torch
from declared import Figures, Place, Row, Study, Table, figure, listed
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.radiometry import Gamma, Linear, Srgb
from pimper_torch.single_view.factorization.estimate_gamma import estimate_gamma

CURVES = {
    "linear": Linear(),
    "2.2": Gamma(exponent=2.2),
    "sRGB": Srgb(),
}


def radiance(ambient: float, generator: torch.Generator) -> Float[Tensor, "16 400"]:
    """Shade half a sphere under 16 distant point lights, shadows included."""
    normals = normalize(torch.randn(400, 3, generator=generator, dtype=torch.float64), dim=1)
    normals[:, 2] = -normals[:, 2].abs()
    aside = 0.6 * torch.randn(16, 2, generator=generator, dtype=torch.float64)
    point_lights = normalize(
        torch.cat([aside, -torch.ones(16, 1, dtype=torch.float64)], dim=1), dim=1
    )
    albedo = 0.3 + 0.7 * torch.rand(400, generator=generator, dtype=torch.float64)
    gain = 0.6 + 0.2 * torch.rand(16, 1, generator=generator, dtype=torch.float64)
    return gain * albedo * ((point_lights @ normals.T).clamp_min(0) + ambient)


def measure(place: Place, curve: str, ambient: float) -> Figures:
    """Estimate the gamma of matrices with 1 % of noise in their encoded values."""
    torch.set_num_threads(1)
    found = []
    for seed in range(1 if place.tiny else 3):
        generator = torch.Generator().manual_seed(seed)
        clean = CURVES[curve].encoded_from_linear(radiance(ambient, generator))
        drawn = torch.randn(clean.shape, generator=generator, dtype=clean.dtype)
        values = (clean + 0.01 * drawn).clamp(0, 1)
        found.append(estimate_gamma(values, values >= 0, rank=4 if ambient else 3))
    gammas = torch.tensor([one.gamma for one in found])
    errors = torch.tensor([one.standard_error for one in found])
    return {
        "gamma": float(gammas.mean()),
        "spread": float(gammas.std(correction=0)),
        "standard error": float(errors.mean()),
    }


STUDY = Study(
    name="gamma",
    rows={
        (curve, f"{ambient:g}"): Row(measure=partial(measure, curve=curve, ambient=ambient))
        for ambient in (0.0, 0.2)
        for curve in CURVES
    },
    tables=[
        Table(
            name="gamma",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["curve", "ambient"],
                [figure(name, name, 3) for name in ("gamma", "spread", "standard error")],
            ),
        )
    ],
)
