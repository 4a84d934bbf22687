"""Each ingredient of the default preset, left out; cameras and masks are true."""

from functools import partial

from bench_runs import run
from declared import Row, Study, Table, bracketed, figure, listed

from pimper_bench.table.bench_inputs import BenchConfig

TRUE = BenchConfig(cameras="true", masks=True)
SIZE = {"num_views": 12, "width": 320, "height": 240}
ROOM = {"ambient": 0.05, "window": 0.4, "irradiance": 0.45}
INGREDIENTS = {
    "`default`": "default",
    "without the sweep": "without-sweep",
    "without normals: only sweep and points": "without-slopes",
    "without points of the cloud": "without-points",
    "without removing the normal bias of facets": "without-normal-bias",
    "without cast shadows": "without-shadows",
    "lights of a patch free": "without-light-prior",
    "only the light field, no lights per patch": "without-patch-lights",
    "least squares instead of the robust loss": "without-robust-loss",
    "one pass, at full size": "without-rounds",
    "the smoothed sparse cloud": "smoothed",
}
LIGHTS = {
    "a room with a window": ("potatoes", ROOM, "without-room-light"),
    "lamps of different colours": ("jar", {"lamp_colour": 0.4}, "without-light-colours"),
}


def light_rows() -> dict[tuple[str, ...], Row]:
    """Return the rows of rooms and of lamps, with their models and without."""
    rows = {}
    for told, (scene, light, without) in LIGHTS.items():
        for method in ("default", without):
            settings = "`default`" if method == "default" else method.replace("-", " ")
            measure = partial(run, name=scene, method=method, given=TRUE, **SIZE, **light)
            rows["light", f"{scene}, {told}", settings] = Row(measure=measure)
    return rows


STUDY = Study(
    name="ingredients",
    rows={
        ("ingredient", told): Row(
            measure=partial(run, name="potatoes", method=method, given=TRUE, **SIZE)
        )
        for told, method in INGREDIENTS.items()
    }
    | light_rows(),
    tables=[
        Table(
            name="ingredients",
            document="benchmarks/README.md",
            lines=listed(
                [""],
                [
                    figure("covered, %", "covered", 1),
                    figure("3D error, %", "3D error"),
                    bracketed("normals, mean (median) °", "normals", "normals, median"),
                    figure("accuracy, %", "accuracy", 3),
                    figure("Chamfer, %", "Chamfer", 3),
                ],
                first="ingredient",
            ),
        ),
        Table(
            name="light-models",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["scene", "settings"],
                [
                    bracketed("accuracy, % (median)", "accuracy", "accuracy, median", 3),
                    bracketed("normals, mean (median) °", "normals", "normals, median"),
                    bracketed("albedo, % (median)", "albedo", "albedo, median", 1),
                ],
                first="light",
            ),
        ),
    ],
)
