"""Commands, options, settings, names, files and extras in documents exist."""

import functools
import re
import tomllib
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import followed
import pytest
import understood
import yaml
from shown import Shown, commands_in, in_markdown, roles_in, shown_in

import pimper_bench
import pimper_torch
from pimper_torch.runtime.errors import PimperError
from pimper_torch.runtime.ledger import GUARDS

PACKAGE, BENCH = (Path(package.__file__).parent for package in (pimper_torch, pimper_bench))
PACKAGES = {package.name: package for package in (PACKAGE, BENCH)}
ROOT = Path(__file__).parents[1]
DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted((ROOT / "docs").glob("*.md")),
    *sorted((ROOT / "docs").rglob("*.rst")),
    ROOT / "benchmarks" / "README.md",
    *sorted((ROOT / "notebooks").glob("*.ipynb")),
]
CODE = re.compile(r"`(?:--|pip|pimper |pt\.|\w+[./(]|--)|:\w+:`|>>>")
FILES = [path for package in PACKAGES.values() for path in sorted(package.rglob("*.py"))]
SOURCES = [path for path in FILES if CODE.search(path.read_text("utf-8"))]


def named(path: Path) -> str:
    inside = path.is_relative_to(PACKAGE)  # may be installed in a different place
    return path.relative_to(PACKAGE.parent if inside else ROOT).as_posix()


REFUSALS = (AssertionError, PimperError, AttributeError, TypeError, ImportError, SyntaxError)


# -- one check for each kind of inline code; the first whose form matches is used -----------------
def extras(text: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    offered = {*project["project"]["optional-dependencies"], *project["dependency-groups"], "…"}
    asked = re.findall(r"\[([\w,…]+)\]|--group (\w+)", text)
    for name in (name for pair in asked for one in pair for name in one.split(",") if name):
        assert name in offered, f"there is no extra {name}"


def dotted(text: str) -> None:
    """Check a setting, a guard, or a name in a module, absolute or relative to a package."""
    if text in understood.settings() or text in GUARDS:
        return
    first, *rest = path = text.split(".")
    if first in PACKAGES:
        assert is_defined(rest, PACKAGES[first]), f"there is no {text}"
    elif first in {one.name for one in PACKAGE.iterdir()}:
        assert is_defined(path), f"there is no {text}"
    else:
        sections = {name for name in understood.settings() if "." not in name}
        assert path[0] not in sections, f"there is no setting {text}"


def is_defined(path: list[str], package: Path = PACKAGE) -> bool:
    """Return whether dotted names lead to a module or a definition in one."""
    place, rest = package, [*path]
    while rest and (place / rest[0]).is_dir():
        place /= rest.pop(0)
    file = place / f"{rest[0]}.py" if rest else place
    if not rest or (len(rest) == 1 and file.is_file()):
        return True
    if file.is_file():
        return rest[-1] in words_of(file)
    files = [place / "__init__.py"] if len(rest) == 1 else [*place.glob("*.py")]
    return any(rest[-1] in words_of(file) for file in files)


@functools.cache
def words_of(file: Path) -> set[str]:
    """Return names that a module binds; faster than an import."""
    text = file.read_text(encoding="utf-8")
    stub = file.with_suffix(".pyi")
    text += stub.read_text(encoding="utf-8") if stub.exists() else ""
    bound = re.findall(r"^ *(?:def |class )?(\w+)(?=[:(])|^([\w, ]+) = ", text, flags=re.MULTILINE)
    imported = re.findall(r"import \(?([\w, \n]+)", text)
    names = (*(name for pair in bound for name in pair), *imported)
    return {word for line in names for word in re.findall(r"\w+", line)}


def role(name: str) -> None:
    """Check a full name, or one of the module or of any package."""
    first, *rest = name.split(".")
    if first in PACKAGES:
        assert is_defined(rest, PACKAGES[first]), f"{name} leads nowhere"
    elif not {*filter(None, (first, *rest))} <= words_of_packages():
        of_others = bool(first and rest and find_spec(first))
        assert of_others, f"{name} leads nowhere"


@functools.cache
def words_of_packages() -> set[str]:
    return {path.stem for path in FILES}.union(*map(words_of, FILES))


def file(text: str) -> None:
    roots = (ROOT, PACKAGE, BENCH)
    if not any((root / text.split("/")[0]).exists() for root in roots) and "/" in text:
        return  # of a different project
    ends = [f"/{named(one)}" for one in every_file()]
    assert any(end.endswith(f"/{text.lstrip('./')}") for end in ends), f"there is no file {text}"


@functools.cache
def every_file() -> list[Path]:
    kept = ("benchmarks", "configs", "docs", "notebooks", "pimper_torch", "tests", ".ci")
    return [path for folder in kept for path in (ROOT / folder).rglob("*.*")]


@functools.cache
def options_of_benchmarks() -> set[str]:
    scripts = (ROOT / "benchmarks" / "studies").glob("*.py")
    return {x for path in scripts for x in re.findall(r'"(--[a-z-]+)"', path.read_text("utf-8"))}


def python(text: str) -> None:
    """Check an expression, or the first line of a loop."""
    followed.follow(text if not text.startswith("for ") else f"{text}: ...")


ENDINGS = (
    "bmp|cfg|csv|glb|html|json|jsonl|lp|mtl|npy|npz|obj|pdf|ply|png|py|sfm|stl|txt|webp|xml|yaml"
)
VARIABLES = "|".join(followed.VARIABLES)
SENTENCES: list[tuple[str, Callable[[str], None]]] = [
    (r"pimper [a-z]", functools.partial(understood.command_line, whole=False)),
    (r"--[a-z][\w-]* (?:is|needs) ", lambda message: understood.option(message.split()[0])),
    (r"(-- )?--[a-z]", understood.option),
    (r"pip install ", extras),
    (r"[\w./-]+/[\w.-]+\.(?:py|yaml|sh|ipynb)$|test_\w+\.py$", file),
    (rf"(?:for .*|\w+ = )?(?:{VARIABLES})[.(]|[A-Z][a-z]\w+\(.*\)$", python),
    (rf"(?!.*\.(?:{ENDINGS})$)[a-z_]\w*(\.[a-z_]\w*)+$", dotted),
]


def check_of(piece: Shown, document: str = "") -> Callable[[str], None] | None:
    if piece.language is not None:
        return None if piece.language.startswith("{") else BLOCKS[piece.language]
    if document.startswith("benchmarks/") and piece.text.split()[0] in options_of_benchmarks():
        return None
    return next((check for form, check in SENTENCES if re.match(form, piece.text)), None)


# -- blocks, by their language ---------------------------------------------------------------------
def console(block: str) -> None:
    for _, command in commands_in(block):
        if command.startswith("pimper "):
            understood.command_line(command)
        elif "pip install" in command:
            extras(command)


# Sphinx directives have braces.
BLOCKS: dict[str, Callable[[str], None]] = {
    "python": followed.follow,
    "yaml": lambda block: understood.setting(yaml.safe_load(block)),
    "": console,
    "text": lambda _: None,
}


def pieces() -> Iterator[Any]:
    """Yield the code in documents, each text once per document."""
    for path in DOCUMENTS:
        once = {piece.text: piece for piece in reversed([*shown_in(path)])}
        for piece in reversed(once.values()):
            check = check_of(piece, named(path))
            if check:
                first = piece.text.strip().split("\n")[0]
                yield pytest.param(piece, check, id=f"{named(path)}:{piece.line} {first}")


@pytest.mark.parametrize(("piece", "check"), [*pieces()])
def test_code_in_documents_exists(piece, check, monkeypatch):
    monkeypatch.chdir(ROOT)
    check(piece.text)


@pytest.mark.parametrize("path", SOURCES, ids=named)
def test_code_in_docstrings_and_messages_exists(path, monkeypatch):
    monkeypatch.chdir(ROOT)
    wrong = []
    for piece in shown_in(path):
        check = check_of(piece)
        try:
            if check:
                check(piece.text)
        except REFUSALS as error:
            wrong.append(f"{named(path)}:{piece.line}: {piece.text}: {error}")
    for line, name in roles_in(path.read_text(encoding="utf-8")):
        try:
            role(name)
        except AssertionError as error:
            wrong.append(f"{named(path)}:{line}: {error}")
    assert wrong == []


@pytest.mark.parametrize(
    "text",
    [
        "`pimper reconstruct photos/ -o out/ --sweep.window 7`",
        "`pimper reconstruct --sweep.step`",
        "`pimper rekonstruct photos/`",
        "`pimper batch scans/ -- --presett fast`",
        "    pip install . && pimper demo --no-such-option",
        "    pimper reconstruct photos/ \\\n        --max-size-px many -o out/",
        "    pimper reconstruct photos/",
        "`--max-size 800`",
        "`--sweep.window`",
        "`--preset nothing`",
        '`pip install ".[gpu]"`',
        "`sweep.window`",
        "`pimper_torch.stages.photometry.nothing`",
        "`stages/sfm/binding.py`",
        "`pt.load_view`",
        '`pt.load_views("photos/", max_size=800)`',
        '`pt.load_chain("default", {"sweep": {"window": 7}})`',
        '`pt.load_chain("default", factorise=mine)`',
        '`pt.load_chain("default")(views).mesh.normals`',
        "`Factorize(prior=[])`",
        "`chain.stepps(views)`",
        "```yaml\nsweep:\n  window: 7\n```",
        "```python\nfrom pimper_torch.stages.sweep import Swoop\n```",
        "```python\nimport pimper_torch as p\nviews = p.load_views('a')\nviews.imagez\n```",
    ],
)
def test_code_that_does_not_exist_is_refused(text, monkeypatch):
    monkeypatch.chdir(ROOT)
    (piece,) = in_markdown(text)
    check = check_of(piece)
    assert check is not None
    with pytest.raises(REFUSALS):
        check(piece.text)
