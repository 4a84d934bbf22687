"""Each ingredient of the default preset, left out; cameras and masks are true."""

from functools import partial

from bench_runs import run
from declared import Row, Study, Table, bracketed, figure, listed

from pimper_bench.table.bench_inputs import BenchConfig

TRUE = BenchConfig(cameras="true", masks=True)
SIZE = {"num_views": 8, "width": 240, "height": 180}
ROOM = {"ambient": 0.05, "window": 0.4, "irradiance": 0.45}
INGREDIENTS = {
    "`default`": "default",
    "without the sweep": "without-sweep",
    "without normals: only sweep and points": "without-slopes",
    "without points of the cloud": "without-points",
    "without removing the normal bias of facets": "without-normal-bias",
    "without cast shadows": "without-shadows",
    "lights of a patch free": "without-light-prior",
    "least squares instead of the robust loss": "without-robust-loss",
    "the smoothed sparse cloud": "smoothed",
}


STUDY = Study(
    name="ingredients",
    rows={
        ("ingredient", told): Row(
            measure=partial(run, name="potatoes", method=method, given=TRUE, keep=True, **SIZE)
        )
        for told, method in INGREDIENTS.items()
    }
    | {
        ("room", told): Row(
            measure=partial(
                run, name="potatoes", method=method, given=TRUE, keep=True, **SIZE, **ROOM
            )
        )
        for told, method in {
            "`default`": "default",
            "without the room's light": "without-room-light",
        }.items()
    },
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
            ),
            part="ingredient",
        ),
        Table(
            name="room",
            document="benchmarks/README.md",
            lines=listed(
                ["settings"],
                [
                    bracketed("accuracy, % (median)", "accuracy", "accuracy, median", 3),
                    bracketed("normals, mean (median) °", "normals", "normals, median"),
                    bracketed("albedo, % (median)", "albedo", "albedo, median", 1),
                ],
            ),
            part="room",
        ),
    ],
)
