"""Vertices of a mesh taken out one by one, as long as all of them stay near what is left.

It has no twin in torch: which vertices stay is a choice, constant to autograd, and what it must
keep to is checked against the nearest points of the surface.
"""

import numpy as np
from numpy.typing import NDArray

from pimper_torch.kernels.switch import compiled

Floats = NDArray[np.float32]
Numbers = NDArray[np.int32]
Flags = NDArray[np.bool_]

# Fans of more faces, and more removed vertices on one fan, are left as they are.
_MAX_FACES, _MAX_POINTS = 24, 2048
# A new face may be as long and narrow as this (4 sqrt(3) area / squared sides, 1 if equilateral),
# or as the worst of those that it replaces.
_MIN_SHAPE = 0.2
# Cosine between a new face's normal and the mean of those that it replaces.
_MIN_COSINE = 0.2
_RIVALS = 3  # neighbours that a vertex is tried to merge with, those that give the best faces


@compiled("void(int32[:,::1], int32[::1], int32[::1])")
def link_corners(faces: Numbers, head: Numbers, following: Numbers) -> None:
    """Chain the corners of every vertex.

    Args:
        faces: Corners are counted through its rows.
        head: First corner of every vertex; -1 for none, written here.
        following: The next corner of the same vertex, -1 at the end; written here.
    """
    head[:] = -1
    for face in range(len(faces)):
        for slot in range(3):
            vertex = faces[face, slot]
            following[3 * face + slot] = head[vertex]
            head[vertex] = 3 * face + slot


@compiled("void(float32[:,::1], int64, int64, int64, int64, float64[::1])")
def closest(
    points: Floats, first: int, second: int, third: int, asked: int, found: NDArray[np.float64]
) -> None:
    """Find the point of a triangle that is nearest to another.

    Args:
        points: Of all vertices.
        first: Corner of the triangle.
        second: Corner.
        third: Corner.
        asked: The vertex that is not in the triangle.
        found: Squared distance and three barycentric coordinates, written here.

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
        np.float64(points[asked, 0]) - ax,
        np.float64(points[asked, 1]) - ay,
        np.float64(points[asked, 2]) - az,
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
    vertex: int, faces: Numbers, head: Numbers, following: Numbers, ring: Numbers, owner: Numbers
) -> int:
    """Walk round a vertex.

    Args:
        vertex: Where faces are taken out, the first corner of which is -1, they leave the chain.
        faces: Of the mesh.
        head: Of the chains of corners.
        following: Of the chains of corners.
        ring: The neighbours in order, written here.
        owner: The face between each of them and the next, written here.

    Returns:
        Their number; 0 where they do not close round the vertex, or are too many.
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
    for place in range(1, count):  # sort: each begins where the one before ends
        wanted = ring[_MAX_FACES + place - 1]
        if wanted == ring[0]:
            return 0  # two fans meet in the vertex
        other = place
        while other < count and ring[other] != wanted:
            other += 1
        if other == count:
            return 0
        ring[place], ring[other] = ring[other], ring[place]
        owner[place], owner[other] = owner[other], owner[place]
        there = _MAX_FACES + place
        ring[there], ring[there + other - place] = ring[there + other - place], ring[there]
    return count if count >= 3 and ring[_MAX_FACES + count - 1] == ring[0] else 0


@compiled("boolean(int64, int64, int64, int32[:,::1], int32[::1], int32[::1], int32[::1])")
def may_merge(
    vertex: int,
    place: int,
    count: int,
    faces: Numbers,
    head: Numbers,
    following: Numbers,
    ring: Numbers,
) -> bool:
    """Tell whether a vertex can become its neighbour without two sheets sharing an edge.

    The two have no neighbours in common but the two between which their edge runs, and the face
    that these span with the neighbour is not there yet.
    """
    neighbour = ring[place]
    left, right = ring[(place + count - 1) % count], ring[(place + 1) % count]
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
                    if shared and other != place and third != left and third != right:
                        return False
        corner = following[corner]
    return True


@compiled("float64(float32[:,::1], int64, int64, int64, float64[::1])")
def shape(
    points: Floats, first: int, second: int, third: int, normal: NDArray[np.float64]
) -> float:
    """Give a triangle's shape, 1 if equilateral, and its normal of twice its area."""
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
    told: Floats,
    bound: float,
    cosine: float,
    iterations: int,
    faces: Numbers,
    head: Numbers,
    following: Numbers,
    part: NDArray[np.int8],
    mine: int,
    fresh: Flags,
    first_removed: Numbers,
    next_removed: Numbers,
    deviation: Floats,
) -> int:
    """Merge vertices with neighbours as long as all removed ones stay near the surface.

    Every removed vertex is on the list of a face. A vertex merges with a neighbour if it and
    all on the lists of its faces are within ``bound`` of the faces that come in their place,
    with normals, blended from the corners, within the given cosine of their own, and with all
    else that is told, blended, within 1 of their own. In one round no face changes twice, so that
    the mesh thins out evenly.

    Args:
        points: Of all vertices.
        normals: Unit.
        told: Of every vertex, in units of what it may be off.
        bound: Distance.
        cosine: Of the angle between normals.
        iterations: At most.
        faces: Written in place: faces taken out have -1 in their first corner.
        head: Chains of corners, from :func:`link_corners`; written in place.
        following: The same.
        part: Vertices of other parts, and their neighbours, stay as they are.
        mine: The part to thin out.
        fresh: Whether a vertex is worth trying; written in place.
        first_removed: First removed vertex on every face's list, or -1; written in place.
        next_removed: The next on the same list; written in place.
        deviation: Distance and cosine of every removed vertex; written in place.

    Returns:
        How many vertices were removed.
    """
    ring = np.empty(2 * _MAX_FACES, np.int32)
    owner = np.empty(_MAX_FACES, np.int32)
    score = np.empty(_MAX_FACES, np.float64)
    listed = np.empty(_MAX_POINTS, np.int32)
    placed = np.empty(_MAX_POINTS, np.int32)
    off = np.empty((_MAX_POINTS, 2), np.float32)
    normal, mean, found = np.empty(3), np.empty(3), np.empty(4)
    touched = np.full(len(head), -1, np.int8)
    total = 0
    for sweep in range(iterations):
        removed = 0
        for vertex in range(len(head)):
            if not fresh[vertex] or part[vertex] != mine or touched[vertex] == sweep:
                continue
            fresh[vertex] = False
            count = fan(vertex, faces, head, following, ring, owner)
            if count == 0:
                continue
            inside = True
            for place in range(count):
                inside = inside and part[ring[place]] == mine
            if not inside:
                continue
            # Everything on the lists of the faces round it, and the vertex itself first.
            listed[0], size = vertex, 1
            for place in range(count):
                point = first_removed[owner[place]]
                while point >= 0 and size < _MAX_POINTS:
                    listed[size] = point
                    size += 1
                    point = next_removed[point]
            if size == _MAX_POINTS:
                continue
            mean[:] = 0
            worst = _MIN_SHAPE
            for place in range(count):
                worst = min(
                    worst,
                    shape(points, vertex, ring[place], ring[(place + 1) % count], normal),
                )
                mean += normal
            mean /= max(np.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2), 1e-300)
            for place in range(count):
                least = 2.0
                for step in range(1, count - 1):
                    one, two = ring[(place + step) % count], ring[(place + step + 1) % count]
                    good = shape(points, ring[place], one, two, normal)
                    along = normal[0] * mean[0] + normal[1] * mean[1] + normal[2] * mean[2]
                    size_of = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
                    if good < worst or along <= _MIN_COSINE * size_of:
                        least = -1.0
                        break
                    least = min(least, good)
                score[place] = least
            merged = False
            for _ in range(min(_RIVALS, count)):
                place = 0
                for other in range(1, count):
                    if score[other] > score[place]:
                        place = other
                if score[place] <= 0:
                    break
                score[place] = -1.0
                if not may_merge(vertex, place, count, faces, head, following, ring):
                    continue
                neighbour = ring[place]
                fits = True
                for item in range(size):
                    point = listed[item]
                    best, chosen = np.inf, 0
                    b0, b1, b2 = 0.0, 0.0, 0.0
                    for step in range(1, count - 1):
                        one, two = ring[(place + step) % count], ring[(place + step + 1) % count]
                        closest(points, neighbour, one, two, point, found)
                        if found[0] < best:
                            best, chosen = found[0], step
                            b0, b1, b2 = found[1], found[2], found[3]
                    if best > bound * bound:
                        fits = False
                        break
                    one, two = ring[(place + chosen) % count], ring[(place + chosen + 1) % count]
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
                        fits = False
                        break
                    for channel in range(told.shape[1]):
                        blend = (
                            b0 * told[neighbour, channel]
                            + b1 * told[one, channel]
                            + b2 * told[two, channel]
                        )
                        if not abs(blend - told[point, channel]) <= 1:
                            fits = False
                            break
                    if not fits:
                        break
                    placed[item] = owner[(place + chosen) % count]
                    off[item, 0] = np.sqrt(best)
                    off[item, 1] = dot / np.sqrt(length)
                if fits:
                    merged = True
                    break
            if not merged:
                continue
            for other in range(count):
                face = owner[other]
                first_removed[face] = -1
                if other == place or other == (place + count - 1) % count:
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
                point, face = listed[item], placed[item]
                next_removed[point] = first_removed[face]
                first_removed[face] = point
                deviation[point, 0], deviation[point, 1] = off[item, 0], off[item, 1]
            for other in range(count):
                touched[ring[other]] = sweep
                fresh[ring[other]] = True
            removed += 1
        total += removed
        if removed == 0:
            break
    return total


@compiled("void(int32[::1], int32[::1], int32[::1])")
def read_lists(first: Numbers, after: Numbers, face: Numbers) -> None:
    """Write for every vertex on the list of a face which one it is.

    Args:
        first: First vertex on every face's list, or -1.
        after: The next on the same list.
        face: Of every vertex, written here.
    """
    for place in range(len(first)):
        point = first[place]
        while point >= 0:
            face[point] = place
            point = after[point]
