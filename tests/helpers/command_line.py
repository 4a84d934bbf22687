"""The command line in this process, and the files it writes."""

from scenes import write_ball

from pimper_torch.cli.main import main


def run(*arguments):
    """Run a command; return its exit code."""
    return main([str(argument) for argument in arguments])


def contents(folder):
    """Return the bytes of all files with a suffix."""
    return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*.*")}


def small_run(folder, preset):
    """Render a small ball into a folder; return the arguments of a run on it with true cameras."""
    write_ball(folder / "ball.ply", level=2)
    (folder / "preset.yaml").write_text(preset)
    scene, small = folder / "scene", "--num-views 5 --width 64 --height 48 --processes 1"
    drawn = [folder / "ball.ply", "-o", scene, *small.split(), "--supersample", 1]
    assert run("render", *drawn) == 0
    given = ["--sparse", scene / "truth" / "sparse", "--masks", scene / "masks"]
    given += ["--mesh", scene / "truth" / "mesh.ply", "--preset", folder / "preset.yaml"]
    return ["reconstruct", *map(str, [scene / "photos", *given])]
