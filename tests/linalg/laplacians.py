"""Sparse matrices like those of the fusion."""

import numpy as np
from scipy.sparse import coo_array, csr_array


def triangles(side: int, decades: float, seed: int = 0) -> csr_array:
    """Return a Laplacian of a triangle mesh with weights over decades, holes and anchors."""
    generator = np.random.default_rng(seed)
    name = np.arange(side * side).reshape(side, side)
    pairs = (name[:, :-1], name[:, 1:]), (name[:-1], name[1:]), (name[:-1, :-1], name[1:, 1:])
    one, other = np.concatenate([[a.ravel(), b.ravel()] for a, b in pairs], axis=1)
    weight = 10 ** (decades * generator.random(len(one)))
    weight[generator.random(len(one)) < 0.2] = 0
    anchor = 1e-4 + 10.0 * (generator.random(side * side) < 0.02)
    each = np.arange(side * side)
    rows = np.concatenate([one, other, one, other, each])
    cols = np.concatenate([other, one, one, other, each])
    values = np.concatenate([-weight, -weight, weight, weight, anchor])
    return coo_array((values, (rows.astype(np.int32), cols.astype(np.int32)))).tocsr()
