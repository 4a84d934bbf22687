"""Command lines understood without loading torch, so that help and refusals come at once.

Settings stand beside their stages, in modules that load torch, which takes seconds. Their classes
do not need it. Here a function of such a module is made from its source together with what it
refers to, and nothing else of the module: of other modules of the package in the same way, of the
standard library and of a few small packages as it is. What is left, and would take long to load,
is :data:`ABSENT`.
"""

import ast
import sys
import types
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

_PACKAGE = Path(__file__).parents[1]
# Loaded as they are, and so are modules of the standard library.
_SMALL = (
    "tyro",
    "pimper_torch.errors",
    "pimper_torch.config",
    *(f"pimper_torch.cli.{name}" for name in ("light", "arguments", "option", "output")),
)


class _Absent:
    """Stands for whatever would take long to load: all that is done with it gives itself."""

    def __call__(self, *_: object, **__: object) -> "_Absent":
        return self

    def __getattr__(self, name: str) -> "_Absent":
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __getitem__(self, _: object) -> "_Absent":
        return self

    def __contains__(self, _: object) -> bool:
        return True

    def __or__(self, _: object) -> "_Absent":
        return self

    __ror__ = __or__


ABSENT: Any = _Absent()


def light(module: str, name: str) -> Any:  # noqa: ANN401 - whatever the module calls so
    """Make what a module of the package calls ``name``, without loading the module.

    Classes of the package that are made here are not those of the package itself: they serve to
    read a command line, which is read again if it is sound.

    >>> light("pimper_torch.coarse.surface", "CoarseSurfaceConfig")().num_facets
    3000
    """
    source = _source(module)
    if name in source.made.__dict__:
        return source.made.__dict__[name]
    setattr(source.made, name, ABSENT)  # of what refers to itself, until it is made
    statement = source.statements.get(name)
    if statement is not None:
        _make(statement, name, source)
    return source.made.__dict__[name]


class _Source:
    """A module's statements by what they define, and what was made of them so far."""

    def __init__(self, name: str) -> None:
        base = _PACKAGE.parent.joinpath(*name.split("."))
        path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
        # Under another name: were it the package's own, it would be taken for the module.
        self.name = name
        self.made = types.ModuleType(f"{name} (light)")
        # No file of that name: looking for the sources of classes takes longer than all else.
        self.made.__file__ = self.path = f"{path} (light)"
        sys.modules[self.made.__name__] = self.made
        tree = ast.parse(path.read_text(encoding="utf-8"))
        self.statements = {name: each for each in tree.body for name in _defined(each)}


@cache
def _source(module: str) -> _Source:
    return _Source(module)


def _defined(statement: ast.stmt) -> list[str]:
    if isinstance(statement, ast.Import | ast.ImportFrom):
        return [alias.asname or alias.name for alias in statement.names]
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    targets = statement.targets if isinstance(statement, ast.Assign) else []
    targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
    return [
        node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)
    ]


def _make(statement: ast.stmt, name: str, source: _Source) -> None:
    if isinstance(statement, ast.Import | ast.ImportFrom):
        (alias,) = [each for each in statement.names if name in (each.asname, each.name)]
        home = alias.name if isinstance(statement, ast.Import) else str(statement.module)
        setattr(source.made, name, _imported(home, statement, alias.name))
    elif isinstance(statement, ast.FunctionDef):
        # Made when it is called: few are.
        def made_when_called(*given: object, **named: object) -> object:
            _execute(statement, source)
            return getattr(source.made, name)(*given, **named)

        setattr(source.made, name, made_when_called)
    else:
        _execute(statement, source)


def _execute(statement: ast.stmt, source: _Source) -> None:
    """Run a statement in its module, once all that it refers to is there."""
    named = {node.id for node in ast.walk(statement) if isinstance(node, ast.Name)}
    for other in sorted(named & set(source.statements) - set(_defined(statement))):
        light(source.name, other)
    bases = statement.bases if isinstance(statement, ast.ClassDef) else []
    if all(
        isinstance(base, ast.Name) and getattr(source.made, base.id, None) is not ABSENT
        for base in bases
    ):
        exec(compile(ast.Module([statement], []), source.path, "exec"), source.made.__dict__)


def _imported(home: str, statement: ast.stmt, name: str) -> object:
    head = home.partition(".")[0]
    if home in _SMALL or head in _SMALL or head in sys.stdlib_module_names:
        module = import_module(home)
        return module if isinstance(statement, ast.Import) else getattr(module, name)
    if head == "pimper_torch" and isinstance(statement, ast.ImportFrom):
        return light(home, name)
    return ABSENT
