"""Memory of the fusion, predicted from the templates of the first pass."""

import math

from pimper_torch.geometry.surfaces import face_normals
from pimper_torch.records import PatchSet
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.memory import resident_bytes

# Bytes per vertex of the fusion in the last pass, in addition to the memory of the process at the
# start of the first pass: 0.8 kB in the demo and for a jar of 0.7 million vertices, 1.2 kB for one
# of 3.0 million (benchmarks/studies/speed.py).
_BYTES_PER_VERTEX = 1200

# Bytes of the fusion by blocks: per vertex for the coarser mesh, which is solved in one piece; per
# vertex for data kept meanwhile; and per vertex of a block. Measured: 740, 285 and 1,370 for a jar
# of 1.06 million vertices in 8 blocks.
_BYTES_BY_BLOCKS, _BYTES_KEPT, _BYTES_OF_BLOCK = 750, 300, 1400

# Vertices of the surface per square of their spacing: 1.6 in the demo. Equilateral triangles have
# 1.15, but an edge is divided as its finer facet requires.
_PER_SQUARE = 1.6


def largest_problem(limit: float, patches: PatchSet, scale: float, last: float) -> float:
    """Return the maximum number of vertices that the fusion solves for at once.

    It is infinite if all vertices fit. The memory for blocks is a half, a quarter or a smaller
    power of two of the limit, so their number does not depend on small changes of used memory.

    Args:
        limit: Maximum bytes of the process.
        scale: Scale of the photographs in this pass.
        last: Scale of the photographs in the last pass.

    Raises:
        ReconstructionError: The last pass would exceed the limit even by blocks.
    """
    mesh, spacing = patches.coarse.mesh, float(patches.buckets[0].spacing[0].detach())
    area = float(face_normals(mesh.vertices_world.detach(), mesh.faces).norm(dim=1).sum()) / 2
    vertices = _PER_SQUARE * area / (spacing * scale / last) ** 2
    used = resident_bytes()
    if used + _BYTES_PER_VERTEX * vertices <= limit:
        return math.inf
    free = limit - used - _BYTES_KEPT * vertices
    sizes = (limit / 2**power for power in range(1, 7))
    block = next((size for size in sizes if size <= free), 0.0)
    needed = used + _BYTES_BY_BLOCKS * vertices
    if not block or needed > limit:
        fraction = max(limit - used, 0.0) / (_BYTES_BY_BLOCKS * vertices)
        advice = (
            f"Shrink the photographs (`--max-size-px`) or use fewer samples "
            f"(`decompose.samples_per_pixel`), by a factor of {fraction**0.5:.2f} per side."
            if fraction > 0
            else "The photographs alone need that much: shrink them (`--max-size-px`)."
        )
        raise ReconstructionError(
            f"max_memory is {limit / 1e9:.1f} GB, but the surface will have about "
            f"{vertices / 1e6:.1f} million vertices, and its fusion by blocks needs about "
            f"{needed / 1e9:.1f} GB in total, {used / 1e9:.1f} of which are in use now. {advice}"
        )
    return block / _BYTES_OF_BLOCK
