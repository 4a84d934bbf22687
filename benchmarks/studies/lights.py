"""Lights that the method is not made for: one for all photographs, several from one place."""

from functools import partial

from bench_runs import run
from declared import Row, Study, Table, bracketed, figure, listed

WALK = {"path": "handheld", "num_views": 24, "width": 320, "height": 240, "ambient": 0.3}
PLACES = {"num_views": 24, "width": 240, "height": 180, "span_deg": 80.0}
SETS = {
    ("one", "one"): WALK | {"constant_light": True},
    ("one", "another in each photograph"): WALK,
    ("several", "24 places, a light each"): PLACES,
    ("several", "6 places, 4 lights each"): PLACES | {"lights_per_pose": 4},
}
NORMALS = bracketed("normals, ° (median)", "normals", "normals, median")

STUDY = Study(
    name="lights",
    rows={
        key: Row(measure=partial(run, name="potatoes", **settings))
        for key, settings in SETS.items()
    },
    tables=[
        Table(
            name="one-light",
            document="benchmarks/README.md",
            lines=listed(
                ["light"],
                [
                    bracketed("accuracy, % (median)", "accuracy", "accuracy, median", 3),
                    figure("completeness seen, %", "completeness", 3),
                    figure("3D error, %", "3D error"),
                    NORMALS,
                    figure("true over expected error", "ratio", 1),
                ],
            ),
            part="one",
        ),
        Table(
            name="several-lights",
            document="benchmarks/README.md",
            lines=listed(
                [""],
                [
                    figure("accuracy, %", "accuracy", 3),
                    figure("completeness seen, %", "completeness", 3),
                    NORMALS,
                    figure("albedo, %", "albedo", 1),
                    figure("lights, °", "lights", 1),
                    figure("CPU s", "CPU s", 0),
                ],
            ),
            part="several",
        ),
    ],
)
