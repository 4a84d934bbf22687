"""Overlap of photographs, from matched features of small copies."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor
from torch.nn.functional import pad

from pimper_torch.cli.doctor.findings import Finding
from pimper_torch.records import Views
from pimper_torch.runtime.errors import some
from pimper_torch.stages.sfm.features import SMALLEST_PX, find_features, workspace
from pimper_torch.stages.sfm.matching import VerifiedPair, all_pairs, match_pairs, verified_pairs
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig


def match_copies(copies: Sequence[Float[Tensor, "rows columns"]]) -> list[VerifiedPair]:
    """Return the verified pairs of small copies; pairs without common features are excluded."""
    count, shapes = len(copies), [copy.shape for copy in copies]
    if count < 2 or min(map(min, shapes)) < SMALLEST_PX:  # which a run refuses
        return []
    height, width = (max(sides) for sides in zip(*shapes, strict=True))
    padded = [pad(copy, (0, width - copy.shape[1], 0, height - copy.shape[0])) for copy in copies]
    views = Views(
        images=torch.stack(padded)[:, None],
        sizes_px=torch.tensor([shape[::-1] for shape in shapes]),
        names=tuple(map(str, range(count))),
        masks=None,
        focals_px=torch.full((count,), torch.nan),
    )
    settings = ReconstructConfig(peak_threshold=0.004, max_features=1500, affine_shape=False)
    # Neighbours first: on a turntable the last photograph is next to the first.
    pairs = sorted(
        all_pairs(count), key=lambda pair: min(pair[1] - pair[0], count - pair[1] + pair[0])
    )
    with workspace(views, settings.num_threads) as space:
        find_features(space, settings, [None] * count, range(count))
        # All pairs of up to 40 photographs; fewer than 12 verified matches occur by chance.
        match_pairs(space, pairs[:800], settings, 12)
        return verified_pairs(space)


def overlap(names: Sequence[str], matches: Sequence[VerifiedPair]) -> Finding:
    """Report whether matches connect all photographs."""
    count = len(names)
    links = np.array([pair.views for pair in matches], dtype=np.int64).reshape(-1, 2)
    usual = sorted(np.bincount(links.flatten(), minlength=count))[count // 2]
    graph = coo_array((np.ones(len(links)), tuple(links.T)), shape=(count, count))
    groups = connected_components(graph, directed=False)[1]
    largest = np.bincount(groups).argmax()
    apart = [name for name, group in zip(names, groups, strict=True) if group != largest]
    found = f"each photograph matches {usual} others in the median"
    if not apart:
        return Finding("overlap", "ok", f"{found}; all are connected")
    return Finding(
        "overlap",
        "warning",
        f"{found}; {len(apart)} of {count} are not connected to the rest: {some(apart, 4)}",
        "two matching neighbours each, and one connected group",
        "Take photographs in between, 10 to 15 degrees apart. This check uses small copies; a full "
        "run may still connect them.",
    )
