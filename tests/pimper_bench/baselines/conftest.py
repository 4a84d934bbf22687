from functools import cache

import pytest
import torch
from reliefs import WavyPlane
from view_comparison import compare_in_view

from pimper_bench.scenes import render_shape, sparse_scene
from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.textures import random_speckle, random_waves
from pimper_torch.paper.paper_config import TriangulateConfig
from pimper_torch.paper.triangulate import Triangulate

SPHERE = Sphere()
BUMPS = WavyPlane(
    height_field=random_waves(
        torch.Generator().manual_seed(3), wavelength=0.5, root_mean_square=0.03, axes=2
    )
)


@pytest.fixture(autouse=True)
def _bare(monkeypatch, tmp_path):
    """Hide installed programs."""
    (tmp_path / "bin").mkdir()
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))


@pytest.fixture
def sphere():
    return SPHERE


@pytest.fixture
def bumps():
    return BUMPS


@pytest.fixture(scope="package")
def photographed():
    """Nine exact views of a shape, its cloud, and a mesh of about 60 facets of its points."""

    @cache
    def build(shape, ambient=0.12, num_views=9):
        generator = torch.Generator().manual_seed(5)
        target = (0.0, 0.0, 1.0) if shape is SPHERE else (0.0, 0.0, 0.0)
        options = {"width": 120, "height": 90, "focal_px": 350.0, "distance": 3.0}
        cameras = arc_cameras(num_views, span_deg=40.0, target=target, **options)
        # At most 35 degrees off: visible surface has no shadows, so first order is exact.
        point_lights = wandering_lights(
            num_views,
            generator,
            distance=5.0,
            spread_deg=35.0,
            min_tilt_deg=5.0,
            irradiance=0.6,
            ambient=ambient,
        )
        texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
        truth = render_shape(shape, cameras, point_lights.harmonics_world(), texture)
        scene = sparse_scene(truth, 200, generator)
        config = TriangulateConfig(num_points=30)
        return truth, scene, Triangulate(config)(scene)

    return build


@pytest.fixture
def compared():
    """Compare a mesh with the truth along the rays of the coarse mesh's reference view."""

    def compare(mesh, truth, coarse):
        view = coarse.reference
        return compare_in_view(
            mesh,
            torch.eye(4),
            truth.cameras,
            view,
            truth.depth[view],
            normals_true=truth.normals_world[view],
        )

    return compare
