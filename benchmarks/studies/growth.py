"""How the cost of a whole run grows with the number of photographs and their size."""

import shutil
from functools import partial

from declared import Figures, Place, Row, Study, Table, figure, listed
from fleet import reconstructed
from fleet_captures import MESHES, model

from pimper_torch.cli.doctor.cost import estimate

SIZES = ((800, 600), (1600, 1200))
COUNTS = (10, 30)


def measure(place: Place, count: int, width: int, height: int) -> Figures:
    """Run the command line on every third photograph of an armadillo, or on all."""
    scene, _ = model("armadillo", MESHES, place.cache / "shapes")
    size = {"num_views": 30, "width": width, "height": height}
    folder = place.scene(scene, specular=0.3, table="patterned", **size)
    taken = place.cache / "growth" / f"{folder.name}-{count}"
    (taken / "photos").mkdir(parents=True, exist_ok=True)
    for path in sorted((folder / "photos").iterdir())[:: 30 // count]:
        shutil.copy(path, taken / "photos")
    row = reconstructed(taken, taken / "result", "default")
    _, gigabytes = estimate(count * width * height / 1e6, count)
    return {name: row[name] for name in ("CPU s", "GB", "vertices")} | {"GB estimated": gigabytes}


STUDY = Study(
    name="growth",
    rows={
        (str(count), f"{width}x{height}"): Row(
            measure=partial(measure, count=count, width=width, height=height)
        )
        for width, height in SIZES
        for count in COUNTS
    },
    tables=[
        Table(
            name="growth",
            document="benchmarks/README.md",
            labels=2,
            lines=listed(
                ["photographs", "size"],
                [
                    figure("vertices", "vertices", 0),
                    figure("CPU s", "CPU s", 0),
                    figure("GB", "GB", 1),
                    figure("GB, estimated", "GB estimated", 1),
                ],
            ),
        )
    ],
)
