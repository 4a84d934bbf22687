"""Torch settings of the caller change no result, and calls leave them as they are."""

import ast
import atexit
import copy
import functools
import shutil
import subprocess
import sys
import tempfile
import threading
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import FunctionType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from probes import small_scene
from surfaces import surface_of
from torch import Tensor, nn
from torch.nn.functional import normalize
from torch.utils import _pytree as pytree

import pimper_torch as pt
from pimper_bench.scenes.procedural_meshes import icosphere
from pimper_torch.runtime.torch_settings import isolated, own_settings
from pimper_torch.single_view.factorization import factorize_from_many
from pimper_torch.stages.stage import Given

pytestmark = pytest.mark.filterwarnings("ignore::pimper_torch.runtime.errors.PimperWarning")
PACKAGE = Path(pt.__file__).parent


@contextmanager
def default_dtype(dtype):
    former = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(former)


@contextmanager
def changed_defaults():
    autocast = torch.autocast("cpu", dtype=torch.bfloat16)
    with default_dtype(torch.float64), torch.device("meta"), autocast:
        yield


SETTINGS = {
    "float64": lambda: default_dtype(torch.float64),
    "float16": lambda: default_dtype(torch.float16),
    "device": lambda: torch.device("meta"),
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "defaults": changed_defaults,
    "no_grad": torch.no_grad,
    "inference_mode": torch.inference_mode,
}


def settings():
    device = torch.get_default_device().type
    return torch.get_default_dtype(), device, torch.is_autocast_enabled("cpu")


@functools.cache
def sphere():
    return tuple(each.to(torch.float32) for each in small_scene(num_views=4, width=32))


@functools.cache
def chain(preset="default"):
    scene, coarse = sphere()
    stages = {"silhouettes": Given(pt.Silhouettes.everything(scene.views))}
    stages["triangulate" if preset == "paper" else "coarse_surface"] = Given(coarse)
    return pt.load_chain(preset, {"scales": [1.0]} if preset == "default" else {}, **stages)


@functools.cache
def plain(preset="default"):
    return chain(preset)(sphere()[0])


def identical(found, expected):
    """Compare records bit for bit, without the times of their reports."""
    pairs = zip(pytree.tree_leaves(found), pytree.tree_leaves(expected), strict=True)
    for one, other in pairs:
        if isinstance(one, Tensor):
            assert (one.dtype, one.device) == (other.dtype, other.device)
            assert torch.equal(one.isnan(), other.isnan())
            assert torch.equal(one.nan_to_num(), other.nan_to_num())


@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_a_chain_gives_the_same_bits_under_any_setting(preset, setting):
    expected = plain(preset)
    with SETTINGS[setting]():
        before = settings()
        found = chain(preset)(sphere()[0])
        assert settings() == before
    identical(found.replace(report=()), expected.replace(report=()))


@functools.cache
def given():
    """Arguments of public functions."""
    scene, coarse = sphere()
    side = torch.linspace(-0.5, 0.5, 24)
    slopes = torch.meshgrid(side, side, indexing="xy")
    normals = normalize(torch.stack([*slopes, -torch.ones(24, 24)], dim=-1), dim=-1)
    directions = [[0, 0, -1.0], [0.3, 0, -1], [0, 0.3, -1], [-0.3, 0, -1], [0.2, 0.2, -1]]
    lights = normalize(torch.tensor(directions), dim=1)
    vertices, faces = icosphere(3)
    vertices = vertices.float()
    maps = pt.NormalPrior(
        names=scene.views.names,
        sizes_px=scene.views.sizes_px,
        normals=torch.tensor([0.0, 0.0, -1.0]).expand(4, 24, 32, 3),
        variance=torch.full((4, 24, 32), 0.01),
        frame="camera",
        axes="opencv",
    )
    cameras = scene.cameras
    numbers = scene.views.images, cameras.intrinsics, cameras.cam_from_world
    return SimpleNamespace(
        scene=scene,
        coarse=coarse,
        named=scene.replace(views=scene.views.replace(priors=(maps,))),
        result=plain(),
        step=next(chain().steps(scene)),
        numbers=[each.numpy() for each in numbers],
        network=nn.Conv2d(3, 3, 3, padding=1).requires_grad_(False),
        normals=normals,
        radiance=(normals @ lights.mT).clamp_min(0).movedim(-1, 0)[:, None],
        mask=torch.ones(24, 24, dtype=torch.bool),
        lights=lights,
        matrix=torch.rand(8, 20, generator=torch.Generator().manual_seed(0)).double(),
        generator=torch.Generator(),
        ball=surface_of(vertices, faces, normals_world=vertices),
        delta=torch.full((4, 6), 1e-3),
        apart=pt.CameraDistance(first="view_00", second="view_02", length=10.0),
        photometric=pt.losses.PhotometricLoss(darkest=-1.0, brightest=10.0),
        consistent=pt.losses.ConsistencyLoss(darkest=-1.0, brightest=10.0),
        angular=pt.losses.NormalLoss(maps),
        outlines=pt.Silhouettes.everything(scene.views).replace(
            inside=torch.zeros(4, 24, 32).index_fill(1, torch.arange(6, 18), 1.0),
            reliable=torch.ones(4, dtype=torch.bool),
        ),
    )


@functools.cache
def files():
    """Folders with photographs, maps and a result."""
    tmp, one = Path(tempfile.mkdtemp()), given()
    atexit.register(shutil.rmtree, tmp)
    for name in ("photos", "normals", "depth", "masks"):
        (tmp / name).mkdir()
    for name, image in zip(one.scene.views.names, one.scene.views.images, strict=True):
        coded = pt.radiometry.to_bytes(pt.radiometry.srgb_from_linear(image.movedim(0, -1)))
        Image.fromarray(coded.numpy()).resize((96, 72)).save(tmp / "photos" / name)
        facing = -one.normals[:18, :, 2].numpy()
        stem = name.removesuffix(".png")
        np.save(tmp / "normals" / stem, one.normals[:18].numpy())
        np.save(tmp / "depth" / stem, 2 - facing)
        np.save(tmp / "masks" / stem, (facing > 0.9).astype(np.float32))
    pt.save_record(one.result, tmp / "result.safetensors")
    result = chain().finish(one.result)
    pt.write_result(result, chain().config, tmp / "written")
    return SimpleNamespace(
        folder=tmp, finished=result, views=pt.load_views(tmp / "photos"), mesh=tmp / "mesh.ply"
    )


def written(tmp):
    with tempfile.TemporaryDirectory() as folder:
        pt.write_result(tmp.finished, chain().config, Path(folder) / "out")
        return pt.read_mesh(Path(folder) / "out" / "mesh.ply")


def meshes_of(tmp, kind):
    pt.write_mesh(tmp.finished.mesh, tmp.folder / f"kind.{kind}")
    return pt.read_mesh(tmp.folder / f"kind.{kind}")


def stereo(one, **method):
    return pt.photometric_stereo(one.radiance, one.mask, **method)


# By name of the public function, or a name that says what is called.
CALLS = {
    "scene_of": lambda one: pt.scene_of(*one.numbers, points_world=one.scene.points_world),
    "scene_of lists": lambda one: pt.scene_of(*(each.tolist() for each in one.numbers)),
    "facets_of": lambda one: pt.facets_of(one.coarse.mesh, one.scene),
    "prepare": lambda one: chain().prepare(one.scene).replace(reports=()),
    "steps": lambda one: next(chain().steps(one.scene)).surface,
    "frozen": lambda one: one.step.frozen().patches,
    "finish": lambda one: chain().finish(one.result).replace(report=()),
    "priors_of": lambda one: pt.priors_of(
        lambda image: 0.2 * image - 0.6, one.scene, "normals", axes="opencv", mean=[0.5, 0.4, 0.3]
    ),
    "resolve_prior_conventions": lambda one: pt.resolve_prior_conventions(one.named),
    "find_scale": lambda one: pt.find_scale(one.result, camera_distances=[one.apart]).factor,
    "find_scale markers": lambda one: pt.find_scale(one.result, markers=50.0),
    "scaled": lambda one: pt.scaled(one.result, 2.0),
    "integrate_normal_map": lambda one: pt.integrate_normal_map(one.normals),
    "photometric_stereo": lambda one: stereo(one, method="calibrated", lights=one.lights),
    "photometric_stereo integrability": lambda one: stereo(
        one, method="integrability", resolve="albedo_entropy"
    ),
    "factorize_from_many": lambda one: (
        factorize_from_many(
            one.matrix, one.matrix > -1, rank=3, generator=one.generator.manual_seed(0)
        ).best.shading
    ),
    "by_facet": lambda one: pt.by_facet(one.step.patches, "spacing"),
    "plot_patch": lambda one: pt.plot_patch(one.step.heights[5]).clear(),
    "plot_in_view": lambda one: pt.plot_in_view(
        one.coarse, one.scene.cameras, 0, pt.by_facet(one.step.patches, "spacing")
    ).clear(),
    "PhotometricLoss": lambda one: one.photometric(one.ball, one.scene),
    "ConsistencyLoss": lambda one: one.consistent(
        one.ball, one.scene, one.photometric.visible(one.ball, one.scene)
    ),
    "NormalLoss": lambda one: one.angular(one.ball, one.scene),
    "PointToSurfaceLoss": lambda one: pt.losses.PointToSurfaceLoss(one.coarse.mesh)(one.ball),
    "SilhouetteLoss": lambda one: pt.losses.SilhouetteLoss(one.outlines, one.scene.cameras)(
        one.ball, one.scene.cameras
    ),
    "take and cat": lambda one: pt.Views.cat(
        [one.scene.views.take([0, 2]), one.scene.views.take([3, 1])]
    ),
    "everything": lambda one: pt.Silhouettes.everything(one.scene.views),
    "retract": lambda one: one.scene.cameras.retract(one.delta),
    "centers_world": lambda one: one.scene.cameras.centers_world,
    "of": lambda one: pt.PhotometricPatches.of(
        one.step.patches,
        normals=[bucket.normals_patch for bucket in one.step.photometric.buckets],
        lights=[bucket.lights_patch for bucket in one.step.photometric.buckets],
        information=0.3,
    ),
}
FILES = {
    "load_views": lambda tmp: pt.load_views(tmp.folder / "photos", max_size_px=40),
    "read_normals": lambda tmp: pt.read_normals(tmp.folder / "normals", tmp.views),
    "read_depth": lambda tmp: pt.read_depth(tmp.folder / "depth", tmp.views),
    "read_silhouettes": lambda tmp: pt.read_silhouettes(tmp.folder / "masks", tmp.views),
    "object_at": lambda tmp: pt.object_at([pt.Mark.read("view_00.png,20,20")], tmp.views),
    "save_record": lambda tmp: pt.save_record(tmp.finished, tmp.folder / "again.safetensors"),
    "load_record": lambda tmp: pt.load_record(pt.Reconstruction, tmp.folder / "result.safetensors"),
    "read_mesh": lambda tmp: pt.read_mesh(tmp.folder / "written" / "mesh.ply"),
    "write_mesh": lambda tmp: [meshes_of(tmp, kind) for kind in ("ply", "glb", "obj", "stl")],
    "read_result": lambda tmp: pt.export.read_written(tmp.folder / "written").replace(summary={}),
    "write_result": lambda tmp: written(tmp),
}
# Of public functions that make no tensors, or show others' results.
WITHOUT = {"batch", "load_chain", "make_chain", "load_config", "user_cache", "show", "segment"}
WITHOUT |= {"from_onnx"}  # priors_of calls the network


def call(name):
    return FILES[name](files()) if name in FILES else CALLS[name](given())


@functools.cache
def expected(name):
    return call(name)


@pytest.mark.parametrize("setting", ["defaults", "inference_mode"])
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in ("finish", "write_result") else [])
        for name in (*CALLS, *FILES)
    ],
)
def test_a_public_function_gives_the_same_bits_under_any_setting(name, setting):
    expected(name)
    with SETTINGS[setting]():
        before = settings()
        found = call(name)
        assert settings() == before
    identical(found, expected(name))


def test_every_public_function_is_called_under_other_settings():
    public = {name for name in pt._names if isinstance(getattr(pt, name), FunctionType)}
    assert public <= {*CALLS, *FILES, *WITHOUT}
    assert public >= WITHOUT


def made_on_import(tree):
    """Yield calls that make tensors when a module is imported, or as the default of a field."""
    for node in ast.iter_child_nodes(tree):
        inside = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        for part in node.args.defaults + node.args.kw_defaults if inside else [node]:
            called = [part.func, *part.args] if isinstance(part, ast.Call) else []
            if not MAKERS.isdisjoint(map(ast.unparse, called)):  # also by `partial`
                yield part
            elif isinstance(part, ast.AST):
                yield from made_on_import(part)


MAKERS = {
    f"torch.{name}"
    for name in (
        *("arange", "empty", "eye", "full", "linspace", "logspace", "ones", "zeros", "tensor"),
        *("as_tensor", "asarray", "rand", "randint", "randn", "randperm", "scalar_tensor"),
        *("Tensor", "tril_indices", "triu_indices"),
    )
}


def test_tensors_of_modules_have_a_dtype_and_a_device():
    """A module is imported on first use, under the caller's settings; functions run isolated."""
    found = 0
    for path in sorted(PACKAGE.rglob("*.py")):
        for call in made_on_import(ast.parse(path.read_text(encoding="utf-8"))):
            given_names = {keyword.arg for keyword in call.keywords}
            assert given_names >= {"dtype", "device"}, f"{path}:{call.lineno}"
            found += 1
    assert found >= 9  # the search finds those that exist


def test_the_package_is_imported_and_used_under_other_settings(tmp_path):
    program = (
        "import sys, torch\n"
        "torch.set_default_device('meta'); torch.set_default_dtype(torch.float64)\n"
        "import pimper_torch as pt\n"
        "views = pt.load_views(sys.argv[1])\n"
        "patches = pt.Decompose()(pt.load_record(pt.CoarseMesh, sys.argv[2]),\n"
        "                         pt.load_record(pt.Cameras, sys.argv[3]))\n"
        "assert views.images.dtype == torch.float32 and views.images.device.type == 'cpu'\n"
        "assert torch.get_default_dtype() == torch.float64\n"
        "assert torch.zeros(1).device.type == 'meta'\n"
    )
    pt.save_record(given().coarse, tmp_path / "coarse.safetensors")
    pt.save_record(given().scene.cameras, tmp_path / "cameras.safetensors")
    arguments = (
        files().folder / "photos",
        tmp_path / "coarse.safetensors",
        tmp_path / "cameras.safetensors",
    )
    subprocess.run([sys.executable, "-c", program, *map(str, arguments)], check=True)


def test_settings_are_the_callers_between_steps_and_after_errors():
    class Broken(pt.Stage):
        def forward(self, views: pt.Views) -> pt.Views:
            assert settings() == (torch.float32, "cpu", False)
            raise RuntimeError("broken")

    with changed_defaults():
        mine = settings()
        steps = chain().steps(sphere()[0])
        next(steps)
        assert settings() == mine
        steps.close()
        assert settings() == mine
        with pytest.raises(RuntimeError, match="broken"):
            Broken()(sphere()[0].views)
        assert settings() == mine == (torch.float64, "meta", True)


def test_the_default_dtype_returns_after_the_last_of_simultaneous_calls():
    inside, outside = threading.Event(), threading.Event()

    @isolated
    def first():
        inside.set()
        outside.wait(10)
        return torch.get_default_dtype()

    with default_dtype(torch.float64):
        found = []
        thread = threading.Thread(target=lambda: found.append(first()))
        thread.start()
        inside.wait(10)
        with own_settings(), own_settings():
            outside.set()
            thread.join()
            assert torch.get_default_dtype() == torch.float32
        assert found == [torch.float32]
        assert torch.get_default_dtype() == torch.float64
    with own_settings():
        torch.set_default_dtype(torch.float64)
    assert torch.get_default_dtype() == torch.float64  # set by another thread in the meantime
    torch.set_default_dtype(torch.float32)


def nothing_compiled(graph, inputs):
    raise AssertionError("a stage was compiled")


@pytest.mark.parametrize("how", ["chain", "module", "function"])
def test_a_compiled_chain_runs_as_it_is(how):
    expected, scene = plain(), sphere()[0]
    model = copy.deepcopy(chain())
    compiled = functools.partial(torch.compile, backend=nothing_compiled)
    if how == "module":
        model.compile(backend=nothing_compiled)
        found = model(scene)
    else:
        found = compiled(model if how == "chain" else lambda record: model(record))(scene)
    identical(found.replace(report=()), expected.replace(report=()))
    torch.compiler.reset()


def test_a_network_that_was_compiled_runs_compiled_inside_a_stage():
    graphs = []

    def counted(graph, inputs):
        graphs.append(graph)
        return graph.forward

    class Brighter(pt.Stage):
        def __init__(self) -> None:
            super().__init__()
            self.network = torch.compile(nn.Linear(3, 3), backend=counted)

        def forward(self, views: pt.Views) -> pt.Views:
            return views.replace(images=self.network(views.images.movedim(1, -1)).movedim(-1, 1))

    for wrapped in (nn.Sequential, functools.partial(torch.compile, backend=nothing_compiled)):
        torch.compiler.reset()
        graphs.clear()
        wrapped(Brighter())(sphere()[0].views)
        assert len(graphs) == 1
    torch.compiler.reset()


def gradients(setting):
    """Return gradients by photographs and camera steps, of a pass and a loss under a setting."""
    scene, _ = sphere()
    images = scene.views.images.clone().requires_grad_()
    delta = torch.zeros(4, 6, requires_grad=True)
    with setting():
        views = scene.views.replace(images=images)
        moved = scene.replace(views=views, cameras=scene.cameras.retract(delta))
        step = next(chain().steps(moved))
        photometric = pt.losses.PhotometricLoss(darkest=-1.0, brightest=10.0)
        loss = photometric(given().ball, moved)
    return torch.autograd.grad(loss + step.surface.normals_world[:, 0].sum(), [images, delta])


def test_gradients_of_a_pass_under_other_settings_are_those_without():
    pairs = zip(gradients(changed_defaults), gradients(nullcontext), strict=True)
    for found, wanted in pairs:
        assert wanted.abs().max() > 0
        assert torch.equal(found, wanted)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize(
    "call",
    [
        lambda scene, dtype: pt.load_chain("default")(scene.views.to(dtype)),
        lambda scene, dtype: next(chain().steps(scene.to(dtype))),
        lambda scene, dtype: pt.Warp()(scene.views.to(dtype), scene.cameras, given().step.patches),
        lambda scene, dtype: pt.scene_of(scene.views.images.to(dtype), *given().numbers[1:]),
    ],
)
def test_half_precision_is_refused_in_a_sentence(call, dtype):
    name = str(dtype).removeprefix("torch.")
    message = rf"images is {name}\[4, 3, 24, 32\]; needed: float32 .*`\.to\(torch\.float32\)`"
    with pytest.raises(pt.InputError, match=message):
        call(sphere()[0], dtype)


def test_maps_of_a_network_under_autocast_are_single_precision():
    with SETTINGS["autocast"]():
        prior = pt.priors_of(given().network, sphere()[0], "albedo", error=0.1)
    assert prior.albedo.dtype == prior.variance.dtype == torch.float32


def test_a_warning_has_the_line_of_the_caller():
    images, *cameras = given().numbers
    coded = np.round(255 * images.clip(0, 1)).astype(np.float32) / 255
    with pytest.warns(pt.PimperWarning, match="multiples of 1/255") as caught:
        pt.scene_of(coded, *cameras)
    assert caught[0].filename == __file__
