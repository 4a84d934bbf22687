import numpy as np
import pytest
from PIL import Image

from pimper_torch.result.viz.overview import draw_preview
from pimper_torch.result.viz.render import frame, shade


def test_the_photograph_and_the_surface_from_three_sides_stand_side_by_side(
    reconstruction, tmp_path
):
    path = tmp_path / "preview.png"
    coarse = reconstruction.coarse
    draw_preview(reconstruction.scene, coarse, path, 90)
    sheet = np.asarray(Image.open(path).convert("RGB")).astype(float) / 255
    assert sheet.shape[0] == 90
    own = reconstruction.cameras.take([coarse.reference])
    front = shade(coarse.mesh, frame(own, coarse.mesh.vertices_world, 90, 0.05)).numpy()
    width, height = own.sizes_px[0].tolist()
    left, top = round(90 * width / height), (90 - front.shape[0]) // 2
    found = sheet[top : top + front.shape[0], left : left + front.shape[1]]
    assert np.abs(found - front).max() <= 0.5 / 255 + 1e-6  # rounding to bytes
    image = reconstruction.scene.views.images[coarse.reference]
    assert sheet[:, :left].mean() ** 2.2 == pytest.approx(float(image.mean()), abs=0.1)
    sides = sheet[:, left + front.shape[1] :]
    assert sides.min() < 0.9  # something is seen there
    assert [path.name for path in tmp_path.iterdir()] == ["preview.png"]
