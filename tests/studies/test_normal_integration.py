import numpy as np
import torch
from normal_integration import read_normal_map
from PIL import Image
from torch.testing import assert_close

from pimper_torch.io.decode import write_deep_png

WIDTH, HEIGHT = 20, 16


def test_a_normal_map_has_its_depth_and_pinhole(tmp_path):
    levels = np.uint16(np.round((np.array([0.6, 0.0, 0.8]) + 1) / 2 * 65535))
    write_deep_png(np.tile(levels, (HEIGHT, WIDTH, 1)), tmp_path / "normal_map.png")
    mask = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
    mask[2:5] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    found = read_normal_map(tmp_path)
    assert found.intrinsics is None
    assert found.depth is None
    np.savetxt(tmp_path / "K.txt", [[900.0, 0, 9.5], [0, 890, 7.5], [0, 0, 1]])
    depth = np.full((HEIGHT, WIDTH), np.nan)
    depth[2:5] = 1500
    np.savez(tmp_path / "depth_gt.npz", depth_gt=depth)
    found = read_normal_map(tmp_path)
    assert found.intrinsics.tolist() == [[900, 0, 10], [0, 890, 8], [0, 0, 1]]  # the very centre
    assert_close(found.normals[3, 4], torch.tensor([0.6, 0, -0.8]), atol=1e-4, rtol=0)
    assert found.normals[8].abs().sum() == 0
    assert found.depth[3, 4] == 1500
    assert found.depth[8, 4].isposinf()
