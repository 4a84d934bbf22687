"""Whether photographs that are taken for one lens's fit a lens each much better."""

from collections import Counter

import torch

from pimper_torch.sfm.bundling import bundle
from pimper_torch.sfm.matching import MOST_PAIRED
from pimper_torch.sfm.model import SparseModel, longest_tracks, select_views
from pimper_torch.sfm.reprojection import observation_errors

# Points a view that tell, of up to 66 views; fewest views of a lens; choices.
_POINTS, _FEWEST = 100, 4
# Part of the errors with one lens that a lens each must leave to be believed, and spread of its
# focal lengths: choices. On 8 simulated views of a ball with 0.2 px of noise it leaves 1.00 of one
# lens, 0.93 of two whose focal lengths are as 1 to 1.1, 0.76 as 1 to 1.25, 0.60 as 1 to 1.5.
_MUCH_BETTER, _SPREAD = 0.8, 0.05
_SCALE_PX, _TOLERANCE = 1.0, 1e-5


def doubt_one_lens(model: SparseModel) -> str:
    """State why photographs were taken with several lenses, if a lens each fits much better."""
    shared = Counter(lens.camera for lens in model.lenses)
    if not shared or max(shared.values()) < _FEWEST or not len(model.points_world):
        return ""
    step = -(-model.num_views // MOST_PAIRED)
    some = longest_tracks(select_views(model, range(0, model.num_views, step)), _POINTS)
    each = tuple(lens.replace(camera=view + 1) for view, lens in enumerate(some.lenses))
    one, freed = (
        bundle(start, _SCALE_PX, tolerance=_TOLERANCE)
        for start in (some, some.replace(lenses=each))
    )
    before, after = (float(observation_errors(found).median()) for found in (one, freed))
    focals = torch.tensor([lens.params[0] for lens in freed.lenses])
    low, high = torch.quantile(focals, torch.tensor([0.1, 0.9])).tolist()
    if after > _MUCH_BETTER * before or high < (1 + _SPREAD) * low:
        return ""
    return (
        f"Points reproject {before:.2f} px off with one lens for {max(shared.values())} "
        f"photographs, and {after:.2f} px with a lens of its own for each, of focal lengths from "
        f"{low:.0f} to {high:.0f} px. The photographs seem to be zoomed or cropped: keep EXIF in "
        "their files, or give `--reconstruct.own-cameras`."
    )
