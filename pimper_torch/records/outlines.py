"""Where every view shows the object."""

from dataclasses import dataclass
from typing import Literal

from jaxtyping import Bool, Float
from torch import Tensor

from pimper_torch.records.record import Record


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Outlines(Record):
    """The object's outline in every view. ``None`` in its place: everything is the object.

    Attributes:
        inside: Probability that the pixel shows the object; 0 in the padding.
        trusted: True for views whose outline agrees with the hull of the others.
        source: ``masks`` that a person gave, or ``found`` in the photographs.
    """

    inside: Float[Tensor, "view height width"]
    trusted: Bool[Tensor, " view"]
    source: Literal["masks", "found"]

    @property
    def masks(self) -> Bool[Tensor, "view height width"]:
        """True where the pixel more likely shows the object than not."""
        return self.inside > 0.5
