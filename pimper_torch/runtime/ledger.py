"""The ledger of guards: whatever leaves something out, or warns, records it here.

Entries of a call of a chain are in :attr:`~pimper_torch.records.Reconstruction.left_out`, in the
order they were made: a guard that acts in several passes has one of each.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.ground.shapes import Faces, Vertices
from pimper_torch.records.reconstruction import LeftOut, What
from pimper_torch.runtime.errors import some
from pimper_torch.runtime.journal import Journal, current, writing

GUARDS: dict[str, tuple[What, str]] = {
    "sfm.static_background": ("features", "static while others move"),
    "sfm.moved_object": ("matches", "of the surroundings, between capture sessions"),
    "sfm.weak_views": ("photographs", "see too few points"),
    "sfm.misplaced": ("warning", "their strongest pairs contradict the model"),
    "sfm.small_sessions": ("photographs", "of a capture session with few"),
    "sfm.tracks": ("points", "reproject far off"),
    "sfm.missing": ("photographs", "not registered"),
    "sfm.diagnosis": ("warning", "point depths are undetermined"),
    "sfm.sound_points": ("points", "not finite"),
    "sfm.sound_views": ("photographs", "show nothing or stand nowhere"),
    "silhouettes.disagreement": ("warning", "silhouettes agree too little"),
    "silhouettes.by_session": ("warning", "no silhouettes found in a capture session"),
    "silhouettes.shadows": ("pixels", "dark, and the hull denies them"),
    "silhouettes.unreliable": ("photographs", "their silhouette contradicts the others"),
    "silhouettes.empty": ("photographs", "their silhouette is empty"),
    "contours.hull": ("warning", "silhouettes have no place in common"),
    "depth_points.disagreement": ("warning", "depth maps agree by chance"),
    "depth_points.points": ("points", "too few views show them"),
    "coarse.reliable": ("points", "few views, large residuals or small angles"),
    "coarse.hull": ("points", "outside the silhouettes"),
    "coarse.cropping": ("pixels", "outside the silhouettes"),
    "coarse.denied": ("points", "more views deny than confirm them"),
    "coarse.matched": ("points", "outside the silhouettes"),
    "coarse.outside": ("faces", "outside the hull"),
    "coarse.far": ("faces", "far from points"),
    "coarse.seen_through": ("faces", "views look through them"),
    "coarse.unseen": ("faces", "no view sees them"),
    "coarse.fringes": ("faces", "narrow strips"),
    "coarse.components": ("faces", "small components"),
    "coarse.crowded": ("facets", "a third at an edge"),
    "coarse.pieces": ("facets", "small components"),
    "triangulate.reliable": ("points", "far from the view, hidden, or unlike their neighbours"),
    "triangulate.pieces": ("facets", "small components"),
    "warp": ("pixels", "turned away, hidden, dark or saturated"),
    "photometry.shadows": ("pixels", "in shadow of the fitted light"),
    "photometry.robust": ("pixels", "outliers of the fit"),
    "photometry.undetermined": ("facets", "light tells no normals"),
    "sweep.selection": ("pixels", "of more views than are compared"),
    "sweep.heights": ("pixels", "no height agrees best"),
    "fuse.outvoted": ("points", "far from the median of patches"),
    "fuse.support": ("points", "no patch has them"),
    "fuse.normals": ("points", "without a photometric normal"),
    "fuse.albedo": ("points", "without albedo"),
    "repair": ("points", "in folds or spikes"),
    "remesh.data": ("facets", "no data"),
    "extract.support": ("faces", "no photograph supports them"),
    "extract.expected_error": ("faces", "expected to be far off"),
    "extract.spikes": ("faces", "long edges, or turned over by a fold"),
    "extract.borders": ("faces", "stick out of borders"),
    "extract.pieces": ("faces", "small components"),
}
"""All guards, in the order of the chain: what each leaves out or raises, and why."""

Places = Float[Tensor, "place 3"] | tuple[Vertices, Faces]
Listener = Callable[[LeftOut, Tensor | None, Tensor | None], None]
"""Takes an entry, the mask of what was left out, and where in the world each element is."""

# Fraction up to which the closing message is silent: a choice. It says nothing of pixels, as most
# views see most facets from behind, and nothing of doubts, which are warned of.
_NEGLIGIBLE = 0.05
_SILENT = ("pixels", "warning")


def leave_out(
    guard: str,
    taken: Bool[Tensor, "..."] | int,
    *,
    total: int = 1,
    names: Sequence[str] = (),
    at: Places | None = None,
) -> None:
    """Record what a guard leaves out; a count of zero is recorded, too.

    Args:
        guard: One of :data:`GUARDS`.
        taken: True for each element that is left out; or their number.
        total: Number of all elements, where ``taken`` is no mask.
        names: Of photographs: of all with a mask, else of those left out.
        at: Where each element of the mask is, world: points, or vertices and faces.
    """
    journal = current()
    if not journal.collects and journal.masks is None:
        return
    mask = taken if isinstance(taken, Tensor) else None
    if mask is not None:
        taken, total = int(mask.count_nonzero()), mask.numel()
        if names:
            names = [name for name, gone in zip(names, mask.tolist(), strict=True) if gone]
    what, reason = GUARDS[guard]
    entry = LeftOut(
        guard=guard, what=what, count=int(taken), total=total, reason=reason, names=tuple(names)
    )
    if journal.collects:
        journal.note(entry)
    if journal.masks is not None:
        journal.masks(entry, mask, at[0][at[1]].mean(dim=1) if isinstance(at, tuple) else at)


def listening(listener: Listener) -> AbstractContextManager[Journal]:
    """Hand every entry of the ``with`` block, with masks and places, to a listener, in threads too.

    What an earlier run kept (:mod:`pimper_torch.runtime.store`) has no masks any more: it is not
    heard.
    """
    return writing(replace(current(), masks=listener))


@contextmanager
def added_up() -> Iterator[None]:
    """Add up what each guard enters inside the ``with`` block, as threads work on parts."""
    events = current().so_far()
    before = len(events)
    yield
    sums: dict[tuple[str, str, str], LeftOut] = {}
    for entry in left_out_of(events[before:]):
        key = entry.guard, entry.what, entry.reason
        if key in sums:
            count, total = sums[key].count + entry.count, sums[key].total + entry.total
            entry = entry.replace(count=count, total=total, names=sums[key].names + entry.names)
        sums[key] = entry
    others = [entry for entry in events[before:] if not isinstance(entry, LeftOut)]
    events[before:] = [*others, *(sums[key] for key in sorted(sums))]  # not as threads came


def left_out_of(entries: Sequence[object]) -> tuple[LeftOut, ...]:
    """List the entries of guards, in order."""
    return tuple(entry for entry in entries if isinstance(entry, LeftOut))


def closing_line(left_out: Sequence[LeftOut]) -> str:
    """State in a line what guards left out, each in its last pass; empty where hardly anything.

    >>> cut = LeftOut(guard="extract.borders", what="faces", count=6, total=60, reason="narrow")
    >>> closing_line([cut])
    'Left out: 10% of the faces (extract.borders).'
    """
    last = {entry.guard: entry for entry in left_out if entry.what not in _SILENT}
    parts = [
        f"{some(entry.names) if entry.names else f'{entry.count / entry.total:.0%} of the '}"
        f"{'' if entry.names else entry.what} ({entry.guard})"
        for entry in last.values()
        if entry.names or entry.count > _NEGLIGIBLE * entry.total
    ]
    return f"Left out: {'; '.join(parts)}." if parts else ""
