"""Examples of docstrings and Python blocks of documentation pages run."""

import doctest
import json
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from photographs import save_photographs
from stand_ins import CHILD
from torch.nn.functional import normalize
from torch.testing import assert_close

import pimper_bench
import pimper_torch
from pimper_bench.scenes import (
    RenderedScene,
    SceneConfig,
    render_scene,
    render_shape,
    sparse_scene,
)
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_bench.scenes.render_in_memory import Sphere
from pimper_bench.scenes.scene_cameras import arc_cameras
from pimper_bench.scenes.scene_lights import wandering_lights
from pimper_bench.scenes.textures import random_speckle
from pimper_torch.cli.batches import task
from pimper_torch.cli.options import InputOptions
from pimper_torch.io.cameras import read_cameras
from pimper_torch.lighting.light_field import harmonics
from pimper_torch.presets import load_chain as presets
from pimper_torch.presets.load_config import load_config
from pimper_torch.records import Silhouettes, SparseScene, Verdict, Views
from pimper_torch.runtime.errors import InputError
from pimper_torch.stages.photometry import factorize
from pimper_torch.stages.sfm.reconstruct import Reconstruct
from tests.relighting import ball

PACKAGES = [Path(package.__file__).parent for package in (pimper_torch, pimper_bench)]
ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```python\n(.*?)^```", flags=re.MULTILINE | re.DOTALL)
BLOCKS = BLOCK.findall(README)


PAGES = {
    str(path.relative_to(ROOT)): path.read_text(encoding="utf-8")
    for path in (*sorted((ROOT / "docs").glob("*.md")), ROOT / "benchmarks" / "README.md")
}

# Thousands of facets take 20 seconds, and silhouettes as long as everything else.
FEW = {"coarse_surface": {"num_facets": 100}, "silhouettes": {"object": "everything"}}


def modules_with_examples() -> list[str]:
    """List the modules with examples that are not marked as skipped."""
    return [
        ".".join(path.relative_to(package.parent).with_suffix("").parts).removesuffix(".__init__")
        for package in PACKAGES
        for path in sorted(package.rglob("*.py"))
        if re.search(r">>> (?!.*# doctest: \+SKIP)", path.read_text(encoding="utf-8"))
    ]


@pytest.mark.parametrize("name", modules_with_examples())
def test_examples_of_docstrings_give_the_shown_output(name):
    ran = doctest.testmod(import_module(name))
    assert ran.attempted > 0
    assert ran.failed == 0


def photographed() -> tuple[RenderedScene, SparseScene]:
    """Nine small photographs of a ball, and a scene like that of structure from motion."""
    generator = torch.Generator().manual_seed(18)
    cameras = arc_cameras(9, width=56, height=42, focal_px=70.0, distance=4.0, span_deg=40.0)
    point_lights = wandering_lights(9, generator, distance=5.0, spread_deg=35.0)
    texture = random_speckle(generator, cells=(0.3, 0.1), contrast=1.0)
    scene = render_shape(Sphere(), cameras, point_lights.harmonics_world(), texture)
    return scene, sparse_scene(scene, 120, generator)  # fewer points would trigger depth maps


def a_folder_of_photographs(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    scene, found = photographed()
    save_photographs(scene.views, Path("photos"))

    def place(_: Reconstruct, views: Views, sparse_model: object = None) -> SparseScene:
        assert views.names == found.views.names
        return found.replace(views=views)

    monkeypatch.setattr(Reconstruct, "forward", place)  # the slowest stage
    few = FEW | {"scales": [1.0]}
    monkeypatch.setattr(presets, "load_config", lambda name, _: load_config(name, few))
    return {}


def a_matrix_and_patches(_: pytest.MonkeyPatch) -> dict[str, object]:
    generator = torch.Generator().manual_seed(4)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    normals = normalize(drawn(2, 50, 3), dim=-1)
    lights, shading = drawn(2, 9, 4), harmonics(normals).mT
    return {
        "X": lights[0] @ shading[0],
        "weight": torch.ones(9, 50, dtype=torch.float64),
        "J": lights @ shading,
        "D": torch.ones(2, 9, 50, dtype=torch.float64),
        "N": shading,
        "start": lights + 0.01 * drawn(2, 9, 4),
        "c": torch.zeros(2, 9, dtype=torch.float64),
    }


def a_ball() -> tuple[torch.Tensor, torch.Tensor]:
    side = torch.linspace(-1.05, 1.05, 40, dtype=torch.float64)
    y, x = torch.meshgrid(side, side, indexing="ij")
    normals = torch.stack([x, y, -(1 - x**2 - y**2).clamp_min(0).sqrt()], dim=-1)
    return normals, x**2 + y**2 < 0.9


def photographs_of_one_viewpoint(_: pytest.MonkeyPatch) -> dict[str, object]:
    normals, mask = a_ball()
    generator = torch.Generator().manual_seed(5)
    point_lights = torch.randn(12, 3, generator=generator, dtype=torch.float64) - torch.tensor(
        [0, 0, 3.0]
    )
    albedo = 0.3 + 0.6 * (normals[..., 0] > 0)
    shading = torch.einsum("hwx,lx->lhw", normals, normalize(point_lights, dim=1))
    return {"images": (albedo * shading.clamp_min(0))[:, None], "mask": mask}


def a_normal_map(_: pytest.MonkeyPatch) -> dict[str, object]:
    normals, mask = a_ball()
    K = torch.tensor([[90.0, 0, 20], [0, 90, 20], [0, 0, 1]], dtype=torch.float64)
    return {"normals": normals, "mask": mask, "K": K}


def a_scene_in_tensors(_: pytest.MonkeyPatch) -> dict[str, object]:
    scene, found = photographed()
    vertices, faces = icosphere(2)
    return {
        "images": scene.views.images.float(),
        "K": found.cameras.intrinsics,
        "cam_from_world": found.cameras.cam_from_world,
        "masks": scene.foreground,
        "vertices": vertices,
        "faces": faces,
    }


def a_scene_and_a_chain(_: pytest.MonkeyPatch) -> dict[str, object]:
    _, scene = photographed()
    chain = pimper_torch.load_chain("default", {"scales": [1.0]})
    return {"scene": scene, "chain": chain, "pt": pimper_torch, "torch": torch}


@pytest.mark.usefixtures("small_pictures")
@pytest.mark.filterwarnings("default::pimper_torch.runtime.errors.PimperWarning")
def test_the_python_of_the_readme_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (block,) = BLOCKS
    names = a_folder_of_photographs(monkeypatch)
    exec(compile(block, "README.md", "exec"), names)


def a_glance_at_photographs(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    a_folder_of_photographs(monkeypatch)
    monkeypatch.setattr(presets, "load_config", lambda *_: load_config("fast", FEW))
    return {}


def no_names(_: pytest.MonkeyPatch) -> dict[str, object]:
    return {}


def a_scene_and_a_mesh(_: pytest.MonkeyPatch) -> dict[str, object]:
    scene, found = photographed()
    vertices, faces = icosphere(1)
    cameras = found.cameras
    images = scene.views.images.float()
    masks = scene.foreground
    return {
        "scene": pimper_torch.scene_of(
            images, cameras.intrinsics, cameras.cam_from_world, masks=masks
        ),
        "mesh": pimper_torch.Mesh(vertices_world=vertices, faces=faces),
    }


def a_custom_data_set(_: pytest.MonkeyPatch) -> dict[str, object]:
    scene, found = photographed()
    folder = Path("mine")
    save_photographs(scene.views, folder)
    names = sorted(path.name for path in folder.iterdir())
    flipped = torch.tensor([1.0, -1, -1, 1], dtype=torch.float64)
    cameras = found.cameras
    listed = [
        {
            "file": name,
            "focal_px": 70.0,
            "size_px": [56, 42],
            "world_from_cam": (torch.linalg.inv(pose.double()) * flipped).tolist(),
        }
        for name, pose in zip(names, cameras.cam_from_world, strict=True)
    ]
    (folder / "cameras.json").write_text(json.dumps(listed), encoding="utf-8")
    return {}


def losses(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    monkeypatch.setattr(factorize, "LOSSES", dict(factorize.LOSSES))
    return {}


def camera_formats(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    monkeypatch.setattr(read_cameras, "FORMATS", list(read_cameras.FORMATS))
    return {}


def a_result(_: pytest.MonkeyPatch) -> dict[str, object]:
    scene, _ = ball.photographed((0.0, 0.3, 1.0), views=3)
    chain = pimper_torch.load_chain("default", judge=pimper_torch.stages.Given(GOOD))
    result = Found(
        mesh=ball.ball_mesh(),
        scene=scene,
        cameras=scene.cameras,
        silhouettes=Silhouettes.everything(scene.views),
        held_out=None,
        report=(),
        failures=(),
        left_out=(),
        verdict=None,
    )
    return {"result": result, "chain": chain}


GOOD = Verdict(score=1.0, text="Good.", scores={})


class Found(SimpleNamespace):
    """Stand-in for a result, with the methods that a chain's finish calls."""

    def to(self, _: str) -> "Found":
        return self

    def replace(self, **changes: object) -> "Found":
        return Found(**vars(self) | changes)


def photographs_and_maps(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    a_folder_of_photographs(monkeypatch)
    unit = 3**-0.5
    for folder, shape, value in (("normals", (3,), -unit), ("depth", (), -unit), ("masks", (), 1)):
        Path(folder).mkdir()
        for path in Path("photos").iterdir():
            np.save(Path(folder) / f"{path.stem}.npy", np.full((42, 56, *shape), value))
    return {"pt": pimper_torch}


def two_captures(_: pytest.MonkeyPatch) -> dict[str, object]:
    scene, _ = photographed()
    save_photographs(scene.views, Path("captures") / "plain")
    config = SceneConfig(num_views=3, width=56, height=42, supersample=1)
    render_scene("balls", Path("captures") / "balls", config)
    return {"__name__": "__main__"}


def two_objects(monkeypatch: pytest.MonkeyPatch) -> dict[str, object]:
    scene, _ = photographed()
    for name in ("cup", "jar"):
        save_photographs(scene.views, Path("scans") / name)
    monkeypatch.setattr(task, "_CHILD", CHILD)  # tests/cli/test_options.py runs the real one
    return {}


# The names that each block of a page requires, by page and number.
GIVEN_TO: dict[tuple[str, int], Callable[[pytest.MonkeyPatch], dict[str, object]]] = {
    ("docs/index.md", 0): a_glance_at_photographs,
    ("docs/python.md", 0): a_folder_of_photographs,
    ("docs/python.md", 1): a_scene_and_a_mesh,
    ("docs/python.md", 2): a_scene_in_tensors,
    ("docs/python.md", 3): a_scene_and_a_chain,
    ("docs/python.md", 4): a_scene_and_a_chain,
    ("docs/parts.md", 0): a_matrix_and_patches,
    ("docs/parts.md", 1): photographs_of_one_viewpoint,
    ("docs/parts.md", 2): a_normal_map,
    ("docs/data.md", 0): two_captures,
    ("docs/result.md", 0): a_result,
    ("docs/many.md", 0): two_objects,
    ("docs/conventions.md", 0): no_names,
    ("docs/priors.md", 0): photographs_and_maps,
    ("docs/priors.md", 1): photographs_and_maps,
    ("docs/priors.md", 2): photographs_and_maps,
    ("docs/extending.md", 0): a_scene_and_a_mesh,
    ("docs/extending.md", 1): a_scene_and_a_mesh,
    ("docs/extending.md", 2): a_scene_and_a_mesh,
    ("docs/extending.md", 3): losses,
    ("docs/extending.md", 4): camera_formats,
    ("docs/extending.md", 5): a_custom_data_set,
}


@pytest.mark.parametrize(("page", "number"), GIVEN_TO)
@pytest.mark.usefixtures("small_pictures")
@pytest.mark.filterwarnings("default::pimper_torch.runtime.errors.PimperWarning")
def test_the_python_of_the_pages_runs(page, number, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run_block(page, number, monkeypatch)


def run_block(page, number, monkeypatch):
    names = GIVEN_TO[page, number](monkeypatch)
    exec(compile(BLOCK.findall(PAGES[page])[number], f"{page}, {number}", "exec"), names)
    return names


def test_the_reader_of_the_pages_reads_the_cameras(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run_block("docs/extending.md", 5, monkeypatch)
    _, found = photographed()
    read = names["scene"].cameras
    assert_close(read.cam_from_world, found.cameras.cam_from_world.to(read.intrinsics))
    assert_close(read.intrinsics, found.cameras.intrinsics.to(read.intrinsics))


def test_the_camera_format_of_the_pages_is_registered_and_read(tmp_path, monkeypatch):
    run_block("docs/extending.md", 4, monkeypatch)
    path = tmp_path / "mine.csv"
    path.write_text("a.png,64,48,90,1,0,0,0.5,0,1,0,0,0,0,1,2\n")
    (camera,) = read_cameras.read_cameras(path, ["a.png"], lambda names: [None for _ in names])
    assert (camera.name, camera.lens.params) == ("a.png", (90, 32, 24))
    assert camera.cam_from_world[:3, 3].tolist() == [0.5, 0, 2]
    with pytest.raises(InputError, match=r"needed: .*cameras\.npz \(arrays\), cameras\.csv"):
        read_cameras.read_cameras(tmp_path / "a.txt", [], lambda names: [])


def test_every_format_of_cameras_is_in_the_table_and_in_the_help():
    rows = PAGES["docs/index.md"].split("### Known cameras")[1].split("## ")[0]
    for each in read_cameras.FORMATS:
        assert re.search(rf"\n\| `{each.name}`.*\| .*\|", rows)
        assert all(suffix in str(InputOptions.__doc__) for suffix in each.suffixes)


def test_every_block_of_python_in_the_pages_is_run():
    found = {
        (page, number) for page, text in PAGES.items() for number in range(len(BLOCK.findall(text)))
    }
    assert found == set(GIVEN_TO)
