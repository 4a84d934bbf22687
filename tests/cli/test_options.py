"""Every option of every command runs once from the command line."""

import dataclasses
import json
import os
import re
import shutil
from types import UnionType
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import pytest
from scenes import write_ball
from stand_ins import CHILD, children_stand_in, write_slurm

import pimper_torch as pt
from pimper_torch.cli.batches import task
from pimper_torch.cli.main import main
from pimper_torch.cli.options import parse
from pimper_torch.io.meshes import write_ply
from pimper_torch.store import Store
from tests.priors.onnx_files import brightness
from tests.video.clips import written

# The values of each option; {names} are paths in the folder of `world`.
RUNS = {
    "reconstruct": [
        "{photos} --out {out} --sparse {sparse} --mesh {ball} --masks {masks} --device cpu "
        "--faces all --max-memory 20GB --scales (0.5,) --on-failure fail "
        "--hold-out 2 --preset {preset} --reference view_002 --max-size-px 48 --overwrite "
        "--cache {out}_kept --fresh --max-kept 2GB --object masks --mask-object bright "
        "--region (-9.0,-9.0,-9.0,9.0,9.0,9.0) --watertight --stl --obj --open "
        "--texture webp --asset-cameras "
        "--scale-bar view_000.png,32,24+view_003,32,24 view_001,32,24 250 "
        "--camera-distance view_000 view_003.png 0.5 --markers 25 --unit cm --view --no-report "
        "--normals {maps} --axes world --normals-error-deg 10 --depth {maps} --depth-error 0.05",
        "{photos} -o {out} --sparse {sparse} --mesh {true_mesh} --preset {preset} --max-size-px 48 "
        "--silhouettes {masks} --segmenter {network} --object-at view_000.png,32,24 "
        "--object-at view_002,30,25 --no-report",
    ],
    "batch": [
        "{table} --out {out} --jobs 1 --time-limit 30 --mem-gb 2 --cpus-per-task 1 --overwrite",
        "{table} -o {out} --timeout-min 30 --dask {scheduler}",
        "{table} -o {out} --slurm part",
    ],
    "demo": [
        "-o {out} --preset default --scales (0.5,) --reference 39 --device cpu --max-size-px 60 "
        "--overwrite --faces 500 --watertight --stl --obj --no-report --fresh --cache {out}_kept "
        "--texture jpeg --asset-cameras --max-kept 1.5GB --max-memory 20GB "
        "--on-failure skip --view --hold-out 0 --open"
    ],
    "render": [
        "{ball} --out {out} {tiny} --overwrite --seed 3 --path arc --span-deg 20 --fill 0.5 "
        "--elevation-deg 40 --sway-deg 2 --light point --point-light-distance 3 --irradiance 0.5 "
        "--ambient 0.2 --window 0.2 --lamp-colour 0.3 --exposure 1.2 "
        "--read-noise 0.01 --shot-noise 0.01 --supersample 2 --bits 16 "
        "--encoding linear --up y --specular 0.1 --roughness 0.2",
        "{ball} --out {out} {tiny} --albedo 0.6 0.5 0.4 --table patterned --rotation-deg 30",
        "{ball} -o {out} {tiny} --path turntable --fixed-point-light --fixed-room --fixed-table "
        "--pan-jitter-px 2 --crop-jitter-px 1",
        "{ball} -o {out} {tiny} --path turntable --no-fixed-point-light --no-fixed-room "
        "--no-fixed-table --constant-light",
        "{ball} -o {out} {tiny} --no-constant-light --turned-over --table patterned",
        "{ball} -o {out} {tiny} --no-turned-over --lights-per-pose 2",
        "{ball} -o {out} {tiny} --seeds 3:4",
    ],
    "export": [
        "{result} --out {out} --format colmap nerfstudio alicevision maps rti --axes lub "
        "--photos {photos} --overwrite"
    ],
    "evaluate": [
        "{true_mesh} {scene} -o {out}.json --truth-layout rendered --samples 500 --seed 2 --views "
        "view_000 view_001 --thresholds-percent 0.5 1 --seen-from 2 --alignment icp "
        "--trimmed-fraction 0.1",
        "{ball} {dtu} --out {out}.json --truth-layout dtu-mvs --scan 9 --samples 500 "
        "--alignment icp",
        "{result} {scene} --samples 500 --report {out}.html --overwrite",
    ],
    "bench": [
        "--out {out} --scale quick --scenes {scene} --methods smoothed --masks --cameras true "
        "--seed 2 --samples 500 --processes 1 --overwrite --cache {out}_kept",
        "-o {out} --no-masks --scenes {scene} --methods smoothed --cameras true --samples 500",
    ],
    "convert": [
        "{sparse} --out {out} --source colmap --target idr --overwrite --images {photos} "
        "--masks {masks} --mesh {ball} --max-size-px 32 --photographs.response linear "
        "--photographs.saturation 250 --photographs.black 2",
        "{dtu} -o {out} --source dtu-mvs --target transforms --scan 9 --light-seed 1",
    ],
    "config": ["sweep.steps --preset default"],
    "doctor": [
        "{photos} --max-size-px 48 --photographs.response linear --photographs.saturation 250 "
        "--photographs.black 2"
    ],
    "markers": ["--out {out}.pdf --paper letter --side-mm 20 --overwrite"],
    "frames": ["{video} --out {out} --count 3 --overwrite"],
    "view": ["{told} --port 0 --host 127.0.0.1 --photos {photos}"],
    "clean": ["{scene}"],
    "gamma": ["{photos} --mask {masks}/view_000.png --rank 3 --max-size-px 40"],
}
TINY = "--num-views 2 --width 32 --height 24 --processes 1"
# With such small photographs half of the surface is too uncertain to be kept.
PRESET = "scales: [0.5]\nsweep: {min_views: 2, num_views: 4}\nextract: {max_expected_error: 9}\n"


@pytest.fixture(scope="module")
def world(tmp_path_factory, dtu):
    """A ball and its photographs, as written by `pimper render`."""
    folder = tmp_path_factory.mktemp("world")
    write_ball(folder / "ball.ply", level=2)
    (folder / "preset.yaml").write_text(PRESET)
    (folder / "bright.onnx").write_bytes(brightness())
    scene = folder / "scene"
    small = "--num-views 6 --width 64 --height 48 --processes 1 --supersample 1"
    assert main(["render", str(folder / "ball.ply"), "-o", str(scene), *small.split()]) == 0
    true_mesh = pt.read_mesh(scene / "truth" / "mesh.ply")
    told = true_mesh.replace(expected_error=0.01 + 0.01 * true_mesh.vertices_world[:, 2])
    write_ply(told, folder / "told.ply")
    result = folder / "result"
    shutil.copytree(scene / "truth" / "sparse", result / "sparse")
    shutil.copy(scene / "truth" / "mesh.ply", result / "mesh.ply")
    lights = [{"name": f"view_{index:03d}.png", "light": [1, 0, 0, 1]} for index in range(6)]
    (result / "lights.json").write_text(json.dumps({"views": lights}))
    (result / "config.yaml").write_text("photographs: {response: srgb}\n")
    summary = {"photographs": str(scene / "photos"), "stages": [], "seconds": 1.0}
    summary |= {"peak_memory_mb": None, "left_out": [], "failures": []}
    (result / "summary.json").write_text(json.dumps(summary))
    (folder / "list.csv").write_text(
        f"photos,sparse,masks,preset,no-report\n{scene}/photos,{scene}/truth/sparse,{scene}/masks,"
        "preset.yaml,yes\n"
    )
    return {
        "table": folder / "list.csv",
        "result": result,
        "ball": folder / "ball.ply",
        "told": folder / "told.ply",
        "preset": folder / "preset.yaml",
        "network": folder / "bright.onnx",
        "scene": scene,
        "photos": scene / "photos",
        "masks": scene / "masks",
        "sparse": scene / "truth" / "sparse",
        "true_mesh": scene / "truth" / "mesh.ply",
        "dtu": dtu,
        "maps": scene / "truth" / "maps",
        "tiny": TINY,
        "video": written(folder / "clip.mp4"),
    }


@pytest.fixture
def engines(request, monkeypatch, tmp_path):
    """Start engines if a line names one; runs of a batch are stand-ins."""
    line = request.getfixturevalue("line")
    monkeypatch.setattr(task, "_CHILD", CHILD)
    if "{scheduler}" in line:
        from distributed import LocalCluster

        options = {"processes": False, "dashboard_address": None, "protocol": "tcp"}
        with LocalCluster(n_workers=1, threads_per_worker=1, host="127.0.0.1", **options) as one:
            yield {"scheduler": one.scheduler_address}
        return
    if "--slurm" in line:
        write_slurm(tmp_path / "bin")
        monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
        monkeypatch.setenv("PYTHONPATH", children_stand_in(tmp_path))
    yield {}


def run(command, line, world, tmp_path):
    words = line.format(out=tmp_path / "out", **world).split()
    return main([command, *words])


@pytest.mark.parametrize(
    ("command", "line"),
    [(command, line) for command in RUNS if command != "demo" for line in RUNS[command]],
)
@pytest.mark.usefixtures("small_pictures", "ctrl_c")
def test_every_option_of_a_command_runs(command, line, world, engines, tmp_path):
    assert run(command, line, world | engines, tmp_path) == 0


@pytest.mark.slow
def test_a_batch_gives_the_same_bits_as_a_run(world, tmp_path):
    assert main(["batch", str(world["table"]), "-o", str(tmp_path / "all")]) == 0
    alone = "{photos} --out {out} --sparse {sparse} --masks {masks} --preset {preset} --no-report"
    assert run("reconstruct", alone, world, tmp_path) == 0
    for name in ("mesh.ply", "mesh.glb", "depth.npz", "lights.json"):
        (found,) = (tmp_path / "all").glob(f"*/{name}")
        assert found.read_bytes() == (tmp_path / "out" / name).read_bytes()


@pytest.mark.usefixtures("ctrl_c")
def test_every_option_of_the_demo_reaches_the_chain(chain, tmp_path):
    # It uses the chain of `reconstruct`, whose options are tested above; its photographs are large.
    (line,) = RUNS["demo"]
    assert run("demo", line, {}, tmp_path) == 0
    config, views, _ = chain.given
    assert config.coarse_surface.reference == "39"
    assert config.scales == (0.5,)
    assert max(views.images.shape[-2:]) == 60
    kept = tmp_path / "out_kept"
    assert chain.cache == Store(folder=kept, max_bytes=1.5e9, fresh=True)


def test_records_of_stages_are_stored_in_the_result_folder(chain, photos, tmp_path):
    assert main(["reconstruct", str(photos), "-o", str(tmp_path / "out")]) == 0
    assert chain.cache == Store(folder=tmp_path / "out" / ".stages", max_bytes=8e9)


def test_the_reference_reaches_every_stage_that_has_one():
    published = parse("demo", ["--preset", "paper", "--reference", "38"]).config
    assert published.coarse_surface.reference == published.triangulate.reference == "38"


def listed(command, capsys, page="--help-all"):
    """List the options in a command's help, with all their names."""
    with pytest.raises(SystemExit):
        main([command, page])
    lines = re.findall(r"^  (-.*?)(?:  .*)?$", capsys.readouterr().out, flags=re.MULTILINE)
    return {name for line in lines for name in re.findall(r"(?:^|, )(--?[\w.-]+)", line)} - COMMON


COMMON = {"-h", "--help", "--help-all", "-q", "--quiet", "-v", "--verbose", "--json", "--log-level"}


@pytest.mark.parametrize("command", RUNS)
@pytest.mark.parametrize("columns", ["80", "100"])
def test_help_fits_a_page(command, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith(f"usage: pimper {command}")
    assert len(lines) <= 60
    assert all(len(line) <= int(columns) for line in lines)
    assert not any("None" in line or "<" in line for line in lines)


@pytest.mark.parametrize("command", RUNS)
def test_every_option_has_a_test_run(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    names = listed(command, capsys)
    if command in ("reconstruct", "demo"):
        settings = {name for field in leaves(pt.CoarseToFineConfig()) for name in spelt(field)}
        assert settings <= names  # those of the other chain need its presets
        # Settings of stages are tested below; those of the run are ordinary options.
        names -= {name for name in settings if "." in name}
    given = " ".join(RUNS[command]).replace("{tiny}", TINY).replace("-o ", "--out ").split()
    assert names - {"-o"} == {word for word in given if word.startswith("-")}


@dataclasses.dataclass(frozen=True)
class Leaf:
    """A setting: its path in the configuration, its type and its default."""

    path: tuple[str, ...]
    kind: Any
    value: Any


def leaves(config, path=()):
    kinds = get_type_hints(type(config))
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, (*path, field.name))
        else:
            yield Leaf((*path, field.name), kinds[field.name], value)


def spelt(leaf):
    """Return the names of a setting's option."""
    *stages, name = (part.replace("_", "-") for part in leaf.path)
    if leaf.kind is not bool:
        return [f"--{'.'.join([*stages, name])}"]
    return [f"--{'.'.join([*stages, no + name])}" for no in ("", "no-")]


def effects(preset, capsys):
    """Return the help text of each option of a preset, without its default."""
    with pytest.raises(SystemExit):
        main(["reconstruct", "--preset", preset, "--help-all"])
    page = re.split(r"^  (--[^\s,]+)(.*)$", capsys.readouterr().out, flags=re.MULTILINE)
    return {
        name: re.sub(r"\(default:.*", "", beside.partition("  ")[2] + below, flags=re.S)
        for name, beside, below in zip(page[1::3], page[2::3], page[3::3], strict=True)
    }


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_settings_are_80_at_most_and_all_are_documented(preset, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    settings = list(leaves(pt.load_config(preset)))
    assert 30 < len(settings) <= 80
    said = effects(preset, capsys)
    silent = [leaf.path for leaf in settings if len(said[spelt(leaf)[0]].split()) < 3]
    assert not silent


def other_values(leaf):
    """Return valid values of a setting other than its default."""
    kind, value = leaf.kind, leaf.value
    if get_origin(kind) in (UnionType, Union):
        choices = [one for kind in get_args(kind) for one in get_args(kind)]
        yield from (choice for choice in choices if isinstance(choice, str) and choice != value)
        yield 0.9
    elif get_origin(kind) is Literal:
        yield from (choice for choice in get_args(kind) if choice != value)
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, tuple):
        yield from [value[:-1]] if value else []
        yield (*value, 0.5)
        yield (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)
    elif isinstance(value, str):
        yield from ("SIMPLE_PINHOLE", "other", "2GB")
    elif isinstance(value, int):
        yield from (value + 1, value - 1, value + 2)
    else:
        yield from (0.9 * value, 1.1 * value, 0.25, value + 1)


def changed(config, path, value):
    first, *rest = path
    inner = changed(getattr(config, first), rest, value) if rest else value
    return dataclasses.replace(config, **{first: inner})


def words(leaf, value):
    if isinstance(value, bool):
        return [spelt(leaf)[0 if value else 1]]
    text = f"({','.join(map(repr, value))},)" if isinstance(value, tuple) else str(value)
    return [spelt(leaf)[0], text]


@pytest.mark.parametrize("chain", [pt.CoarseToFineConfig, pt.PublishedConfig])
def test_every_setting_of_every_stage_reaches_the_configuration(chain, tmp_path):
    preset = tmp_path / "defaults.yaml"
    preset.write_text(f"chain: {chain().chain}\n")
    left = list(leaves(chain()))
    while left:  # some settings exclude each other: refused ones go into the next line
        config, line, refused = chain(), ["--preset", str(preset)], []
        for leaf in left:
            for value in other_values(leaf):
                try:
                    config = changed(config, leaf.path, value)
                except pt.ConfigError:
                    continue
                line += words(leaf, value)
                break
            else:
                refused.append(leaf)
        assert len(refused) < len(left), f"no other value is allowed: {refused}"
        assert parse("reconstruct", ["photos", "-o", "out", *line]).config == config
        left = refused
