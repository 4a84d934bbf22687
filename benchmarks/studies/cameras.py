"""What estimated cameras cost: true ones, those of `default`, and those of features alone."""

from functools import partial

from bench_runs import run
from declared import Row, Study, Table, bracketed, figure, listed

from pimper_bench.table.bench_inputs import BenchConfig

SIZE = {"num_views": 20, "width": 320, "height": 240}
CAMERAS = ("true", "found", "features")

STUDY = Study(
    name="cameras",
    rows={
        (cameras,): Row(
            measure=partial(
                run, name="potatoes", given=BenchConfig(cameras=cameras, masks=True), **SIZE
            )
        )
        for cameras in CAMERAS
    },
    tables=[
        Table(
            name="cameras",
            document="benchmarks/README.md",
            lines=listed(
                ["cameras"],
                [
                    figure("places, %", "places", 3),
                    figure("bend, %", "bend", 4),
                    figure("focal length, %", "focal"),
                    bracketed("normals, mean (median) °", "normals", "normals, median"),
                    figure("accuracy, %", "accuracy", 3),
                    figure("Chamfer, %", "Chamfer", 3),
                ],
            ),
        )
    ],
)
