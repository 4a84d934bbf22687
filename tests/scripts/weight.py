"""Count what makes the packages heavier to read, and fail above the bars.

    python tests/scripts/weight.py

The bars only go down: a change that lowers a number lowers its bar to it. Names that a package
defines twice, and constants, cost a reader a search; docstrings begin with Return, Compute, Find
or a noun.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGES = (ROOT / "pimper_torch", ROOT / "bench" / "pimper_bench")

BARS = {
    "docstrings that begin with Give, Tell, Say, Mark, What or How": 0,
    "file names that occur twice or more": 0,
    "public class names that occur twice or more": 0,
    "numeric module constants": 213,
}

_OPENING = re.compile(r'^ *r?"""(?:Give|Tell|Say|Mark|What|How) ', re.MULTILINE)
_CONSTANT = re.compile(r"^_?[A-Z][A-Z0-9_]*(?:: [A-Za-z.]+)? = -?[0-9.]+", re.MULTILINE)


def classes(text: str) -> Iterator[str]:
    """Find the public classes of a module."""
    nodes = ast.parse(text).body
    return (x.name for x in nodes if isinstance(x, ast.ClassDef) and not x.name.startswith("_"))


def measure(packages: Sequence[Path]) -> list[int]:
    """Return the numbers, in the order of the bars."""
    paths = [path for package in packages for path in package.rglob("*.py")]
    texts = {path: path.read_text(encoding="utf-8") for path in paths}
    files = Counter(path.name for path in texts if path.name != "__init__.py")
    names = Counter(name for text in texts.values() for name in classes(text))
    return [
        sum(len(_OPENING.findall(text)) for text in texts.values()),
        sum(count > 1 for count in files.values()),
        sum(count > 1 for count in names.values()),
        sum(len(_CONSTANT.findall(text)) for text in texts.values()),
    ]


def main() -> int:
    """Print every number beside its bar; 1 where one is above it."""
    numbers = measure(PACKAGES)
    for (what, bar), number in zip(BARS.items(), numbers, strict=True):
        sys.stdout.write(f"{number:5d} of {bar:5d} at most: {what}\n")
    return int(any(number > bar for number, bar in zip(numbers, BARS.values(), strict=True)))


if __name__ == "__main__":
    raise SystemExit(main())
