"""Memory of a run, and the return of free memory to the system."""

import ctypes
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar, TypeVarTuple

from torch.utils import _pytree as pytree
from torch.utils.checkpoint import checkpoint

from pimper_torch.ground.geometry.surfaces import face_normals
from pimper_torch.ground.geometry.visibility import forget_casters
from pimper_torch.records import PatchSet
from pimper_torch.runtime.errors import ReconstructionError
from pimper_torch.runtime.mapped import drop_pages

Given = TypeVarTuple("Given")
Result = TypeVar("Result")

# Bytes that the fusion's last round takes for each vertex, on top of what the process holds when
# the first round begins: 0.8 kB in the demo and for a jar of 0.7 million vertices, 1.2 for one of
# 3.0 million (benchmarks/speed.py).
_BYTES_PER_VERTEX = 1200

# Bytes for each vertex where it goes by blocks, for the coarser mesh that is solved whole; what is
# kept of all vertices meanwhile; and bytes for each vertex of a block: 740, 285 and 1,370 for a jar
# of 1.06 million in 8 blocks.
_BYTES_BY_BLOCKS, _BYTES_KEPT, _BYTES_OF_BLOCK = 750, 300, 1400

# Vertices of the surface for each square of their spacing: 1.6 in the demo. Equilateral triangles
# have 1.15, but an edge is cut as the finer of its facets asks for.
_PER_SQUARE = 1.6


def largest_problem(limit: float, patches: PatchSet, scale: float, last: float) -> float:
    """Return how many vertices the fusion may solve for at once; infinite where all fit.

    Blocks take a half, a quarter or a smaller such part of the limit, so that their number does not
    depend on a few bytes that are held.

    Args:
        limit: Bytes that the process may hold.
        scale: Of the photographs in this round.
        last: Of the photographs in the last one.

    Raises:
        ReconstructionError: The last round would take more memory than it may, by blocks too.
    """
    mesh, spacing = patches.coarse.mesh, float(patches.buckets[0].spacing[0].detach())
    area = float(face_normals(mesh.vertices_world.detach(), mesh.faces).norm(dim=1).sum()) / 2
    vertices = _PER_SQUARE * area / (spacing * scale / last) ** 2
    held = resident_bytes()
    if held + _BYTES_PER_VERTEX * vertices <= limit:
        return math.inf
    room = limit - held - _BYTES_KEPT * vertices
    parts = [limit / 2**power for power in range(1, 7)]
    part = next((part for part in parts if part <= room), None)
    needed = held + _BYTES_BY_BLOCKS * vertices
    if part is None or needed > limit:
        fraction = max(limit - held, 0.0) / (_BYTES_BY_BLOCKS * vertices)
        advice = (
            f"Shrink the photographs (`--max-size-px`) or take fewer samples "
            f"(`decompose.samples_per_pixel`) by a factor of {fraction**0.5:.2f} a side."
            if fraction > 0
            else "The photographs alone take that: shrink them (`--max-size-px`)."
        )
        raise ReconstructionError(
            f"max_memory is {limit / 1e9:.1f} GB, but the surface will have about "
            f"{vertices / 1e6:.1f} million vertices, and its fusion by blocks takes about "
            f"{needed / 1e9:.1f} GB in all, {held / 1e9:.1f} of which are held now. {advice}"
        )
    return part / _BYTES_OF_BLOCK


def resident_bytes() -> float:
    """Return what the process holds now, 0 where the system does not tell.

    Pages of files do not count, as the system drops them where memory is needed.
    """
    with suppress(OSError, IndexError, ValueError):
        fields = Path("/proc/self/status").read_text(encoding="ascii")
        kinds = ("RssAnon:", "RssShmem:")
        return 1024.0 * sum(float(fields.split(kind)[1].split()[0]) for kind in kinds)
    return 0.0


def release_memory() -> None:
    """Return memory that was freed to the system, where glibc can.

    With 30 photographs of 1600x1200 the threads that write them leave 400 MB, COLMAP's as much
    again, and patches before the fusion some 200, which would add to what comes after.
    """
    drop_pages()
    forget_casters()
    with suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def recomputed(work: Callable[[*Given], Result], *given: *Given) -> Result:
    """Call a function whose intermediate results, most of autograd's memory, are computed again.

    Args:
        work: Fast, and without side effects.
    """
    if not any(getattr(leaf, "requires_grad", False) for leaf in pytree.tree_leaves(given)):
        return work(*given)  # the first checkpoint of a process imports a compiler, for seconds
    return checkpoint(work, *given, use_reentrant=False, preserve_rng_state=False)
