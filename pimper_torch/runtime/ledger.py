"""Guards: every check that removes data, or warns, reports it here.

:attr:`~pimper_torch.records.Reconstruction.left_out` lists the entries of a call of a chain in
order; a guard that acts in several passes has one entry per pass.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from jaxtyping import Bool, Float, Int
from torch import Tensor

from pimper_torch.runtime.errors import some
from pimper_torch.runtime.events import Event, Removal, What
from pimper_torch.runtime.stream import emit

GUARDS: dict[str, tuple[What, str]] = {
    "sfm.static_background": ("features", "on the static background"),
    "sfm.moved_object": ("matches", "on the surroundings, between capture sessions"),
    "sfm.weak_views": ("photographs", "too few points observed"),
    "sfm.misplaced": ("warning", "their strongest image pairs contradict the model"),
    "sfm.small_sessions": ("photographs", "in a capture session with few photographs"),
    "sfm.tracks": ("points", "large reprojection error"),
    "sfm.missing": ("photographs", "not registered"),
    "sfm.diagnosis": ("warning", "point depths are undetermined"),
    "sfm.sound_points": ("points", "not finite"),
    "sfm.sound_views": ("photographs", "no usable pixels or no usable camera"),
    "silhouettes.disagreement": ("warning", "silhouettes contradict each other"),
    "silhouettes.by_session": ("warning", "no silhouettes found in a capture session"),
    "silhouettes.shadows": ("pixels", "dark and outside the visual hull"),
    "silhouettes.read_again": ("pixels", "a network is sure that they are background"),
    "silhouettes.unreliable": ("photographs", "silhouette contradicts the others"),
    "silhouettes.empty": ("photographs", "silhouette is empty"),
    "contours.hull": ("warning", "silhouettes do not intersect"),
    "depth_points.disagreement": ("warning", "depth maps agree only by chance"),
    "depth_points.points": ("points", "visible in too few views"),
    "coarse.reliable": ("points", "few views, large residuals or small angles"),
    "coarse.hull": ("points", "outside the silhouettes"),
    "coarse.cropping": ("pixels", "outside the silhouettes"),
    "coarse.denied": ("points", "contradicted by more views than confirmed"),
    "coarse.matched": ("points", "outside the silhouettes"),
    "coarse.outside": ("faces", "outside the visual hull"),
    "coarse.far": ("faces", "far from points"),
    "coarse.seen_through": ("faces", "views look through them to matched points"),
    "coarse.unseen": ("faces", "not visible in any view"),
    "coarse.fringes": ("faces", "narrow strips"),
    "coarse.components": ("faces", "small connected components"),
    "coarse.crowded": ("facets", "third facet on an edge"),
    "coarse.pieces": ("facets", "small connected components"),
    "triangulate.reliable": ("points", "far from the view, hidden, or unlike their neighbours"),
    "triangulate.pieces": ("facets", "small connected components"),
    "warp": ("pixels", "facing away, hidden, dark or saturated"),
    "photometry.shadows": ("pixels", "in cast shadow of the fitted light"),
    "photometry.robust": ("pixels", "outliers of the fit"),
    "photometry.undetermined": ("facets", "light does not determine normals"),
    "sweep.selection": ("pixels", "not among the best views"),
    "sweep.heights": ("pixels", "no height with a clear minimum"),
    "fuse.outvoted": ("points", "far from the median of patches"),
    "fuse.support": ("points", "not covered by a patch"),
    "fuse.normals": ("points", "no photometric normal"),
    "fuse.albedo": ("points", "no albedo"),
    "repair": ("points", "in folds or spikes"),
    "remesh.data": ("facets", "no data"),
    "extract.support": ("faces", "not supported by a photograph"),
    "extract.expected_error": ("faces", "large expected error"),
    "extract.spikes": ("faces", "long edges, or reversed by a fold"),
    "extract.borders": ("faces", "protruding from a border"),
    "extract.pieces": ("faces", "small connected components"),
}
"""All guards, in the order of the chain: the removed elements, or a warning, and the reason."""

Places = Float[Tensor, "place 3"] | tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]]

# Fraction up to which the closing message is silent; chosen by hand. Pixels are not listed, because
# most facets face away from most views; warnings have their own messages.
_NEGLIGIBLE = 0.05
_SILENT = ("pixels", "warning")


@dataclass(frozen=True, slots=True, kw_only=True)
class RemovedElements(Event):
    """The elements of a removal, for listeners.

    Records kept by an earlier run (:mod:`pimper_torch.store`) repeat only the removal.

    Attributes:
        mask: Removed ones among all elements, if known.
        at: Positions of all elements in the world, if known.
    """

    removal: Removal
    mask: Bool[Tensor, "..."] | None
    at: Places | None

    def places(self) -> Float[Tensor, "place 3"] | None:
        """Return the positions, for faces those of their centres."""
        return self.at[0][self.at[1]].mean(dim=1) if isinstance(self.at, tuple) else self.at


def leave_out(
    guard: str,
    taken: Bool[Tensor, "..."] | int,
    *,
    total: int = 1,
    names: Sequence[str] = (),
    at: Places | None = None,
) -> None:
    """Report the elements that a guard removes; a count of zero is also reported.

    Args:
        guard: One of :data:`GUARDS`.
        taken: Mask of the removed elements; or their number.
        total: Number of all elements, if ``taken`` is a number.
        names: Names of photographs: of all with a mask, otherwise of the removed ones.
        at: World positions of the elements of the mask: points, or vertices and faces.
    """
    mask = taken if isinstance(taken, Tensor) else None
    if mask is not None:
        taken, total = int(mask.count_nonzero()), mask.numel()
        if names:
            names = [name for name, removed in zip(names, mask.tolist(), strict=True) if removed]
    what, reason = GUARDS[guard]
    removal = Removal(
        guard=guard, what=what, count=int(taken), total=total, reason=reason, names=tuple(names)
    )
    emit(removal)
    emit(RemovedElements(removal=removal, mask=mask, at=at))


def sums_of(removals: Iterable[Removal]) -> list[Removal]:
    """Return one entry for each guard, which adds up those of parts, in alphabetic order."""
    sums: dict[str, Removal] = {}
    for entry in removals:
        if (earlier := sums.get(entry.guard)) is not None:
            count, total = earlier.count + entry.count, earlier.total + entry.total
            entry = entry.replace(count=count, total=total, names=earlier.names + entry.names)
        sums[entry.guard] = entry
    return [sums[guard] for guard in sorted(sums)]


def left_out_of(entries: Iterable[Event]) -> tuple[Removal, ...]:
    """Return the entries of guards, in order."""
    return tuple(entry for entry in entries if isinstance(entry, Removal))


def closing_line(left_out: Sequence[Removal]) -> str:
    """Return one line with the removed elements of each guard's last pass; empty if negligible.

    >>> cut = Removal(guard="extract.borders", what="faces", count=6, total=60, reason="narrow")
    >>> closing_line([cut])
    'Excluded: 10% of the faces (extract.borders).'
    """
    last = {entry.guard: entry for entry in left_out if entry.what not in _SILENT}
    parts = [
        f"{some(entry.names) if entry.names else f'{entry.count / entry.total:.0%} of the '}"
        f"{'' if entry.names else entry.what} ({entry.guard})"
        for entry in last.values()
        if entry.names or entry.count > _NEGLIGIBLE * entry.total
    ]
    return f"Excluded: {'; '.join(parts)}." if parts else ""
