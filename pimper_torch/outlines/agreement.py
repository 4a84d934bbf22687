"""How far outlines can be trusted: what every view cut against what all have in common."""

from dataclasses import dataclass

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.outlines.rounds import Cuts
from pimper_torch.records import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Agreement(Record):
    """Each view's cut against the hull's silhouette.

    A cut inside the silhouette contradicts nothing: the others may not see what it takes away,
    as at the end of an arc. A cut outside contradicts them, as where its camera is misplaced.

    Attributes:
        overlap: Intersection over union.
        covered: Share of the cut that is inside the silhouette.
        extent: Share of the picture that the cut takes.
    """

    overlap: Float[Tensor, " view"]
    covered: Float[Tensor, " view"]
    extent: Float[Tensor, " view"]

    def trusted(self, least_covered: float) -> Bool[Tensor, " view"]:
        """Mark views whose cut shows something, little of it outside the silhouette."""
        return (self.covered >= least_covered) & (self.extent > 0)


def agreement_of(cuts: Cuts) -> Agreement:
    """Compare the cuts with the silhouettes."""
    silhouettes = cuts.margins_px > 0
    both = (cuts.masks & silhouettes).sum(dim=(1, 2)).double()
    either = (cuts.masks | silhouettes).sum(dim=(1, 2))
    own = cuts.masks.sum(dim=(1, 2))
    return Agreement(
        overlap=both / either.clamp_min(1),
        covered=both / own.clamp_min(1),
        extent=own.double() / cuts.masks[0].numel(),
    )
