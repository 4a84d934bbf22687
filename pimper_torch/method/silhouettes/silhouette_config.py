"""Settings of finding and correcting silhouettes."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteConfig:
    """Settings of :class:`~pimper_torch.method.silhouettes.find.FindSilhouettes`.

    Attributes:
        object: Find silhouettes and fall back to everything (``auto``), take the masks that come
            with the photographs (``masks``), or take all that the photographs show for the object
            (``everything``), as for walls, height fields and scenes. Masks that are given are
            taken by ``auto``, too.
        region: Box that the object is inside: smallest x, y, z, then largest, in the cameras'
            frame; none unless given.
        size_px: Longer side of the pictures that are cut.
    """

    object: Literal["auto", "masks", "everything"] = "auto"
    region: tuple[float, ...] = ()
    size_px: Annotated[int, Range(least=64, most=65_535)] = 640

    def __post_init__(self) -> None:
        require_ranges(self)
        low, high = self.region[:3], self.region[3:]
        fits = len(self.region) in (0, 6) and all(a < b for a, b in zip(low, high, strict=True))
        require(fits, "region", self.region, "nothing, or smallest x, y, z, then largest")
