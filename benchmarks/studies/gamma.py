"""Gamma from the factorization's residual, of matrices with known gamma.

python benchmarks/studies/gamma.py [--curves linear sRGB] [--seeds 4]
"""

import argparse
import time

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.radiometry import Gamma, Linear, Srgb
from pimper_torch.single_view.factorization.estimate_gamma import estimate_gamma

CURVES = {
    "linear": Linear(),
    "1.8": Gamma(exponent=1.8),
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


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--curves", nargs="+", choices=CURVES, default=list(CURVES))
    parser.add_argument("--noise", type=float, nargs="+", default=[0.0, 0.005, 0.01])
    parser.add_argument("--seeds", type=int, default=4)
    options = parser.parse_args()
    torch.set_num_threads(1)
    print("| curve | ambient | rank | noise, % | gamma | spread | standard error | CPU s |")  # noqa: T201
    print("|---|--:|--:|--:|--:|--:|--:|--:|")  # noqa: T201
    for ambient, rank in ((0.0, 3), (0.2, 4)):
        for name in options.curves:
            curve = CURVES[name]
            for noise in options.noise:
                began, found = time.process_time(), []
                for seed in range(options.seeds):
                    generator = torch.Generator().manual_seed(seed)
                    clean = curve.encoded_from_linear(radiance(ambient, generator))
                    drawn = torch.randn(clean.shape, generator=generator, dtype=clean.dtype)
                    values = (clean + noise * drawn).clamp(0, 1)
                    found.append(estimate_gamma(values, values >= 0, rank=rank))
                seconds = (time.process_time() - began) / options.seeds
                gammas = torch.tensor([one.gamma for one in found])
                errors = torch.tensor([one.standard_error for one in found])
                print(  # noqa: T201
                    f"| {name} | {ambient} | {rank} | {100 * noise} | {gammas.mean():.3f} "
                    f"| {gammas.std():.3f} | {errors.mean():.3f} | {seconds:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
