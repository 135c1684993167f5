"""Hook of mkdocs: `<!-- names: processing drivers.camera.Camera -->` becomes a list of names and their descriptions.

A module with `__all__` stands for all its public names.
"""

import inspect
import re
from importlib import import_module


def _resolved(name: str) -> list[str]:
    """Return the full names of the public names of a module, or the name itself."""
    try:
        module = import_module(name)
    except ModuleNotFoundError:
        return [name]
    return [f"{module._PUBLIC[public]}.{public}" for public in module.__all__]


def _summary(name: str) -> str:
    """Return the first line of a class' or function's docstring."""
    module, _, attribute = name.rpartition(".")
    thing = getattr(import_module(module), attribute)
    documented = inspect.isclass(thing) or inspect.isroutine(thing)
    return (inspect.getdoc(thing) or "").splitlines()[0] if documented else ""


def _listed(match: re.Match[str]) -> str:
    names = [full for name in match[1].split() for full in _resolved(name)]
    rows = [f"| [`{name.rpartition('.')[2]}`][{name}] | {_summary(name).replace('|', 'or')} |" for name in names]
    return "\n".join(["| Name | |", "|---|---|", *rows, "", *(f"::: {name}\n" for name in names)])


def on_page_markdown(markdown: str, **_: object) -> str:
    """Replace the marks of a page."""
    return re.sub(r"<!-- names: ([\w. ]+) -->", _listed, markdown)
