"""Mesh decimation by half-edge collapses under a bound on the distance of removed vertices.

It has no twin in torch: which vertices stay is constant to autograd. Tests check the bound against
the nearest points of the surface.
"""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.compile import compiled

Floats = NDArray[np.float32]
Indices = NDArray[np.int32]
Flags = NDArray[np.bool_]

# Choices. Fans with more faces, or more removed vertices, are not changed: bounds of workspace.
_MAX_FACES, _MAX_POINTS = 24, 2048
# A new face has at least this shape (4 sqrt(3) area / squared sides, 1 if equilateral), or that of
# the worst face that it replaces; and this cosine between its normal and the mean of theirs.
_MIN_SHAPE = 0.2
_MIN_COSINE = 0.2
# Neighbours that a vertex is tried to merge with, best new shapes first.
_MAX_CANDIDATES = 3


@compiled("void(int32[:,::1], int32[::1], int32[::1])")
def link_corners(faces: Indices, head: Indices, following: Indices) -> None:
    """Link the corners of every vertex in a list.

    Args:
        faces: Corner ``3 f + s`` is slot ``s`` of face ``f``.
        head: Result: first corner of every vertex; -1 for none.
        following: Result: the next corner of the same vertex, -1 at the end.
    """
    head[:] = -1
    for face in range(len(faces)):
        for slot in range(3):
            vertex = faces[face, slot]
            following[3 * face + slot] = head[vertex]
            head[vertex] = 3 * face + slot


@compiled("void(float32[:,::1], int64, int64, int64, int64, float64[::1])")
def closest(
    points: Floats, first: int, second: int, third: int, query: int, found: NDArray[np.float64]
) -> None:
    """Find the point of a triangle that is nearest to a vertex.

    Args:
        points: Of all vertices.
        first: Corner of the triangle.
        second: Corner.
        third: Corner.
        query: The vertex.
        found: Result: squared distance and three barycentric coordinates.

    Source: Ericson, Real-Time Collision Detection, 2005, 5.1.5.
    """
    ax, ay, az = points[first, 0], points[first, 1], points[first, 2]
    abx, aby, abz = (
        np.float64(points[second, 0]) - ax,
        np.float64(points[second, 1]) - ay,
        np.float64(points[second, 2]) - az,
    )
    acx, acy, acz = (
        np.float64(points[third, 0]) - ax,
        np.float64(points[third, 1]) - ay,
        np.float64(points[third, 2]) - az,
    )
    apx, apy, apz = (
        np.float64(points[query, 0]) - ax,
        np.float64(points[query, 1]) - ay,
        np.float64(points[query, 2]) - az,
    )
    bb = abx * abx + aby * aby + abz * abz
    cc = acx * acx + acy * acy + acz * acz
    bc = abx * acx + aby * acy + abz * acz
    pb = apx * abx + apy * aby + apz * abz
    pc = apx * acx + apy * acy + apz * acz
    determinant = bb * cc - bc * bc
    v = cc * pb - bc * pc
    w = bb * pc - bc * pb
    if v >= 0 and w >= 0 and v + w <= determinant and determinant > 0:
        v, w = v / determinant, w / determinant
    else:
        best = np.inf
        v, w = 0.0, 0.0
        for side in range(3):  # the nearest of the three edges
            if side == 0:
                t = min(max(pb / bb, 0.0), 1.0) if bb > 0 else 0.0
                tv, tw = t, 0.0
            elif side == 1:
                t = min(max(pc / cc, 0.0), 1.0) if cc > 0 else 0.0
                tv, tw = 0.0, t
            else:
                length = bb + cc - 2 * bc
                t = min(max((pc - pb + bb - bc) / length, 0.0), 1.0) if length > 0 else 0.0
                tv, tw = 1 - t, t
            distance = tv * tv * bb + tw * tw * cc + 2 * tv * tw * bc - 2 * tv * pb - 2 * tw * pc
            if distance < best:
                best, v, w = distance, tv, tw
    dx = apx - v * abx - w * acx
    dy = apy - v * aby - w * acy
    dz = apz - v * abz - w * acz
    found[0] = dx * dx + dy * dy + dz * dz
    found[1], found[2], found[3] = 1 - v - w, v, w


@compiled("int64(int64, int32[:,::1], int32[::1], int32[::1], int32[::1], int32[::1])")
def fan(
    vertex: int, faces: Indices, head: Indices, following: Indices, ring: Indices, owner: Indices
) -> int:
    """Sort the faces and neighbours of a vertex around it.

    Args:
        vertex: Removed faces, with -1 in their first slot, are unlinked from its list.
        faces: Of the mesh.
        head: See :func:`link_corners`.
        following: See :func:`link_corners`.
        ring: Result: the neighbours in order.
        owner: Result: the face between each neighbour and the next.

    Returns:
        Their count; 0 where they do not close around the vertex, or are too many.
    """
    count, before, corner = 0, -1, head[vertex]
    while corner >= 0:
        face, after = corner // 3, following[corner]
        if faces[face, 0] < 0:
            if before < 0:
                head[vertex] = after
            else:
                following[before] = after
        else:
            if count == _MAX_FACES:
                return 0
            owner[count] = face
            slot = corner - 3 * face
            ring[count] = faces[face, (slot + 1) % 3]
            ring[_MAX_FACES + count] = faces[face, (slot + 2) % 3]
            count += 1
            before = corner
        corner = after
    for index in range(1, count):  # sort: each begins where the one before ends
        wanted = ring[_MAX_FACES + index - 1]
        if wanted == ring[0]:
            return 0  # two fans meet in the vertex
        other = index
        while other < count and ring[other] != wanted:
            other += 1
        if other == count:
            return 0
        ring[index], ring[other] = ring[other], ring[index]
        owner[index], owner[other] = owner[other], owner[index]
        there = _MAX_FACES + index
        ring[there], ring[there + other - index] = ring[there + other - index], ring[there]
    return count if count >= 3 and ring[_MAX_FACES + count - 1] == ring[0] else 0


@compiled("boolean(int64, int64, int64, int32[:,::1], int32[::1], int32[::1], int32[::1])")
def may_merge(
    vertex: int,
    index: int,
    count: int,
    faces: Indices,
    head: Indices,
    following: Indices,
    ring: Indices,
) -> bool:
    """Tell whether collapsing a vertex on its neighbour keeps the mesh manifold.

    The link condition: the two share only the two neighbours opposite of their edge, and the face
    of these and the neighbour does not exist yet.
    """
    neighbour = ring[index]
    left, right = ring[(index + count - 1) % count], ring[(index + 1) % count]
    corner = head[neighbour]
    while corner >= 0:
        face = corner // 3
        if faces[face, 0] >= 0:
            slot = corner - 3 * face
            one, two = faces[face, (slot + 1) % 3], faces[face, (slot + 2) % 3]
            if one != vertex and two != vertex:
                if (one == left and two == right) or (one == right and two == left):
                    return False
                for other in range(count):
                    third = ring[other]
                    shared = third in (one, two)
                    if shared and other != index and third != left and third != right:
                        return False
        corner = following[corner]
    return True


@compiled("float64(float32[:,::1], int64, int64, int64, float64[::1])")
def shape(
    points: Floats, first: int, second: int, third: int, normal: NDArray[np.float64]
) -> float:
    """Give a triangle's shape, 1 if equilateral, and its normal, twice the area long."""
    ux = np.float64(points[second, 0]) - points[first, 0]
    uy = np.float64(points[second, 1]) - points[first, 1]
    uz = np.float64(points[second, 2]) - points[first, 2]
    vx = np.float64(points[third, 0]) - points[first, 0]
    vy = np.float64(points[third, 1]) - points[first, 1]
    vz = np.float64(points[third, 2]) - points[first, 2]
    normal[0] = uy * vz - uz * vy
    normal[1] = uz * vx - ux * vz
    normal[2] = ux * vy - uy * vx
    twice = (normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2) ** 0.5
    squares = 2 * (ux * ux + uy * uy + uz * uz + vx * vx + vy * vy + vz * vz)
    squares -= 2 * (ux * vx + uy * vy + uz * vz)
    return 3.4641016 * twice / squares if squares > 0 else 0.0


@compiled(
    "int64(float32[:,::1], float32[:,::1], float32[:,::1], float64, float64, int64, int32[:,::1],"
    " int32[::1], int32[::1], int8[::1], int8, boolean[::1], int32[::1], int32[::1],"
    " float32[:,::1])"
)
def decimate(
    points: Floats,
    normals: Floats,
    attributes: Floats,
    bound: float,
    cosine: float,
    iterations: int,
    faces: Indices,
    head: Indices,
    following: Indices,
    part: NDArray[np.int8],
    own_part: int,
    candidates: Flags,
    first_removed: Indices,
    next_removed: Indices,
    deviation: Floats,
) -> int:
    """Collapse vertices on neighbours as long as all removed ones stay near the surface.

    Every removed vertex is on the list of a face. A vertex is collapsed if it and all on the
    lists of its faces are within ``bound`` of the new faces, their normals within the given cosine
    of the interpolated ones, and their attributes within 1 of the interpolated ones. In one
    iteration no face changes twice, so that the mesh is decimated evenly.

    Args:
        points: Of all vertices.
        normals: Unit.
        attributes: Of every vertex, in units of their tolerance.
        bound: Distance.
        cosine: Of the angle between normals.
        iterations: At most.
        faces: Updated: removed faces have -1 in their first slot.
        head: From :func:`link_corners`; updated.
        following: The same.
        part: Vertices of other parts, and their neighbours, stay.
        own_part: The part to decimate.
        candidates: Whether a vertex is to be tried; updated.
        first_removed: First removed vertex on every face's list, or -1; updated.
        next_removed: The next on the same list; updated.
        deviation: Distance and cosine of every removed vertex; updated.

    Returns:
        How many vertices were removed.
    """
    ring = np.empty(2 * _MAX_FACES, np.int32)
    owner = np.empty(_MAX_FACES, np.int32)
    score = np.empty(_MAX_FACES, np.float64)
    removed_points = np.empty(_MAX_POINTS, np.int32)
    new_face = np.empty(_MAX_POINTS, np.int32)
    errors = np.empty((_MAX_POINTS, 2), np.float32)
    normal, mean, found = np.empty(3), np.empty(3), np.empty(4)
    touched = np.full(len(head), -1, np.int8)
    total = 0
    for sweep in range(iterations):
        removed = 0
        for vertex in range(len(head)):
            if not candidates[vertex] or part[vertex] != own_part or touched[vertex] == sweep:
                continue
            candidates[vertex] = False
            count = fan(vertex, faces, head, following, ring, owner)
            if count == 0:
                continue
            inside = True
            for index in range(count):
                inside = inside and part[ring[index]] == own_part
            if not inside:
                continue
            # The vertex itself, and all removed vertices of its faces.
            removed_points[0], size = vertex, 1
            for index in range(count):
                point = first_removed[owner[index]]
                while point >= 0 and size < _MAX_POINTS:
                    removed_points[size] = point
                    size += 1
                    point = next_removed[point]
            if size == _MAX_POINTS:
                continue
            mean[:] = 0
            worst = _MIN_SHAPE
            for index in range(count):
                worst = min(
                    worst,
                    shape(points, vertex, ring[index], ring[(index + 1) % count], normal),
                )
                mean += normal
            mean /= max(np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2), 1e-300)
            for index in range(count):
                worst_new = 2.0
                for step in range(1, count - 1):
                    one, two = ring[(index + step) % count], ring[(index + step + 1) % count]
                    quality = shape(points, ring[index], one, two, normal)
                    along = normal[0] * mean[0] + normal[1] * mean[1] + normal[2] * mean[2]
                    area = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
                    if quality < worst or along <= _MIN_COSINE * area:
                        worst_new = -1.0
                        break
                    worst_new = min(worst_new, quality)
                score[index] = worst_new
            merged = False
            for _ in range(min(_MAX_CANDIDATES, count)):
                index = 0
                for other in range(1, count):
                    if score[other] > score[index]:
                        index = other
                if score[index] <= 0:
                    break
                score[index] = -1.0
                if not may_merge(vertex, index, count, faces, head, following, ring):
                    continue
                neighbour = ring[index]
                accepted = True
                for item in range(size):
                    point = removed_points[item]
                    best, chosen = np.inf, 0
                    b0, b1, b2 = 0.0, 0.0, 0.0
                    for step in range(1, count - 1):
                        one, two = ring[(index + step) % count], ring[(index + step + 1) % count]
                        closest(points, neighbour, one, two, point, found)
                        if found[0] < best:
                            best, chosen = found[0], step
                            b0, b1, b2 = found[1], found[2], found[3]
                    if best > bound * bound:
                        accepted = False
                        break
                    one, two = ring[(index + chosen) % count], ring[(index + chosen + 1) % count]
                    dot, length = 0.0, 0.0
                    for axis in range(3):
                        blend = (
                            b0 * normals[neighbour, axis]
                            + b1 * normals[one, axis]
                            + b2 * normals[two, axis]
                        )
                        dot += blend * normals[point, axis]
                        length += blend * blend
                    if not dot >= cosine * np.sqrt(length):
                        accepted = False
                        break
                    for channel in range(attributes.shape[1]):
                        blend = (
                            b0 * attributes[neighbour, channel]
                            + b1 * attributes[one, channel]
                            + b2 * attributes[two, channel]
                        )
                        if not abs(blend - attributes[point, channel]) <= 1:
                            accepted = False
                            break
                    if not accepted:
                        break
                    new_face[item] = owner[(index + chosen) % count]
                    errors[item, 0] = np.sqrt(best)
                    errors[item, 1] = dot / np.sqrt(length)
                if accepted:
                    merged = True
                    break
            if not merged:
                continue
            for other in range(count):
                face = owner[other]
                first_removed[face] = -1
                if other == index or other == (index + count - 1) % count:
                    faces[face, 0] = -1
                    continue
                slot = 0
                while faces[face, slot] != vertex:
                    slot += 1
                faces[face, slot] = neighbour
                following[3 * face + slot] = head[neighbour]
                head[neighbour] = 3 * face + slot
            head[vertex] = -1
            for item in range(size):
                point, face = removed_points[item], new_face[item]
                next_removed[point] = first_removed[face]
                first_removed[face] = point
                deviation[point, 0], deviation[point, 1] = errors[item, 0], errors[item, 1]
            for other in range(count):
                touched[ring[other]] = sweep
                candidates[ring[other]] = True
            removed += 1
        total += removed
        if removed == 0:
            break
    return total


@compiled("void(int32[::1], int32[::1], int32[::1])")
def read_lists(first: Indices, after: Indices, face: Indices) -> None:
    """Write the face of every removed vertex.

    Args:
        first: First vertex on every face's list, or -1.
        after: The next on the same list.
        face: Result, of every vertex.
    """
    for index in range(len(first)):
        point = first[index]
        while point >= 0:
            face[point] = index
            point = after[point]
