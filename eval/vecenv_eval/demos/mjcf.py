"""Where fixtures stand in an MJCF that upstream saved with a demonstration.

The text comes from an untrusted file: it is scanned without expanding entities, and no model is compiled from it.
"""

from __future__ import annotations

import xml.parsers.expat
from collections.abc import Collection, Mapping

import numpy as np

from vecenv.libero.scene.arenas import ARENAS
from vecenv.libero.tasks.suites import TaskSpec
from vecenv_eval.demos.hdf5 import DemoError
from vecenv_eval.demos.schema import Pose

# Where fixtures may stand; numbers of a quaternion are smaller.
_MOST_METRES = 100.0


def fixture_poses(mjcf: str, spec: TaskSpec) -> dict[str, Pose]:
    """Where the fixtures of a task stand in an MJCF that upstream saved.

    Args:
        mjcf: the text; fixtures are the bodies ``{name}_main`` of its world body.
        spec: the task.

    Returns:
        name -> (position [3] in metres, quaternion wxyz [4]), world frame.

    Raises:
        DemoError: it is not well-formed, declares a document type, or lacks a fixture.
    """
    problem = spec.problem()
    table = ARENAS[problem.name].workspace_category
    wanted = {f"{fixture.name}_main": fixture.name for fixture in problem.fixtures if fixture.category != table}
    found = {wanted[name]: _pose(name, attributes) for name, attributes in _bodies(mjcf, wanted).items()}
    missing = [name for name in wanted.values() if name not in found]
    if missing:
        raise DemoError(f"model_file: no body {missing[0]}_main, the fixture {missing[0]!r} of {spec.name}")
    return found


def _bodies(mjcf: str, wanted: Collection[str]) -> dict[str, Mapping[str, str]]:
    """Attributes of the world's own bodies with these names."""
    found: dict[str, Mapping[str, str]] = {}
    path: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        if tag == "body" and path == ["mujoco", "worldbody"] and attributes.get("name") in wanted:
            found[attributes["name"]] = attributes
        path.append(tag)

    def refuse(*_: object) -> None:
        raise DemoError("model_file: it declares a document type, which no MJCF does")

    parser = xml.parsers.expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = start, lambda tag: path.pop()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(mjcf, True)
    except xml.parsers.expat.ExpatError as error:
        raise DemoError(f"model_file: not well-formed XML: {error}") from None
    return found


def _pose(body: str, attributes: Mapping[str, str]) -> Pose:
    turned = {"axisangle", "xyaxes", "zaxis", "euler"} & attributes.keys()
    if turned:
        raise DemoError(f"model_file: body {body} is turned by {min(turned)}; MuJoCo saves quat")
    pos = _numbers(body, "pos", attributes.get("pos", "0 0 0"), 3)
    quat = _numbers(body, "quat", attributes.get("quat", "1 0 0 0"), 4)
    if np.linalg.norm(quat) < 1e-6:
        raise DemoError(f"model_file: body {body}: quat has no length")
    return pos, quat


def _numbers(body: str, name: str, text: str, count: int) -> np.ndarray:
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not np.isfinite(values).all():
        raise DemoError(f"model_file: body {body}: {name}={text!r:.50}, expected {count} numbers")
    if np.abs(values).max() > _MOST_METRES:
        raise DemoError(f"model_file: body {body}: {name}={text!r:.50}: more than {_MOST_METRES:g} m from the origin")
    return values
