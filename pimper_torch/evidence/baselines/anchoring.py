r"""Resolution of the bas-relief ambiguity of an integrated height field by sparse points.

Shading tells depth only up to :math:`z' = \lambda z + \mu x + \nu y + c` (a constant that
integration leaves free, and the generalised bas-relief transformation that uncalibrated light
does). Points from structure from motion have known depths, and so determine all four.

Source: Belhumeur, Kriegman & Yuille, The bas-relief ambiguity, IJCV 35(1), 1999.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import normalize

from pimper_torch.errors import ReconstructionError
from pimper_torch.evidence.baselines.template import Template
from pimper_torch.geometry.frames import transform
from pimper_torch.geometry.height_fields import sample_raster
from pimper_torch.geometry.surfaces import side_lengths
from pimper_torch.photometry.robust import CAUCHY_TUNING, cauchy_weights, robust_deviation
from pimper_torch.records import CoarseMesh

# A point of the cloud further than this from the coarse mesh along z, in the mesh's median
# edges, belongs to something else or is wrong. A chord leaves a sphere of radius r by an eighth
# of its length squared over r: edges may be as long as 2 r.
BESIDE = 0.25

# Least squares re-weighted this often; the weights have settled long before.
ITERATIONS = 20

# A direction that the points do not tell (all relief on one plane) is left as it is: the
# ridge is this fraction of the normal equations of points of unit variance.
RIDGE = 1e-4


def points_on(
    template: Template, points_world: Float[Tensor, "point 3"], coarse: CoarseMesh
) -> Float[Tensor, "kept 3"]:
    """Select the points of the cloud that lie on the coarse mesh, in the template's frame.

    Raises:
        ReconstructionError: Fewer than four.
    """
    placed = transform(template.template_from_world, points_world)
    depth = look_up(template, template.depth, placed)
    covered = look_up(template, template.inside.to(placed), placed) > 0.999
    corners = coarse.mesh.vertices_world[coarse.mesh.faces]
    edge = side_lengths(corners).median()
    height, width = template.depth.shape
    cell = (placed[:, :2] - template.origin) / template.spacing
    framed = ((cell >= 0) & (cell <= cell.new_tensor([width - 1, height - 1]))).all(dim=1)
    kept = placed[framed & covered & ((placed[:, 2] - depth).abs() < BESIDE * edge)]
    if len(kept) < 4:
        raise ReconstructionError(
            f"{len(kept)} of {len(points_world)} sparse points lie on the coarse mesh where the "
            "reference view sees it; at least 4 are needed to fix the relief's scale, tilt and "
            "distance. Bring a coarse mesh made of these points, or photograph more texture."
        )
    return kept


def look_up(
    template: Template, values: Float[Tensor, "height width"], points: Float[Tensor, "point 3"]
) -> Float[Tensor, " point"]:
    """Sample a raster at points in the template's frame."""
    found = sample_raster(
        values[None, None], points[None, :, :2], template.origin[None], template.spacing[None]
    )
    return found[0, 0]


def bas_relief_through(
    points: Float[Tensor, "point 3"],
    relief: Float[Tensor, " point"],
    reliable: Bool[Tensor, " point"] | None = None,
) -> Float[Tensor, " 4"]:
    r"""Find ``(mu, nu, lambda, c)`` that fits a height field to points.

    Minimises Cauchy's loss of :math:`\mu x + \nu y + \lambda z + c - z_{point}` in float64. A
    direction that the points leave open keeps ``(0, 0, 1, 0)``.

    Args:
        points: x, y and true z.
        relief: z of the relief at the same x and y, in about the same units.
        reliable: Where the relief means something; ``None`` is everywhere.
    """
    x, y, wanted = points.double().unbind(dim=1)
    z = relief.double()
    known = torch.ones_like(z) if reliable is None else reliable.double()
    columns = torch.stack([x, y, z], dim=1)
    center = (known[:, None] * columns).sum(dim=0) / known.sum().clamp_min(1)
    size = (known[:, None] * (columns - center)).norm(dim=0) / known.sum().clamp_min(1).sqrt()
    size = torch.where(size > 0, size, 1)
    design = torch.cat([(columns - center) / size, torch.ones_like(z)[:, None]], dim=1)
    target = wanted - z  # so that the ridge is a prior on the identity
    ridge = torch.diag(design.new_tensor([RIDGE, RIDGE, RIDGE, 0])) * known.sum()
    ridge[3, 3] = 1e-12
    found = design.new_zeros(4)
    for step in range(ITERATIONS):
        residual = target - design @ found
        scale = CAUCHY_TUNING * robust_deviation(residual, known > 0)
        weight = known if step == 0 else known * cauchy_weights(residual, scale)
        normal = (weight[:, None] * design).mT @ design + ridge
        found = torch.linalg.solve(normal, design.mT @ (weight * target))
    slopes = found[:3] / size
    constant = found[3] - slopes @ center
    return torch.cat([slopes + slopes.new_tensor([0, 0, 1]), constant[None]]).to(points)


def apply_bas_relief(
    bas_relief: Float[Tensor, " 4"], template: Template, relief: Float[Tensor, "height width"]
) -> Float[Tensor, "height width"]:
    """Return ``mu x + nu y + lambda z + c`` on the whole raster."""
    return template.points(relief) @ bas_relief[:3] + bas_relief[3]


def rotation_normals(
    bas_relief: Float[Tensor, " 4"], normals: Float[Tensor, "sample 3"]
) -> Float[Tensor, "sample 3"]:
    """Transform viewer-facing normals as :func:`apply_bas_relief` does heights."""
    mu, nu, scale, _ = bas_relief.unbind()
    x, y, z = normals.unbind(dim=1)
    # Slopes -n_x/n_z become scale times as steep, plus mu.
    return normalize(torch.stack([scale * x - mu * z, scale * y - nu * z, z], dim=1), dim=1)
