"""Soft masks of a scene from learned evidence: two readings of every view, cut by colours."""

import torch

from pimper_bench.evidence.evidence_maps import EvidenceMaps, evidence_maps
from pimper_bench.evidence.silhouette_network import SilhouetteNetwork, read
from pimper_torch.geometry.opencv import (
    BACKGROUND,
    OBJECT,
    PERHAPS_BACKGROUND,
    PERHAPS_OBJECT,
    discs_at,
    grab_cut,
    without_specks,
)
from pimper_torch.records import SilhouettePrior, SparseScene
from pimper_torch.records.shapes import Map, Maps, Mask
from pimper_torch.stages.silhouettes.cues import Cues, cues_of
from pimper_torch.stages.silhouettes.cuts import hull_margins
from pimper_torch.stages.silhouettes.parallax import of_views
from pimper_torch.stages.silhouettes.silhouette_config import SilhouetteConfig

_SURE = 4.0  # log odds from which colours do not decide
_DISC = 1 / 400  # of the longer side: around a matched point of the object
_CERTAIN = 0.95  # probability of the object inside a cut


def soft_masks(scene: SparseScene, network: SilhouetteNetwork) -> SilhouettePrior:
    """Find the object in every view by a network, for :attr:`Views.priors` of the scene.

    Returns:
        Masks of the undistorted photographs at the working size of silhouettes.
    """
    cues = cues_of(scene, SilhouetteConfig())
    evidence = evidence_maps(cues)
    odds = read(evidence, network)
    again = second_reading(evidence, odds)
    if again is not None:
        odds = read(again, network)
    masks = of_views(lambda view: cut_of_view(cues, view, odds[view]), len(odds))
    return SilhouettePrior(
        names=scene.views.names,
        sizes_px=cues.pictures.cameras.sizes_px,
        inside=torch.where(masks, _CERTAIN, 1 - _CERTAIN),
        undistorted=True,
    )


def second_reading(evidence: EvidenceMaps, odds: Maps) -> EvidenceMaps | None:
    """Cut every view, vote on the hull, and learn the backgrounds where the object is not.

    Args:
        odds: Of the first reading.

    Returns:
        ``None`` if the cuts have nothing in common.
    """
    cues = evidence.cues
    masks = of_views(lambda view: cut_of_view(cues, view, odds[view]), len(odds))
    margins_px = hull_margins(cues, masks.float())
    return None if margins_px is None else evidence_maps(cues, masks, margins_px)


def cut_of_view(cues: Cues, view: int, odds: Map) -> Mask:
    """Cut a view by colours where the odds are not clear; matched points are the object's."""
    height, width = odds.shape
    labels = torch.where(odds > 0, PERHAPS_OBJECT, PERHAPS_BACKGROUND).byte()
    labels[odds > _SURE] = OBJECT
    labels[odds < -_SURE] = BACKGROUND
    labels[discs_at(cues.object_px[view], _DISC * max(odds.shape), (width, height))] = OBJECT
    cut = grab_cut(cues.pictures.opponent[view], labels, 2)
    return without_specks(cut, torch.ones_like(cut), round(2e-4 * cut.numel()))
