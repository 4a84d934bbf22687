"""Structure from motion of a bench's scene, stored between runs."""

import time

import pytest
from scenes import write_ball

from pimper_bench.scenes.rendered_folder import render_scene
from pimper_bench.scenes.scene_settings import SceneConfig
from pimper_bench.table.bench_inputs import BenchConfig, prepare
from pimper_torch.io.cameras.existing import existing_model
from pimper_torch.stages.sfm import reconstruct


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    settings = SceneConfig(num_views=6, width=64, height=48, supersample=1)
    path = write_ball(folder / "ball.ply", level=2)
    return render_scene(path, folder / "scene", settings, processes=1)


def test_a_scenes_model_is_computed_once_and_keeps_its_run_time(rendered, tmp_path, monkeypatch):
    runs = []

    def structure_from_motion(views, config):
        runs.append(config)
        time.sleep(0.3)
        return existing_model(views, rendered / "truth" / "sparse")

    monkeypatch.setattr(reconstruct, "structure_from_motion", structure_from_motion)
    config = BenchConfig(scenes=(str(rendered),), samples=500)
    first, second = (prepare(rendered, config, tmp_path / "cache") for _ in range(2))
    assert len(runs) == 1
    assert min(first.sfm_seconds, second.sfm_seconds) >= 0.3
    assert (first.scene.points_world == second.scene.points_world).all()
    other = BenchConfig(scenes=(str(rendered),), samples=500, cameras="features")
    prepare(rendered, other, tmp_path / "cache")
    assert [run.track_iterations for run in runs] == [2, 0]
