"""Nouns of public class names are terms of the glossary, and each term stands there once."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
GLOSSARY = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
REFERENCE = " ".join(path.read_text() for path in (ROOT / "docs" / "api").rglob("*.rst"))


def singular(word: str) -> str:
    return re.sub(r"(?<=[hx])es$|(?<=[^su])s$", "", word.lower())


def terms() -> list[str]:
    """Bold headings of entries, and first cells of the table; several are separated by commas."""
    cells = re.findall(r"^\*\*(.+?)\.\*\*|^\| ([^|]+?) \|", GLOSSARY, flags=re.MULTILINE)
    return [term for cell in cells for term in "".join(cell).split(", ") if term not in ("Term",)]


def public_classes() -> set[str]:
    """Classes of the modules that the Python reference documents."""
    modules = set(re.findall(r"automodule:: (pimper_torch\.\S+)", REFERENCE))
    found = set()
    for module in modules:
        path = ROOT / Path(*module.split("."))
        file = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        body = ast.parse(file.read_text(encoding="utf-8")).body
        found |= {node.name for node in body if isinstance(node, ast.ClassDef)}
    assert len(found) > 150
    return {name for name in found if not name.startswith("_")}


def noun(name: str) -> str:
    """Return the last word of a class name."""
    return re.findall(r"Mc[A-Z][a-z]+$|[A-Z]?[a-z]+$", name)[-1]


def test_the_noun_of_every_public_class_is_in_the_glossary():
    known = {singular(word) for term in terms() for word in re.split(r"[ -]", term)}
    stages = re.search(r"^\*\*Stage, chain\..+", GLOSSARY, flags=re.MULTILINE)
    known |= {word.lower() for word in re.findall(r"`(\w+)\b", stages[0])}
    names = public_classes()
    strange = sorted(n for n in names if not {singular(noun(n)), n.lower()} & known)
    assert strange == []


def test_every_term_is_explained_once():
    twice = [term for term, count in Counter(map(str.lower, terms())).items() if count > 1]
    assert twice == []
