"""Assignment of masks to views: which photograph each file shows, turned and inverted how.

Points are inside the object if most views that observe them say so. Masks are assigned to views by
the fewest contradicting points, as a linear assignment problem, and oriented in the same way; both
alternate with the points' labels.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from operator import itemgetter

import torch
from jaxtyping import Bool
from scipy.optimize import linear_sum_assignment
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.geometry.mask_polarity import Raster, around_and_inside
from pimper_torch.records.shapes import Scalars
from pimper_torch.stages.silhouettes.mask_evidence import MaskEvidence, Signs

# Rounds of the alternation, those with soft labels, and those without reordering in every second
# start; largest common shift, of the longer side, and views that are compared for it: choices.
_ROUNDS, _SOFT, _IN_ORDER, _SHIFT, _VIEWS = 12, 2, 4, 0.2, 40
# Fractions of contradicting points that decide nothing: a choice.
_EVEN = 5e-4

Form = tuple[int, bool]
"""How a file is stored: the EXIF orientation that turns it upright, and whether it is inverted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """What masks show.

    Attributes:
        masks: Signed distances, by view.
        shown: Views that files show, by the views that they are named after.
        forms: How files are stored, in the same order.
        shift: Columns to the right and rows down by which all are moved, in small pixels.
    """

    masks: Mapping[int, Raster]
    shown: Mapping[int, int]
    forms: Sequence[Form]
    shift: tuple[int, int] = (0, 0)

    @property
    def changes(self) -> float:
        """Fraction of the files that show something else than they should, plus number of forms."""
        moved = sum(file != view for file, view in self.shown.items())
        turned = sum(form != (1, False) for form in self.forms)
        return (moved + turned) / len(self.forms) + len(set(self.forms))


def likeliest(evidence: MaskEvidence) -> tuple[float, Reading]:
    """Return the fraction of points that contradict masks in the likeliest reading, and this."""
    rated = []
    for reading in _readings(evidence):
        share = evidence.of_points(reading.masks)[0]
        # Of readings between which points hardly decide, the one that changes least.
        rated.append((share + _EVEN * reading.changes, share, reading))
        if share < _EVEN:
            break
    return min(rated, key=itemgetter(0))[1:]


def _readings(evidence: MaskEvidence) -> Iterator[Reading]:
    turns = range(1, 9 if all(map(_is_square, evidence.files.values())) else 5)
    yield from (_assigned(evidence, turn, _IN_ORDER) for turn in turns)
    yield _moved_back(evidence)
    yield from (_assigned(evidence, turn, 0) for turn in turns)


def _is_square(mask: Raster) -> bool:
    return mask.shape[0] == mask.shape[1]


def _upright(mask: Raster, form: Form) -> Raster:
    turn, inverted = form
    turned = mask.mT if turn >= 5 else mask
    flipped = ((0, (3, 4, 7, 8)), (1, (2, 3, 6, 7)))
    turned = turned.flip([axis for axis, turns in flipped if turn in turns])
    return -turned if inverted else turned


def _assigned(evidence: MaskEvidence, turn: int, in_order: int) -> Reading:
    """Alternate assignment, orientation and labels of points, from a common orientation.

    Args:
        in_order: Rounds before masks are reordered.
    """
    named, files = list(evidence.files), list(evidence.files.values())
    forms = [(turn, _is_inverted(mask)) for mask in files]
    signs = [_in_all_views(evidence, *each) for each in zip(files, forms, strict=True)]
    seen, shown = evidence.observed, named
    labels = torch.stack([_votes(x, seen) for x in signs]).mean(dim=0)
    for iteration in range(_ROUNDS):
        before = shown, list(forms)
        if iteration >= in_order:
            shown = _reordered(evidence, signs, labels)
        own = torch.stack([x[view] for x, view in zip(signs, shown, strict=True)])
        labels = _votes(own, seen[shown])
        labels = labels if iteration < _SOFT else (labels > 0.5).float()
        for file, (mask, view) in enumerate(zip(files, shown, strict=True)):
            other = _oriented(evidence, mask, view, labels, forms[file])
            if other != forms[file]:
                forms[file], signs[file] = other, _in_all_views(evidence, mask, other)
        if iteration > max(in_order, _SOFT) and before == (shown, forms):
            break
    masks = dict(zip(shown, map(_upright, files, forms), strict=True))
    return Reading(masks=masks, shown=dict(zip(named, shown, strict=True)), forms=forms)


def _votes(signs: Signs, seen: Bool[Tensor, "view point"]) -> Scalars:
    """Return the fraction of the views that see a point whose masks contain it."""
    return 0.5 + 0.5 * (signs * seen).sum(dim=0) / seen.sum(dim=0).clamp_min(1)


def _is_inverted(mask: Raster) -> bool:
    around, inside = around_and_inside([mask])
    return inside < around


def _in_all_views(evidence: MaskEvidence, mask: Raster, form: Form) -> Signs:
    upright = _upright(mask, form)
    return torch.stack([evidence.signs(upright, view) for view in range(len(evidence.names))])


def _costs(evidence: MaskEvidence, signs: Signs, views: slice | int, labels: Scalars) -> Scalars:
    """Return the number of points in each view, by their labels, that contradict signs."""
    lacks = ((signs < 0) & evidence.in_frame[views]).float()
    exceeds = ((signs > 0) & evidence.observed[views]).float()
    return lacks @ labels + exceeds @ (1 - labels)


def _reordered(evidence: MaskEvidence, signs: Sequence[Signs], labels: Scalars) -> list[int]:
    """Return the view that each file shows."""
    named, views = torch.tensor(list(evidence.files)), torch.arange(len(evidence.names))
    cost = torch.stack([_costs(evidence, x, slice(None), labels) for x in signs]).double()
    # The order of files decides between equal costs.
    away = ((views - named[:, None]) / len(views)).square()
    shown = linear_sum_assignment((cost + 1e-3 * cost.mean() * away).numpy())[1]
    return list(map(int, shown))


def _oriented(evidence: MaskEvidence, mask: Raster, view: int, labels: Scalars, form: Form) -> Form:
    """Return the form in which a mask clearly contradicts fewest points of a view."""
    forms = [(turn, form[1]) for turn in range(1, 9 if _is_square(mask) else 5)]
    signs = torch.stack([evidence.signs(_upright(mask, other), view) for other in forms])
    costs = _costs(evidence, signs, view, labels)
    best = int(costs.argmin())
    return forms[best] if costs[best] < 0.9 * costs[forms.index(form)] - 1 else form


def _moved_back(evidence: MaskEvidence) -> Reading:
    """Return the masks moved by the common shift under which they contradict fewest points."""
    compared = list(evidence.files)[:: math.ceil(len(evidence.files) / _VIEWS)]
    reach = round(_SHIFT * max(max(x.shape) for x in evidence.files.values()))

    def moved(view: int, right: int, down: int) -> Raster:
        # What a shift moves into a mask is unknown.
        mask = pad(evidence.files[view], [2 * reach] * 4)
        return mask[2 * reach + down : down - 2 * reach, 2 * reach + right : right - 2 * reach]

    def share(shift: tuple[int, int]) -> float:
        return evidence.of_points({view: moved(view, *shift) for view in compared})[0]

    step = max(reach // 8, 1)
    sides = range(-reach, reach + 1, step)
    shift = min(product(sides, sides), key=share)
    while step > 1:
        step = -(-step // 2)
        around = product((0, -step, step), repeat=2)
        shift = min(((shift[0] + x, shift[1] + y) for x, y in around), key=share)
    return Reading(
        masks={view: moved(view, *shift) for view in evidence.files},
        shown={view: view for view in evidence.files},
        forms=[(1, False)] * len(evidence.files),
        shift=shift,
    )
