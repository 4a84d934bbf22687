import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from pimper_torch.ground.geometry.opencv import signed_distance


def test_a_distance_is_exact_wherever_in_memory_the_mask_lies():
    """OpenCV's differs in the last bit from call to call."""
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[13:41, 22:57] = True
    inner, outer = (distance_transform_edt(side) for side in (mask, ~mask))
    exact = np.where(mask, inner - 0.5, 0.5 - outer).astype(np.float32)
    kept = []
    for extra in range(200):
        kept.append(np.empty(13 * extra + 1))  # so that the next call finds other addresses
        assert np.array_equal(signed_distance(mask).numpy(), exact)
