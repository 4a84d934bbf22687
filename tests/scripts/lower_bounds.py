"""Write pip constraints that pin every dependency of the package to its lowest declared version.

    python tests/scripts/lower_bounds.py > constraints.txt

A bound ``>=1.24`` becomes ``==1.24.*``: the newest patch of the lowest release, as patches take
nothing away and wheels of the first one may lack this Python.
"""

import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]


def lowest(requirements: Sequence[str]) -> Iterator[str]:
    """Give a constraint for each requirement that has a lower bound.

    >>> list(lowest(["numpy>=2.0", "torch>=2.13,<2.14", "PyYAML>=6.0.2", "types-PyYAML"]))
    ['numpy==2.0.*', 'torch==2.13.*', 'PyYAML==6.0.2']
    """
    for requirement in requirements:
        bound = re.fullmatch(r"([\w-]+)>=([\d.]+)(?:,.*)?", requirement)
        if bound:
            name, version = bound.groups()
            exact = version if version.count(".") > 1 else f"{version}.*"
            yield f"{name}=={exact}"


def main() -> int:
    """Write the constraints of the package's own dependencies."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        project = tomllib.load(file)["project"]
    sys.stdout.writelines(f"{one}\n" for one in lowest(project["dependencies"]))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
