"""Which modules the reference shows: all that a package has, in the order of their names."""

from __future__ import annotations

import ast
from pathlib import Path


def modules_list(root: Path, package: str) -> str:
    """Directives of mkdocstrings for a package and its modules, those of subpackages included."""
    return "\n\n".join(_directive(root, name) for name in module_names(root, package))


def _directive(root: Path, name: str) -> str:
    """A module with all it has; of a package only what is not shown with the module it comes from."""
    init = root / name.replace(".", "/") / "__init__.py"
    if not init.is_file():
        return f"::: {name}"
    return f"::: {name}\n    options:\n      members: [{', '.join(_own_names(init))}]"


def _own_names(file: Path) -> list[str]:
    """Public names that a file itself defines."""
    names = []
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            names.append(node.name)
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names += [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
    return [name for name in names if not name.startswith("_")]


def module_names(root: Path, package: str) -> list[str]:
    """Names of a package's modules, the package itself first; ``__main__`` is left out."""
    folder = root / package.replace(".", "/")
    files = [path for path in folder.rglob("*.py") if path.stem != "__main__"]
    parts = [path.relative_to(root).with_suffix("").parts for path in files]
    return sorted(".".join(each[:-1] if each[-1] == "__init__" else each) for each in parts)
