"""Photometric stereo from one viewpoint: normals and lights of every method, in one table.

    python benchmarks/photometric_stereo.py FOLDER [FOLDER ...]

Each FOLDER is one of: `images` of the UW photometric stereo set, a face of the Yale database B, or
meshes, of which spot.obj and bunny_hr.obj are rendered under 20 point lights with cast shadows.
Only the grey sphere (its circle is fitted to the mask) and the rendered meshes have true normals;
the others are compared with calibrated photometric stereo, as their rows state.
"""

import argparse
import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from one_viewpoint import read_uw_ps, read_yale_b
from reliefs import align_reliefs
from torch import Tensor
from torch.nn.functional import normalize

from pimper_bench.scenes import SceneObject, SensorConfig, render_objects
from pimper_bench.scenes.scene_lights import Lights
from pimper_bench.scenes.scene_object import Texture
from pimper_torch.geometry.pinholes import look_at, pinholes
from pimper_torch.io.meshes import read_mesh
from pimper_torch.radiometry import linear_from_srgb
from pimper_torch.runtime.errors import PimperError
from pimper_torch.single_view.factorization.bas_relief import BasRelief
from pimper_torch.single_view.photometric_stereo import PhotometricStereo, photometric_stereo
from pimper_torch.single_view.photometric_stereo.stereo import METHODS

HEIGHT = 240  # pixels of the rendered photographs
POINT_LIGHTS, SPREAD_DEG = 20, 60.0
FAR = 40.0  # of the camera, in sizes of the mesh: orthographic to a degree
SATURATED = 0.99
FRONTAL_DEG = (
    60.0  # of the Yale database's point lights, those nearer to the camera's axis than this
)

COLUMNS = (
    "scene",
    "method",
    "resolved by",
    "pixels %",
    "normals ° mean",
    "median",
    "with the best ambiguity",
    "lights ° mean",
    "with the best ambiguity",
    "s",
)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Photographs with their references."""

    name: str
    images: Tensor
    mask: Tensor
    lights: Tensor  # towards the point light, camera frame
    normals: Tensor | None  # None: those of known lights are taken


def main() -> None:
    """Print a row for each scene, method and resolver of its ambiguity."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--only", nargs="*", default=[], help="parts of the scenes' names")
    parser.add_argument("--methods", nargs="*", default=list(METHODS))
    options = parser.parse_args()
    say("| " + " | ".join(COLUMNS) + " |")
    say("|---|---|---|" + "--:|" * (len(COLUMNS) - 3))
    for folder in options.folders:
        for name, read in scenes(folder).items():
            if not options.only or any(part in name for part in options.only):
                measure(read(), options.methods)
        if (folder / "gray").is_dir():
            say("")
            say(encoding(folder))


def scenes(folder: Path) -> dict[str, Callable[[], Scene]]:
    """Name the scenes of a folder."""
    if (folder / "lights.txt").is_file():
        names = ("gray", "buddha", "cat", "horse")
        return {name: (lambda name=name: uw(folder, name)) for name in names}
    if list(folder.glob("*.pgm")):
        return {"yale b02": lambda: yale(folder)}
    return {
        "spot": lambda: rendered(folder / "spot.obj", "spot, one strength, many albedos", True),
        "bunny": lambda: rendered(
            folder / "bunny_hr.obj", "bunny, many strengths, one albedo", False
        ),
    }


def measure(scene: Scene, methods: list[str]) -> None:
    """Print the rows of a scene."""
    weight = (scene.images.amax(dim=1) < SATURATED).to(scene.images)
    truth, name = scene.normals, scene.name
    if truth is None:
        known = photometric_stereo(
            scene.images, scene.mask, method="calibrated", lights=scene.lights, weight=weight
        )
        truth = torch.where(known.valid[..., None], known.normals, 0)
        name = f"{name}, against known lights"
    runs = [("calibrated", None, {"robust": False}), ("calibrated", None, {})]
    for method in methods:
        runs += [(method, resolver, {}) for resolver in METHODS[method]]
    for method, resolve, settings in runs:
        began = time.perf_counter()
        label = f"{method}, least squares" if settings else method
        try:
            found = photometric_stereo(
                scene.images,
                scene.mask,
                method=method,
                resolve=resolve,
                lights=scene.lights if method == "calibrated" else None,
                weight=weight,
                **settings,
            )
        except PimperError as error:
            refusal = str(error).split(";")[0]
            say(f"| {name} | {label} | {resolve or ''} | {refusal} |" + " |" * 6)
            continue
        seconds = time.perf_counter() - began
        cells = figures(found, truth, scene.lights)
        say("| " + " | ".join([name, label, resolve or "", *cells, f"{seconds:.1f}"]) + " |")


def figures(found: PhotometricStereo, truth: Tensor, lights: Tensor) -> list[str]:
    """Compare normals and lights with the truth, and once more with the best ambiguity."""
    known = (truth != 0).any(dim=-1)
    both = found.valid & known
    if not both.any():
        return ["0.0", *["-"] * 5]
    normals, true = found.normals[both].mT.double(), truth[both].mT.double()
    off = angles_deg(normals, true)
    cells = [
        f"{100 * both.sum() / known.sum():.1f}",
        f"{off.mean():.2f}",
        f"{off.median():.2f}",
    ]
    used = (found.lights != 0).any(dim=1)
    given = lights[used].double()
    mine = found.lights[used].double()
    best_normals, best_lights = normals, mine
    if found.free != "nothing":
        relief = best_relief(normals, true)
        best_normals, best_lights = relief.on_shading(normals), relief.on_lights(mine)
    best = angles_deg(best_normals, true).mean()
    aims = [angles_deg(one.mT, given.mT).mean() for one in (mine, best_lights)]
    return [*cells, f"{best:.2f}", f"{aims[0]:.2f}", f"{aims[1]:.2f}"]


def best_relief(normals: Tensor, true: Tensor) -> BasRelief:
    """Find the bas-relief transformation after which normals are nearest to the true ones."""
    even = torch.ones(normals.shape[1], dtype=torch.float64)
    first = align_reliefs(normals, true, even)
    best: tuple[float, BasRelief] | None = None
    for start in (first, BasRelief(mu=0 * first.mu, nu=0 * first.nu, lam=1 + 0 * first.lam)):
        at = torch.stack([start.mu, start.nu, start.lam]).requires_grad_()
        search = torch.optim.LBFGS([at], max_iter=60, line_search_fn="strong_wolfe")

        def off(at: Tensor = at) -> Tensor:
            moved = BasRelief(mu=at[0], nu=at[1], lam=at[2]).on_shading(normals)
            return (normalize(moved, dim=0) - true).norm(dim=0).mean()

        def step(at: Tensor = at, off: Callable[[], Tensor] = off) -> Tensor:
            at.grad = None
            value = off()
            value.backward()
            return value

        search.step(step)
        mu, nu, lam = at.detach()
        value = float(off().detach())
        if best is None or value < best[0]:
            best = (value, BasRelief(mu=mu, nu=nu, lam=lam))
    assert best is not None
    return best[1]


def angles_deg(one: Tensor, other: Tensor) -> Tensor:
    """Return angles between columns."""
    chord = (normalize(one, dim=0) - normalize(other, dim=0)).norm(dim=0)
    return torch.rad2deg(2 * torch.asin((chord / 2).clamp_max(1)))


def uw(folder: Path, name: str) -> Scene:
    """Read an object of the UW set; the grey sphere has true normals."""
    capture = read_uw_ps(folder, name)
    truth = capture.truth
    assert truth is not None
    assert truth.foreground is not None
    assert truth.lights_world is not None
    mask = truth.foreground[0]
    return Scene(
        name=f"uw {name}",
        images=capture.views.images,
        mask=mask,
        lights=truth.lights_world[:, 1:],
        normals=sphere_normals(mask) if name == "gray" else None,
    )


def sphere_normals(mask: Tensor) -> Tensor:
    """Fit a circle to a disc by its area and centre; zero on the outermost 2 % of the radius."""
    rows, columns = torch.nonzero(mask, as_tuple=True)
    radius = math.sqrt(len(rows) / math.pi)
    y, x = torch.meshgrid(*(torch.arange(side) for side in mask.shape), indexing="ij")
    x = (x - columns.double().mean()) / radius
    y = (y - rows.double().mean()) / radius
    square = x**2 + y**2
    normals = torch.stack([x, y, -(1 - square).clamp_min(0).sqrt()], dim=-1)
    return torch.where((square < 0.98**2)[..., None] & mask[..., None], normals, 0).float()


def encoding(folder: Path) -> str:
    """Report whether the grey sphere is matte with its file values, or after decoding sRGB."""
    scene = uw(folder, "gray")
    inner = (scene.normals[..., 2] < -0.3) & scene.mask
    normals = scene.normals[inner].double()
    fractions = []
    for images in (scene.images, linear_from_srgb(scene.images)):
        samples = images.mean(dim=1)[:, inner].double()
        errors, total = [], []
        for row in samples:
            lit = row > 0.02
            point_light = torch.linalg.lstsq(normals[lit], row[lit, None]).solution
            errors.append((row[lit] - (normals[lit] @ point_light)[:, 0]).square().mean())
            total.append(row[lit].square().mean())
        fractions.append(float((torch.stack(errors).sum() / torch.stack(total).sum()).sqrt()))
    return (
        "Residual of the cosine on the grey sphere, as a fraction of its brightness: "
        f"{100 * fractions[0]:.1f} % as the files are, {100 * fractions[1]:.1f} % with sRGB undone."
    )


def yale(folder: Path) -> Scene:
    """Read a face under the point lights near the camera's axis, dark pixels masked."""
    capture = read_yale_b(folder)
    truth = capture.truth
    assert truth is not None
    assert truth.lights_world is not None
    lights = truth.lights_world[:, 1:]
    near = -lights[:, 2] > math.cos(math.radians(FRONTAL_DEG))
    images = capture.views.images[near]
    level = images.mean(dim=(0, 1))
    return Scene(
        name="yale b02",
        images=images,
        mask=level > 0.25 * level.median(),
        lights=lights[near],
        normals=None,
    )


def rendered(
    path: Path,
    name: str,
    one_strength: bool,
    *,
    spread_deg: float = SPREAD_DEG,
    point_lights: int = POINT_LIGHTS,
) -> Scene:
    """Photograph a matte mesh under distant point lights, with cast shadows and noise."""
    generator = torch.Generator().manual_seed(7)
    mesh = read_mesh(path)
    low, high = mesh.vertices_world.amin(dim=0), mesh.vertices_world.amax(dim=0)
    centre, size = (low + high) / 2, float((high - low).norm())
    mesh = mesh.replace(
        vertices_world=(mesh.vertices_world - centre) / size, normals_world=None, albedo=None
    )
    rotation = math.radians(200.0 if "spot" in path.name else 25.0)
    toward = torch.tensor([math.sin(rotation), 0.25, math.cos(rotation)], dtype=torch.float64)
    toward = normalize(toward, dim=0)
    pose = look_at(FAR * toward[None], torch.zeros(3).to(toward), toward.new_tensor([0.0, 1, 0]))
    cameras = pinholes(pose.expand(point_lights, -1, -1), 0.95 * HEIGHT * FAR, HEIGHT, HEIGHT)
    # A sunflower's seeds fill the cap evenly.
    index = torch.arange(point_lights, dtype=torch.float64) + 0.5
    cosine = 1 - index / point_lights * (1 - math.cos(math.radians(spread_deg)))
    around, sine = index * math.pi * (3 - math.sqrt(5)), (1 - cosine**2).sqrt()
    directions = torch.stack([sine * around.cos(), sine * around.sin(), -cosine], dim=1)
    rotation = pose[0, :3, :3].double()
    strength = torch.full((point_lights,), 0.9, dtype=torch.float64)
    if not one_strength:
        strength = 0.5 + 0.4 * torch.rand(point_lights, generator=generator, dtype=torch.float64)
    lights = Lights(
        positions_world=1e5 * directions @ rotation,
        irradiance=strength,
        ambient=torch.zeros_like(strength),
        target_world=torch.zeros(3, dtype=torch.float64),
    )
    texture = patches(generator) if one_strength else lambda points: 0.7 + 0 * points
    scene = render_objects(
        [SceneObject(mesh=mesh, texture=texture)],
        cameras,
        lights,
        generator,
        SensorConfig(supersample=1),
    )
    assert scene.foreground is not None
    return Scene(
        name=name,
        images=scene.views.images,
        mask=scene.foreground[0],
        lights=(strength[:, None] * directions).float(),
        normals=scene.normals_world[0] @ rotation.float().mT,
    )


def patches(generator: torch.Generator) -> Texture:
    """Paint the cells of random seeds in five colours."""
    seeds = torch.rand(60, 3, generator=generator) - 0.5
    palette = torch.tensor(
        [[0.8, 0.75, 0.7], [0.7, 0.3, 0.2], [0.3, 0.5, 0.7], [0.4, 0.6, 0.3], [0.75, 0.65, 0.25]]
    )
    colour = torch.randint(len(palette), (len(seeds),), generator=generator)

    def texture(points: Tensor) -> Tensor:
        return palette[colour[torch.cdist(points.float(), seeds).argmin(dim=-1)]]

    return texture


def say(line: str) -> None:
    """Write a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
