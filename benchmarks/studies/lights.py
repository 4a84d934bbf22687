"""Lights that the method is not made for: one for all photographs, several from one place."""

from functools import partial

from bench_runs import run
from declared import Row, Study, Table, bracketed, figure, listed

WALK = {"path": "handheld", "num_views": 20, "width": 400, "height": 300, "ambient": 0.3}
PLACES = {"num_views": 36, "width": 240, "height": 180, "span_deg": 80.0}
SETS = {
    ("one", "potatoes", "one"): ("potatoes", WALK | {"constant_light": True}),
    ("one", "potatoes", "another in each photograph"): ("potatoes", WALK),
    ("one", "jar, hardly any texture", "one"): ("jar", WALK | {"constant_light": True}),
    ("one", "jar, hardly any texture", "another in each photograph"): ("jar", WALK),
    ("several", "36 places, a light each"): ("potatoes", PLACES),
    ("several", "6 places, 6 lights each"): ("potatoes", PLACES | {"lights_per_pose": 6}),
}
NORMALS = bracketed("normals, ° (median)", "normals", "normals, median")

STUDY = Study(
    name="lights",
    rows={
        key: Row(measure=partial(run, name=scene, **settings))
        for key, (scene, settings) in SETS.items()
    },
    tables=[
        Table(
            name="one-light",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["scene", "light"],
                [
                    bracketed("accuracy, % (median)", "accuracy", "accuracy, median", 3),
                    figure("completeness seen, %", "completeness", 3),
                    figure("3D error, %", "3D error"),
                    NORMALS,
                    figure("true over expected error", "ratio", 1),
                ],
                first="one",
            ),
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
                first="several",
            ),
        ),
    ],
)
