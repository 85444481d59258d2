"""What programs may import: nothing new, only other names for what they have.

In: an import statement. Out: the names that it binds, or a ``Refusal`` that says what to write instead. NumPy, ``math``
and ``copy`` stand for the tables of ``voxposer.sandbox.vocabulary``. The modules of VoxPoser's prompts stand for the
functions that the program is given; importing one of their names changes nothing, and calling one that is not given is
refused where it is called.
"""

from __future__ import annotations

import ast
import difflib
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from voxposer.sandbox import vocabulary
from voxposer.sandbox.guard import Refusal
from voxposer.sandbox.objects import Function, Module, TypeName
from voxposer.sandbox.values import DTYPES

# Modules of VoxPoser's prompts and source, and of the library that its prompts import.
GIVEN = frozenset(
    {
        *("env_utils", "perception_utils", "plan_utils", "action_utils", "utils", "interfaces", "LMP"),
        *("transforms3d", "transforms3d.euler", "transforms3d.quaternions"),
    }
)
# Modules that say something about types only, or about the language.
_IGNORED = frozenset({"typing", "typing_extensions", "collections.abc", "numpy.typing", "__future__"})
_TABLES: Mapping[str, Mapping[str, Callable[..., Any]]] = {
    "numpy": vocabulary.NUMPY,
    "math": vocabulary.MATH,
    "copy": vocabulary.COPY,
}
_CONSTANTS: Mapping[str, Mapping[str, Any]] = {"numpy": vocabulary.CONSTANTS, "math": vocabulary.CONSTANTS, "copy": {}}
_INSTEAD: Mapping[str, str] = {
    "time": "programs do not see the time",
    "datetime": "programs do not see the time",
    "random": "programs give the same result each time; choose by position or order",
    "scipy": "write with np and set_voxel_by_radius",
    "itertools": "write loops or comprehensions",
    "functools": "write a def or a loop",
    "collections": "write lists and dictionaries",
    "re": "write with methods of text, such as split and startswith",
    "json": "write Python's lists and dictionaries",
    "torch": "write with np",
}
# Names without an import: models often leave it out.
BUILT_IN: Mapping[str, Module] = {"np": Module("numpy"), "numpy": Module("numpy"), "math": Module("math")}


def imported(node: ast.Import | ast.ImportFrom, given: Mapping[str, Function]) -> dict[str, Any]:
    """The names that an import statement binds, with what they stand for."""
    if isinstance(node, ast.Import):
        return {name: value for alias in node.names for name, value in _whole(alias).items()}
    if node.level:
        raise Refusal("imports", "a relative import; the given functions are there without it")
    return {name: value for alias in node.names for name, value in _part(node.module or "", alias, given).items()}


def _whole(alias: ast.alias) -> dict[str, Any]:
    if alias.name in _IGNORED:
        return {}
    root = alias.name.split(".")[0]
    if alias.name in GIVEN:
        return {alias.asname or root: Module(f"given.{alias.name}" if alias.asname else f"given.{root}")}
    if alias.name in _TABLES:
        return {alias.asname or alias.name: Module(alias.name)}
    if alias.name == "numpy.linalg":
        return {alias.asname: Module("numpy.linalg")} if alias.asname else {"numpy": Module("numpy")}
    raise _refused(alias.name)


def _part(module: str, alias: ast.alias, given: Mapping[str, Function]) -> dict[str, Any]:
    if alias.name == "*":
        raise Refusal("imports", f"from {module} import *; np and the given functions are there without it")
    if module in _IGNORED:
        return {}
    name = alias.asname or alias.name
    if module in GIVEN:
        if alias.name in given:
            return {name: given[alias.name]} if alias.asname else {}
        if alias.asname:
            raise Refusal(
                "imports", f"{alias.name!r} of {module} is not given to this program, so it has no other name"
            )
        return {}
    if module in _TABLES or module == "numpy.linalg":
        return {name: member(Module(module), alias.name)}
    raise _refused(module)


def _refused(module: str) -> Refusal:
    instead = _INSTEAD.get(module.split(".")[0], "np, math and the given functions are there without an import")
    return Refusal("imports", f"{module!r} cannot be imported: {instead}")


def member(module: Module, name: str, given: Mapping[str, Function] | None = None) -> Any:
    """What ``module.name`` stands for: a function, a number, a type or a module.

    Raises:
        Refusal: the module has no such name, or programs may not use it.
    """
    root, _, inside = module.name.partition(".")
    if root == "given":
        return _given_member(module, name, given or {})
    dotted = f"{inside}.{name}" if inside else name
    if dotted in _CONSTANTS[root]:
        return _CONSTANTS[root][dotted]
    if root == "numpy":
        if dotted == "linalg":
            return Module("numpy.linalg")
        if f"np.{dotted}" in DTYPES:
            return DTYPES[f"np.{dotted}"]
        if dotted in _TYPE_NAMES:
            return TypeName(f"np.{dotted}")
        if dotted in ("mgrid", "ogrid"):
            return Module(f"numpy.{dotted}")
        if dotted.startswith("random"):
            raise Refusal("names", "np.random is not there: programs give the same result each time")
    if dotted in _TABLES[root]:
        return _TABLES[root][dotted]
    near = similar(dotted, _TABLES[root])
    short = "np" if root == "numpy" else root
    hint = f"; did you mean {short}.{near}?" if near else ""
    raise Refusal("names", f"{short}.{dotted[:60]} is not among the functions of {root} that are allowed{hint}")


def similar(name: str, known: Iterable[str]) -> str:
    """The one of the known names that is most similar to a name, "" for none; long names and many are not compared."""
    if len(name) > _COMPARED:
        return ""
    short = itertools.islice((each for each in known if len(each) <= _COMPARED), _NAMES)
    return next(iter(difflib.get_close_matches(name, short, n=1)), "")


# Characters of names, and names, that are compared to find a similar one.
_COMPARED, _NAMES = 40, 300
_TYPE_NAMES = ("ndarray", "integer", "floating", "number", "generic")


def _given_member(module: Module, name: str, given: Mapping[str, Function]) -> Any:
    deeper = f"{module.name}.{name}"
    if deeper.removeprefix("given.") in GIVEN:
        return Module(deeper)
    if name in given:
        return given[name]
    raise Refusal("names", f"{name!r} is not among the functions that this program is given")
