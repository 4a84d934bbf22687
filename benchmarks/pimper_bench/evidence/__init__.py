"""Evidence about silhouettes that is learned.

:func:`soft_masks` finds the object in every view of a scene by a :class:`SilhouetteNetwork`, which
reads :func:`evidence_maps`: maps of cues, such as the residual to a :class:`LitPlane`.
"""

from pimper_bench.evidence.evidence_maps import EvidenceMaps, evidence_maps
from pimper_bench.evidence.lit_plane import LitPlane, lit_plane
from pimper_bench.evidence.silhouette_network import SilhouetteNetwork, load_network
from pimper_bench.evidence.soft_masks import soft_masks

__all__ = [
    "EvidenceMaps",
    "LitPlane",
    "SilhouetteNetwork",
    "evidence_maps",
    "lit_plane",
    "load_network",
    "soft_masks",
]
