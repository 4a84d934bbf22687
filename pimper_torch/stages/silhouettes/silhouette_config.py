"""Settings of silhouettes."""

from dataclasses import dataclass
from typing import Annotated, Literal

from pimper_torch.runtime.config import Range, require, require_ranges


@dataclass(frozen=True, slots=True, kw_only=True)
class SilhouetteConfig:
    """Settings of :class:`~pimper_torch.stages.silhouettes.find.FindSilhouettes`.

    Attributes:
        object: ``auto`` uses the photographs' masks, or else finds silhouettes, with the full image
            as a fallback. ``masks`` requires masks. ``everything`` treats the full image as the
            object, such as for walls, height fields and scenes.
        region: Box that contains the object: smallest x, y, z, then largest, in the cameras'
            frame; no box by default.
        size_px: Longer side of the images that are cut.
    """

    object: Literal["auto", "masks", "everything"] = "auto"
    region: tuple[float, ...] = ()
    size_px: Annotated[int, Range(least=64, most=65_535)] = 640

    def __post_init__(self) -> None:
        require_ranges(self)
        low, high = self.region[:3], self.region[3:]
        fits = len(self.region) in (0, 6) and all(a < b for a, b in zip(low, high, strict=True))
        require(fits, "region", self.region, "nothing, or smallest x, y, z, then largest")
