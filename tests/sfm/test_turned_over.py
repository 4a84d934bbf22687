import pytest
import torch

from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.scenes.whole_scene import build_scene
from pimper_torch.runtime.errors import PimperWarning
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from pimper_torch.stages.sfm.reconstruct_config import ReconstructConfig
from tests.sfm.test_turntable import center_errors, photographs


@pytest.mark.slow
def test_sessions_of_a_turned_object_are_registered_without_masks():
    settings = {"num_views": 24, "width": 320, "height": 240, "path": "turntable"}
    scene = build_scene(
        "mug", SceneConfig(**settings, elevation_deg=20.0, table="patterned", turned_over=True)
    )
    views = photographs(scene, list(range(24))).replace(masks=None)
    with pytest.warns(PimperWarning, match="between 2 capture sessions: 12 .*; 12 "):
        found = Reconstruct(ReconstructConfig(threads=1))(views)
    assert found.views.names == scene.names
    assert found.sessions.tolist() == [0] * 12 + [1] * 12
    assert center_errors(found, scene).median() < 0.005
    up = torch.tensor([0.0, 1.0, 0.0])
    down = -found.cameras.cam_from_world[:, 1, :3]
    assert ((down @ up > 0) == torch.tensor([True] * 12 + [False] * 12)).all()
