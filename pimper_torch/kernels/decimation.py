"""Mesh decimation by half-edge collapses under a bound on the distance of removed vertices.

Not differentiable, so without a twin in torch. Tests check the bound against nearest points.
"""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

Floats = NDArray[np.float32]
Indices = NDArray[np.int32]
Numbers = NDArray[np.int64]
Flags = NDArray[np.bool_]
Vector = tuple[float, float, float]

# Choices. Size of the workspace: fans with more faces, or more removed vertices, are not changed.
_MAX_FACES, _MAX_POINTS = 24, 2048
# Minimum shape of a new face (4 sqrt(3) area / squared sides, 1 if equilateral), unless a replaced
# face has a worse one; and minimum cosine of its normal and the mean normal of the replaced faces.
_MIN_SHAPE = 0.2
_MIN_COSINE = 0.2
# Neighbours on which the collapse of a vertex is tried, best new shapes first.
_MAX_CANDIDATES = 3
# Passes over the vertices: few vertices are removed after the first ten.
_ITERATIONS = 30


@compiled("void(int32[:,::1], int32[::1])")
def link_corners(faces: Indices, links: Indices) -> None:
    """Link the corners of every vertex in a list.

    Args:
        faces: Corner ``3 f + s`` is slot ``s`` of face ``f``.
        links: Result: the first corner of every vertex, then the next corner of the same vertex for
            every corner; -1 ends a list.
    """
    vertices = len(links) - faces.size
    links[:vertices] = -1
    for face in range(len(faces)):
        for slot in range(3):
            vertex = faces[face, slot]
            links[vertices + 3 * face + slot] = links[vertex]
            links[vertex] = 3 * face + slot


@compiled()
def _edge(points: Floats, start: int, end: int) -> Vector:
    return (
        np.float64(points[end, 0]) - points[start, 0],
        np.float64(points[end, 1]) - points[start, 1],
        np.float64(points[end, 2]) - points[start, 2],
    )


@compiled()
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled()
def _closest(
    points: Floats, first: int, second: int, third: int, query: int
) -> tuple[float, Vector]:
    """Compute the point of a triangle nearest to a vertex.

    Returns:
        Its squared distance and barycentric coordinates.

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.5.
    """
    ab, ac = _edge(points, first, second), _edge(points, first, third)
    ap = _edge(points, first, query)
    bb, cc, bc = _dot(ab, ab), _dot(ac, ac), _dot(ab, ac)
    pb, pc = _dot(ap, ab), _dot(ap, ac)
    determinant = bb * cc - bc * bc
    v = cc * pb - bc * pc
    w = bb * pc - bc * pb
    if v >= 0 and w >= 0 and v + w <= determinant and determinant > 0:
        v, w = v / determinant, w / determinant
    else:
        length = bb + cc - 2 * bc
        along_ab = min(max(pb / bb, 0.0), 1.0) if bb > 0 else 0.0
        along_ac = min(max(pc / cc, 0.0), 1.0) if cc > 0 else 0.0
        along_bc = min(max((pc - pb + bb - bc) / length, 0.0), 1.0) if length > 0 else 0.0
        best = np.inf
        for tv, tw in ((along_ab, 0.0), (0.0, along_ac), (1 - along_bc, along_bc)):
            square = tv * tv * bb + tw * tw * cc + 2 * tv * tw * bc - 2 * tv * pb - 2 * tw * pc
            if square < best:
                best, v, w = square, tv, tw
    dx = ap[0] - v * ab[0] - w * ac[0]
    dy = ap[1] - v * ab[1] - w * ac[1]
    dz = ap[2] - v * ab[2] - w * ac[2]
    return dx * dx + dy * dy + dz * dz, (1 - v - w, v, w)


@compiled()
def _fan(vertex: int, faces: Indices, links: Indices, ring: Numbers, owner: Numbers) -> int:
    """Sort the faces and neighbours of a vertex around it.

    Args:
        vertex: Removed faces, with -1 in their first slot, are unlinked from its list.
        ring: Result: the neighbours in order.
        owner: Result: the face between each neighbour and the next.

    Returns:
        Their number; 0 if they do not form a closed fan around the vertex, or are too many.
    """
    vertices = len(links) - faces.size
    count, previous, corner = 0, vertex, links[vertex]
    while corner >= 0:
        face, slot = corner // 3, corner % 3
        if faces[face, 0] < 0:
            links[previous] = links[vertices + corner]
        else:
            if count == _MAX_FACES:
                return 0
            owner[count] = face
            ring[count] = faces[face, (slot + 1) % 3]
            ring[_MAX_FACES + count] = faces[face, (slot + 2) % 3]
            count += 1
            previous = vertices + corner
        corner = links[vertices + corner]
    for index in range(1, count):  # sort: each begins at the end of the previous one
        start = ring[_MAX_FACES + index - 1]
        if start == ring[0]:
            return 0  # two fans meet at the vertex
        other = index
        while other < count and ring[other] != start:
            other += 1
        if other == count:
            return 0
        ring[index], ring[other] = ring[other], ring[index]
        owner[index], owner[other] = owner[other], owner[index]
        end_index = _MAX_FACES + index
        ring[end_index], ring[end_index + other - index] = (
            ring[end_index + other - index],
            ring[end_index],
        )
    return count if count >= 3 and ring[_MAX_FACES + count - 1] == ring[0] else 0


@compiled()
def _may_merge(vertex: int, index: int, faces: Indices, links: Indices, ring: Numbers) -> bool:
    """Return whether the mesh stays manifold when a vertex is collapsed on its neighbour.

    The link condition: both share only the two neighbours opposite to their edge, and there is no
    face of these two and the neighbour.
    """
    count = len(ring)
    left, right = ring[(index + count - 1) % count], ring[(index + 1) % count]
    corner = links[ring[index]]
    while corner >= 0:
        face, slot = corner // 3, corner % 3
        if faces[face, 0] >= 0:
            start, end = faces[face, (slot + 1) % 3], faces[face, (slot + 2) % 3]
            if start != vertex and end != vertex:
                if (start == left and end == right) or (start == right and end == left):
                    return False
                for other in range(count):
                    third = ring[other]
                    shared = third in (start, end)
                    if shared and other != index and third != left and third != right:
                        return False
        corner = links[len(links) - faces.size + corner]
    return True


@compiled()
def _shape(points: Floats, first: int, second: int, third: int) -> tuple[float, float, Vector]:
    """Return a triangle's shape (1 if equilateral), twice its area, and a normal of that length."""
    u, v = _edge(points, first, second), _edge(points, first, third)
    normal = (u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0])
    twice = np.sqrt(_dot(normal, normal))
    squares = 2 * (_dot(u, u) + v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) - 2 * _dot(u, v)
    return (3.4641016 * twice / squares if squares > 0 else 0.0), twice, normal


@compiled()
def _score(points: Floats, vertex: int, ring: Numbers, score: NDArray[np.float64]) -> None:
    """Compute the worst shape of a new face for every neighbour that a vertex may be collapsed on.

    Args:
        score: Result for every neighbour; -1 if a new face is too thin or folded.
    """
    count, least = len(ring), _MIN_SHAPE
    x, y, z = 0.0, 0.0, 0.0
    for index in range(count):
        shape, _, normal = _shape(points, vertex, ring[index], ring[(index + 1) % count])
        least = min(least, shape)
        x, y, z = x + normal[0], y + normal[1], z + normal[2]
    length = max(np.sqrt(x * x + y * y + z * z), 1e-300)
    mean = (x / length, y / length, z / length)
    for index in range(count):
        score[index] = 2.0
        for step in range(1, count - 1):
            start, end = ring[(index + step) % count], ring[(index + step + 1) % count]
            shape, area, normal = _shape(points, ring[index], start, end)
            if shape < least or _dot(normal, mean) <= _MIN_COSINE * area:
                score[index] = -1.0
                break
            score[index] = min(score[index], shape)


@compiled()
def _collect(vertex: int, owner: Numbers, lists: Indices, faces: int, points: Numbers) -> int:
    """Write a vertex and all removed vertices of its faces to ``points``; return their number."""
    points[0], size = vertex, 1
    for face in owner:
        point = lists[face]
        while point >= 0 and size < len(points):
            points[size] = point
            size += 1
            point = lists[faces + point]
    return size


@compiled()
def _blend(values: Floats, corners: tuple[int, int, int], weights: Vector, channel: int) -> float:
    return (
        weights[0] * values[corners[0], channel]
        + weights[1] * values[corners[1], channel]
        + weights[2] * values[corners[2], channel]
    )


@compiled()
def _project(
    points: Floats,
    values: Floats,
    bound: float,
    cosine: float,
    ring: Numbers,
    index: int,
    removed: Numbers,
    step_of: Numbers,
    errors: Floats,
) -> bool:
    """Find the nearest new face of each removed vertex; return False if one is out of bounds.

    Args:
        points: See :func:`decimate`, also for the next three arguments.
        index: The neighbour that the vertex is collapsed on.
        step_of: Result: the new face of each, counted around the neighbour from 1.
        errors: Result: distance and cosine of each.
    """
    count = len(ring)
    for item in range(len(removed)):
        point = removed[item]
        best, chosen, weights = np.inf, 0, (0.0, 0.0, 0.0)
        for step in range(1, count - 1):
            start, end = ring[(index + step) % count], ring[(index + step + 1) % count]
            square, coordinates = _closest(points, ring[index], start, end, point)
            if square < best:
                best, chosen, weights = square, step, coordinates
        if best > bound * bound:
            return False
        corners = ring[index], ring[(index + chosen) % count], ring[(index + chosen + 1) % count]
        dot, length = 0.0, 0.0
        for axis in range(3):
            blend = _blend(values, corners, weights, axis)
            dot += blend * values[point, axis]
            length += blend * blend
        if not dot >= cosine * np.sqrt(length):
            return False
        for channel in range(3, values.shape[1]):
            if not abs(_blend(values, corners, weights, channel) - values[point, channel]) <= 1:
                return False
        step_of[item] = chosen
        errors[item, 0], errors[item, 1] = np.sqrt(best), dot / np.sqrt(length)
    return True


@compiled()
def _collapse(
    vertex: int, index: int, faces: Indices, links: Indices, ring: Numbers, owner: Numbers
) -> None:
    """Replace a vertex by its neighbour in all its faces, and remove the two faces of the edge."""
    for other in range(len(owner)):
        face = owner[other]
        if other == index or other == (index + len(ring) - 1) % len(ring):
            faces[face, 0] = -1
            continue
        slot = 0
        while faces[face, slot] != vertex:
            slot += 1
        faces[face, slot] = ring[index]
        links[len(links) - faces.size + 3 * face + slot] = links[ring[index]]
        links[ring[index]] = 3 * face + slot
    links[vertex] = -1


@compiled(
    "void(float32[:,::1], float32[:,::1], float64, float64, boolean[::1], boolean[::1],"
    " int32[:,::1], int32[::1], int32[::1], float32[:,::1])"
)
def decimate(
    points: Floats,
    values: Floats,
    bound: float,
    cosine: float,
    free: Flags,
    candidates: Flags,
    faces: Indices,
    links: Indices,
    lists: Indices,
    deviation: Floats,
) -> None:
    """Collapse vertices on neighbours while all removed vertices stay near the surface.

    Every removed vertex is on the list of a face. A vertex is collapsed if it and all vertices on
    the lists of its faces are within ``bound`` of the new faces, their normals within the given
    cosine of the interpolated ones, and their attributes within 1 of the interpolated ones. In one
    iteration no face changes twice, so that the mesh is decimated evenly.

    Args:
        values: Unit normals, then attributes in units of their tolerance.
        free: Vertices that may be removed.
        candidates: Vertices to try; updated.
        faces: Updated: removed faces have -1 in their first slot.
        links: From :func:`link_corners`; updated.
        lists: Each face's first removed vertex, then the next one after each; -1 at ends; updated.
        deviation: Distance and cosine of every removed vertex; updated.
    """
    rings, owners = np.empty(2 * _MAX_FACES, np.int64), np.empty(_MAX_FACES, np.int64)
    scores = np.empty(_MAX_FACES, np.float64)
    collected, steps = np.empty(_MAX_POINTS, np.int64), np.empty(_MAX_POINTS, np.int64)
    errors = np.empty((_MAX_POINTS, 2), np.float32)
    touched = np.full(len(points), -1, np.int8)
    for sweep in range(_ITERATIONS):
        done = True
        for vertex in range(len(points)):
            if not (free[vertex] and candidates[vertex]) or touched[vertex] == sweep:
                continue
            candidates[vertex] = False
            count = _fan(vertex, faces, links, rings, owners)
            ring, owner, score = rings[:count], owners[:count], scores[:count]
            size = _collect(vertex, owner, lists, len(faces), collected)
            if count == 0 or size == _MAX_POINTS:
                continue
            removed = collected[:size]
            _score(points, vertex, ring, score)
            for _ in range(min(_MAX_CANDIDATES, count)):
                index = 0
                for other in range(1, count):
                    if score[other] > score[index]:
                        index = other
                if score[index] <= 0:
                    break
                score[index] = -1.0
                if not _may_merge(vertex, index, faces, links, ring):
                    continue
                if not _project(points, values, bound, cosine, ring, index, removed, steps, errors):
                    continue
                _collapse(vertex, index, faces, links, ring, owner)
                for other in range(count):
                    lists[owner[other]] = -1
                    touched[ring[other]], candidates[ring[other]] = sweep, True
                for item in range(size):
                    point, face = removed[item], owner[(index + steps[item]) % count]
                    lists[len(faces) + point], lists[face] = lists[face], point
                    deviation[point, 0], deviation[point, 1] = errors[item, 0], errors[item, 1]
                done = False
                break
        if done:
            break
