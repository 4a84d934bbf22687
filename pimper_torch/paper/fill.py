"""More vertices between sparse points, on a thin-plate spline through them.

A weakly textured region has few sparse points, so its facets would be large and flat where
the object is round, and views would be registered many pixels off.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import Delaunay, cKDTree
from torch import Tensor

# Points that each value of the spline is computed from: one of all points costs the cube of
# their number. A choice; beyond about 50 nearest ones the value hardly changes.
_NEIGHBOURS = 50


def fill_pixels(
    pixels: Float[Tensor, "point 2"], faces: Int[Tensor, "face 3"], edge_px: float
) -> Float[Tensor, "filled 2"]:
    """Propose pixels of a triangular grid, inside facets and away from their vertices."""
    known = pixels.detach().cpu().double().numpy()
    low, high = known.min(axis=0), known.max(axis=0)
    rows = np.arange(low[1], high[1], edge_px * math.sqrt(3) / 2)
    columns = np.arange(low[0], high[0], edge_px)
    grid = np.concatenate(
        [
            np.stack([columns + (index % 2) * edge_px / 2, np.full_like(columns, v)], axis=1)
            for index, v in enumerate(rows)
        ]
        or [np.zeros((0, 2))]
    )
    distance, _ = cKDTree(known).query(grid)
    proposed = torch.from_numpy(grid[distance > 0.8 * edge_px]).to(pixels)
    return proposed[_inside_any(proposed, pixels, faces)]


def interpolate_inverse_depth(
    pixels: Float[Tensor, "point 2"],
    inverse_depth: Float[Tensor, " point"],
    wanted: Float[Tensor, "filled 2"],
    smoothing: float,
) -> Float[Tensor, " filled"]:
    """Evaluate a smoothing thin-plate spline of inverse depth.

    Inverse depth, because a plane's is an affine function of the pixel and so is reproduced
    exactly. ``smoothing`` is relative to the spread of the values.
    """
    if len(wanted) == 0:
        return wanted.new_zeros(0)
    # Local, as it takes long to load and other chains do without.
    from scipy.interpolate import RBFInterpolator

    known = pixels.detach().cpu().double().numpy()
    values = inverse_depth.detach().cpu().double().numpy()
    center, unit = known.mean(axis=0), known.std() + 1e-12
    spline = RBFInterpolator(
        (known - center) / unit,
        values,
        neighbors=min(_NEIGHBOURS, len(known)),
        smoothing=smoothing,
        kernel="thin_plate_spline",
    )
    at = (wanted.detach().cpu().double().numpy() - center) / unit
    return torch.from_numpy(spline(at)).to(inverse_depth)


def delaunay(pixels: Float[Tensor, "point 2"]) -> Int[Tensor, "face 3"]:
    """Triangulate points of an image, so that faces show their front to its camera.

    v points down and z into the scene, so that a triangle which runs clockwise on the
    screen runs counter-clockwise round the normal that points at the camera.
    """
    simplices = Delaunay(pixels.detach().cpu().double().numpy()).simplices
    faces = torch.from_numpy(simplices.astype(np.int64)).to(pixels.device)
    a, b, c = pixels[faces].unbind(dim=1)
    ab, ac = b - a, c - a
    rotated = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0] > 0
    return torch.where(rotated[:, None], faces.flip(1), faces)


def _inside_any(
    points: Float[Tensor, "filled 2"],
    pixels: Float[Tensor, "point 2"],
    faces: Int[Tensor, "face 3"],
) -> Tensor:
    kept = {tuple(sorted(face)) for face in faces.tolist()}
    found = Delaunay(pixels.detach().cpu().double().numpy())
    simplex = found.find_simplex(points.detach().cpu().double().numpy())
    allowed = np.array([tuple(sorted(face)) in kept for face in found.simplices.tolist()] + [False])
    return torch.from_numpy(allowed[simplex]).to(points.device)
