"""Count what makes the package heavier to read, and fail above the bars.

    python tests/scripts/weight.py

Counting uses the syntax tree, so formatting hides nothing. The bars only go down: a change that
lowers a number lowers its bar to it, and a feature's additional lines are removed elsewhere.
Paths that documents name are checked by ``test_shown.py``.
"""

import ast
import re
import sys
import tokenize
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "pimper_torch"
# The changelog keeps the words of its time.
DOCUMENTS = sorted(
    {*(ROOT / "docs").glob("*.md"), *ROOT.glob("*/README.md"), *ROOT.glob("*.md")}
    - {ROOT / "CHANGELOG.md"}
)

# Words by which prose reads as translated; most sentences have a plainer one (is given by, in
# front of, next to, around, different, is not).
WORDS = re.compile(
    r"\b(what|tells?|told|telling|stands?|stood|standing|lies?|lying|(is|are) (no|none)|another"
    r"|beside|before (an?|the)|round (an?|the|it)|so many)\b",
    flags=re.IGNORECASE,
)

# Lines of the layers and subpackages; modules at the top level are ".".
LINES = {
    ".": 74,
    "cli": 2162,
    "cli/batches": 939,
    "cli/doctor": 518,
    "cli/video": 198,
    "doors": 1,
    "doors/camera_files": 926,
    "doors/export": 983,
    "doors/io": 3127,
    "doors/result_folder": 510,
    "doors/scale": 970,
    "ground": 44,
    "ground/geometry": 3361,
    "ground/kernels": 5129,
    "ground/linalg": 1277,
    "ground/radiometry": 469,
    "method": 1,
    "method/chains": 1013,
    "method/coarse": 2474,
    "method/fusion": 2531,
    "method/meshing": 797,
    "method/patches": 905,
    "method/photometry": 4059,
    "method/sfm": 4465,
    "method/silhouettes": 2038,
    "method/sweep": 661,
    "published": 1188,
    "priors": 976,
    "priors/prior_files": 508,
    "records": 2338,
    "result": 1,
    "result/asset": 1036,
    "result/relighting": 773,
    "result/report": 424,
    "result/viewer": 554,
    "result/viz": 986,
    "runtime": 2108,
    "runtime/store": 312,
    "single_view": 6,
    "single_view/cli": 80,
    "single_view/factorization": 842,
    "single_view/integration": 618,
    "single_view/photometric_stereo": 1007,
    "stages": 45,
}

# Numbers of module constants, in tuples and mappings, too; lines of signatures and of imports.
BARS = {
    "numbers in module constants": 961,
    "lines of signatures": 4570,
    "lines of imports": 4258,
    "words of the list in docstrings, comments and messages": 88,
    "words of the list in documents": 48,
}


def numbers(tree: ast.Module) -> int:
    """Count the numbers in the constants of a module, however they are composed."""
    return sum(
        isinstance(inner, ast.Constant) and type(inner.value) in (int, float)
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign) and _is_constant(node)
        for inner in ast.walk(node)
    )


def _is_constant(node: ast.Assign | ast.AnnAssign) -> bool:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
    return bool(names) and all(name.strip("_").isupper() for name in names)


def signature_lines(tree: ast.Module) -> int:
    """Count the lines from ``def`` to the colon, of all functions."""
    return sum(
        max(1, node.body[0].lineno - node.lineno)
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
    )


def import_lines(tree: ast.Module) -> int:
    """Count the lines of imports."""
    return sum(
        (node.end_lineno or node.lineno) - node.lineno + 1
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
    )


def words(path: Path) -> int:
    """Count the words of the list in the strings and comments of a module, or in a document."""
    if path.suffix != ".py":
        return len(WORDS.findall(path.read_text(encoding="utf-8")))
    with path.open("rb") as file:
        kept = [one.string for one in tokenize.tokenize(file.readline) if one.type in _PROSE]
    return len(WORDS.findall("\n".join(kept)))


_PROSE = (tokenize.COMMENT, tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING))


def measure(package: Path) -> tuple[dict[str, int], dict[str, int]]:
    """Return lines by folder, and the counts that :data:`BARS` limits."""
    lines: dict[str, int] = {}
    trees = []
    for path in sorted(package.rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        folder = "/".join(path.relative_to(package).parts[:-1][:2]) or "."
        lines[folder] = lines.get(folder, 0) + text.count("\n")
        trees.append(ast.parse(text))
    counts = [sum(map(count, trees)) for count in (numbers, signature_lines, import_lines)]
    counts += [sum(map(words, files)) for files in (sorted(package.rglob("*.py")), DOCUMENTS)]
    return lines, dict(zip(BARS, counts, strict=True))


def over(found: Mapping[str, int], bars: Mapping[str, int]) -> Iterator[str]:
    """Print every count with its bar, and yield those above it."""
    for name, number in found.items():
        bar = bars.get(name, 0)
        sys.stdout.write(f"{number:6d} of {bar:6d} at most: {name}\n")
        if number > bar:
            yield name


def main() -> int:
    """Print every count with its bar; return 1 if one is above it."""
    lines, counts = measure(PACKAGE)
    heavy = [*over(lines, LINES), *over(counts, BARS)]
    sys.stdout.write(f"{sum(lines.values()):6d} lines of the package\n")
    return int(bool(heavy))


if __name__ == "__main__":
    raise SystemExit(main())
