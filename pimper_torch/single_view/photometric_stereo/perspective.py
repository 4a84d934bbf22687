r"""Uncalibrated photometric stereo under perspective projection, unique up to scale.

With rays :math:`r = (x, y, 1)` the surface is :math:`z r`, and a vector b along its normal
determines the slopes :math:`(\log z)_x = -b_1 / (b \cdot r)` and
:math:`(\log z)_y = -b_2 / (b \cdot r)`. They are integrable if

.. math:: (b \times b_x)_1 + (b \times b_y)_2 - x (b \times b_x)_3 - y (b \times b_y)_3 = 0.

For factors known up to an invertible matrix, :math:`b = A \hat b`, cross products transform by the
cofactors of A: :math:`b \times b_x = P (\hat b \times \hat b_x)`, P proportional to the inverse
of A's transpose. This is one equation per pixel, linear in the nine entries of P. Without the last
two terms, which grow with the field of view, the last row of P is free: the bas-relief ambiguity.
On some surfaces, including balls and all quadrics, there is a second solution P.

Source: Papadhimitri & Favaro, A new perspective on uncalibrated photometric stereo, CVPR 2013.
"""

import torch
from jaxtyping import Bool, Float
from scipy.linalg import eigh
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d, pad

from pimper_torch.geometry.pixels import homogeneous, pixel_centers
from pimper_torch.records.shapes import Images, Mask, Matrix3, VectorMap, ViewVectors
from pimper_torch.runtime.errors import InputError
from pimper_torch.single_view.factorization.bas_relief import Shading
from pimper_torch.single_view.photometric_stereo.regress_lights import factorize_photographs

# Minimum ratio of the second smallest residual to the smallest, about 1 on a ball; chosen by hand.
_DISTINCT = 1.5


def factorize_in_perspective(
    images: Images,
    mask: Mask,
    intrinsics: Matrix3,
    seen: Bool[Tensor, "view pixel"] | None = None,
    *,
    radius: int = 3,
) -> tuple[Shading, ViewVectors]:
    """Estimate albedo times normal, and lights, from photographs of one viewpoint.

    The sum of the channels is factorized to rank 3; the integrability of the normalized vectors
    determines the matrix between the factors. Derivatives are those of cubics fitted to squares of
    pixels. Their noise biases least squares, so the solution is the generalized eigenvector of the
    equations' moments and those of noise alone.

    Args:
        mask: True on the surface, without depth discontinuities.
        intrinsics: Pinhole K in pixels, centre of the top-left pixel at (0.5, 0.5).
        seen: False for missing values, shadows and highlights, pixels in raster order.
        radius: Radius of the squares, which must be inside the mask.

    Returns:
        Shading and lights in the camera frame, up to one factor; the lights' root mean square is 1.
        Pixels observed in fewer than three views have the vector zero. Constant to autograd.

    The error is proportional to the inverse of the field of view. On a ball, and on some other
    surfaces, the images do not determine the result; this is only detected on noisy images.

    Source: Papadhimitri & Favaro, CVPR 2013, for the idea; the cofactors' form, normalization and
    the noise model are ours.
    """
    last = intrinsics.new_tensor([0.0, 0, 1])
    if not bool((intrinsics[2] == last).all() and intrinsics[0, 0] > 0 and intrinsics[1, 1] > 0):
        raise InputError(
            f"intrinsics are {intrinsics.tolist()}; needed: focal lengths above zero on the "
            "diagonal and (0, 0, 1) in the last row."
        )
    with torch.no_grad():
        radiance = images.double().sum(dim=1)[:, mask]
        weight = torch.ones_like(radiance) if seen is None else seen.double()
        factors = factorize_photographs(radiance, weight, 3, robust=False)
        left, right = factors.lights, factors.shading
        usable = ((weight > 0).sum(dim=0) >= 3) & (right != 0).any(dim=0)
        right = torch.where(usable, right, 0)
        inside = torch.zeros_like(mask)
        inside[mask] = usable
        pixels = homogeneous(pixel_centers(mask.shape[1], mask.shape[0], weight))
        rays = pixels @ torch.linalg.inv(intrinsics.double()).mT
        matrix = _mixing_matrix(right, mask, inside, intrinsics.double(), rays, radius)
        away = ((matrix @ right) * rays[mask].mT).sum()
        matrix = torch.where(away > 0, -matrix, matrix)
        lights = left @ torch.linalg.inv(matrix)
        scale = lights.square().sum(dim=1).mean().sqrt()
        return (scale * (matrix @ right)).to(images), (lights / scale).to(images)


def integrability_equations(
    vectors: Shading, along_x: Shading, along_y: Shading, rays: Shading
) -> Float[Tensor, "pixel 9"]:
    """Return the coefficients of the entries of P in the integrability constraint, row by row.

    Args:
        vectors: Vectors along normals, up to an invertible matrix.
        along_x: Their derivatives by the normalized image coordinate x.
        rays: ``(x, y, 1)``.
    """
    cross_x = torch.linalg.cross(vectors, along_x, dim=0)
    cross_y = torch.linalg.cross(vectors, along_y, dim=0)
    x, y, _ = rays
    return torch.cat([cross_x, cross_y, -x * cross_x - y * cross_y]).mT


def _mixing_matrix(
    right: Shading, mask: Mask, inside: Mask, intrinsics: Matrix3, rays: VectorMap, radius: int
) -> Matrix3:
    """Return the matrix that makes the vectors normals times albedo, up to a factor."""
    moment = right @ right.mT / inside.sum().clamp_min(1)
    values, axes = torch.linalg.eigh(moment)
    if float(values[0]) <= 1e-12 * float(values[-1]):
        raise InputError(
            "the images have rank 2 or less; needed: three lights that are not in one plane, "
            "and a curved surface."
        )
    white = axes.mT / values.sqrt()[:, None]
    vectors = white @ right
    size = vectors.norm(dim=0).clamp_min(1e-30)
    raster = right.new_zeros(3, *mask.shape)
    raster[:, mask] = vectors / size
    side = 2 * radius + 1
    centres = -max_pool2d(-pad(inside.double(), (radius,) * 4)[None], side, stride=1)[0] > 0
    # Nine unknowns up to scale.
    if int(centres.sum()) < 50:
        raise InputError(
            f"{int(centres.sum())} squares of {side} x {side} pixels are inside the mask and "
            "observed in three views; needed: 50. Lower `radius`, or enlarge the mask."
        )
    b, *slopes = _derivatives(raster, radius)[:, :, centres]
    rays, by_ray = rays[centres].mT, intrinsics[:2, :2]  # derivatives of u and v by x and y
    along_x, along_y = torch.einsum("st,scp->tcp", by_ray, torch.stack(slopes))
    rows = integrability_equations(b, along_x, along_y, rays)
    # Covariance of each vector's cross product with noise: the factors' white noise has one after
    # whitening, which normalization divides by the vectors' squared length.
    cross = torch.linalg.cross(torch.eye(3).to(b)[None], b.mT[:, None], dim=-1)
    noise_covariance = cross @ (white @ white.mT) @ cross.mT
    noise_covariance = noise_covariance / size[centres[mask]].square()[:, None, None]
    # Coefficients of the noise of b_u and b_v, for each row of P.
    by_noise = torch.cat(
        [by_ray[:, None].expand(2, len(rows), 2), -(by_ray @ rays[:2])[..., None]], dim=-1
    )
    cofactors, ratio = _cofactors(rows, noise_covariance, by_noise)
    inverse, singular = torch.linalg.inv_ex(cofactors)
    if ratio < _DISTINCT or bool(singular):
        raise InputError(
            f"a second surface explains the images equally well (its misfit is {ratio:.2f} times "
            "the least); needed: a surface unlike a ball or any quadric, or less noise. Raise "
            "`radius`, or factorize without perspective and resolve the bas-relief ambiguity."
        )
    return inverse.mT @ white


def _cofactors(
    rows: Float[Tensor, "pixel 9"],
    noise_covariance: Float[Tensor, "pixel 3 3"],
    by_noise: Float[Tensor, "2 pixel 3"],
) -> tuple[Matrix3, float]:
    """Return the cofactors of least residual over noise, and the ratio of the second to it."""
    weight = torch.ones_like(rows[:, 0])
    for _ in range(4):
        coefficients = torch.einsum("p,spi,spk->pik", weight, by_noise, by_noise)
        noise = torch.einsum("pij,pkl->ikjl", coefficients, noise_covariance).reshape(9, 9)
        noise = noise + 1e-12 * noise.trace() * torch.eye(9).to(noise)
        moment = (weight[:, None] * rows).mT @ rows
        ratios, vectors = eigh(moment.cpu().numpy(), noise.cpu().numpy())
        least = torch.from_numpy(vectors[:, 0].reshape(3, 3)).to(rows)
        rotated = by_noise @ least
        variance = torch.einsum("spi,pij,spj->p", rotated, noise_covariance, rotated)
        weight = 1 / variance.clamp_min(1e-3 * variance.median())
        weight = weight / weight.mean()
    return least, float(ratios[1] / max(ratios[0], 1e-300))


def _derivatives(
    raster: Float[Tensor, "channel height width"], radius: int
) -> Float[Tensor, "derivative channel height width"]:
    """Return value and derivatives by u and v of a cubic fitted to the square around each pixel."""
    side = torch.arange(-radius, radius + 1).to(raster)
    v, u = torch.meshgrid(side, side, indexing="ij")
    # In this order the first three coefficients are the value and the derivatives.
    powers = [(power - j, j) for power in range(4) for j in range(power + 1)]
    basis = torch.stack([u.flatten() ** i * v.flatten() ** j for i, j in powers], dim=1)
    kernels = torch.linalg.pinv(basis)[:3].reshape(3, 1, *u.shape)
    return conv2d(raster[:, None], kernels, padding=radius).movedim(1, 0)
