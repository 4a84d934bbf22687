"""Count the lines of the package and its long functions, and fail above the bars.

    python tests/scripts/weight.py

A change that lowers a number lowers its bar to it; what a feature adds is removed elsewhere.
"""

import ast
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "pimper_torch"

BARS = {"lines of the package": 56_524, "functions of more than 60 lines": 8}


def measure(package: Path) -> dict[str, int]:
    """Return the counts that :data:`BARS` limits."""
    texts = [path.read_text(encoding="utf-8") for path in sorted(package.rglob("*.py"))]
    long = sum(
        (node.end_lineno or node.lineno) - node.lineno >= 60
        for text in texts
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef)
    )
    return dict(zip(BARS, [sum(text.count("\n") for text in texts), long], strict=True))


def main() -> int:
    """Print every count with its bar; return 1 if one is above it."""
    counts = measure(PACKAGE)
    for name, count in counts.items():
        sys.stdout.write(f"{count:6d} of {BARS[name]:6d} at most: {name}\n")
    return int(any(count > BARS[name] for name, count in counts.items()))


if __name__ == "__main__":
    raise SystemExit(main())
