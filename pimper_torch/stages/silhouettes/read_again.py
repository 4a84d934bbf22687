"""Cuts read again by a network that sees all cues, the cuts and their hull."""

import torch
from torch import nn

from pimper_torch.geometry.opencv import opening, without_specks
from pimper_torch.records.shapes import Map, Mask, Scalar
from pimper_torch.runtime.ledger import leave_out
from pimper_torch.runtime.mapped import by_view
from pimper_torch.stages.silhouettes.cues import Cues
from pimper_torch.stages.silhouettes.cuts import SPECK, Cuts, cuts_of, hull_margins
from pimper_torch.stages.silhouettes.evidence import Evidence
from pimper_torch.stages.silhouettes.network import read

# The network contradicts a cut where its log odds are beyond the first in regions wider than the
# second, of the longer side: outlines are finer than its pixels. docs/decisions.md, "Evidence that
# is learned".
_SURE, _WIDE = 1.5, 1 / 80
# Fraction of the median cut that changed, above which the new cuts are read, too; and readings.
_CHANGED, _READINGS = 0.03, 3


def read_again(cues: Cues, cuts: Cuts, network: nn.Module) -> Cuts:
    """Change cuts where the network is sure of the contrary, and vote on the hull again.

    Args:
        network: Maps the maps of one view, see :data:`.MAPS`, to log odds of the object.

    Returns:
        The last cuts that have something in common.
    """
    before, cues = cuts, cues.replace(agreement=cuts.agreement)
    hidden = torch.zeros_like(cuts.masks) if cuts.hidden is None else cuts.hidden
    for _ in range(_READINGS):
        odds = read(Evidence.of(cues, cuts), network)
        masks = by_view(overruled, cuts.masks, odds) | hidden
        margins_px = hull_margins(cues, masks.float().masked_fill_(hidden, 0.5))
        if margins_px is None:
            break
        masks = by_view(
            lambda mask, margin: without_specks(mask, margin > 0, round(SPECK * mask.numel())),
            masks,
            margins_px,
        )
        areas = cuts.masks.sum(dim=(1, 2)).clamp_min(1)
        again = bool(((masks ^ cuts.masks).sum(dim=(1, 2)) / areas).median() > _CHANGED)
        cues = cues.relearned(masks) if again else cues
        expected = by_view(expected_overlap, masks, odds)
        cuts = cuts_of(cues, masks, margins_px, cuts.rejected)
        cuts = cuts.replace(hidden=before.hidden, expected=expected)
        if not again:
            break
    leave_out("silhouettes.read_again", before.masks & ~cuts.masks)
    return cuts


def expected_overlap(mask: Mask, odds: Map) -> Scalar:
    """Return the expected intersection over union of a mask with the truth."""
    inside = torch.sigmoid(odds).double()
    return inside[mask].sum() / (mask.sum() + inside[~mask].sum()).clamp_min(1)


def overruled(mask: Mask, odds: Map) -> Mask:
    """Return a cut, changed in wide regions where the odds are clearly against it."""
    wrong = torch.where(mask, -odds, odds) > _SURE
    return mask ^ opening(wrong, round(_WIDE / 2 * max(mask.shape)))
