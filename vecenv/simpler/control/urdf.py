"""A robot's joints, read from its URDF file.

In: a URDF file (``read_urdf``). Out: a ``Urdf``, its joints by name; ``Urdf.chain`` gives the kinematics of one link
(``chain.py``). Positions are metres, angles radians, matrices [3, 3].
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from vecenv.simpler.control.chain import Chain, KinematicsError
from vecenv.simpler.control.rotations import rotation_from_rpy

_KINDS = ("fixed", "revolute", "continuous", "prismatic")


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One joint of a URDF file.

    Attributes:
        name: joint name.
        kind: ``fixed``, ``revolute``, ``continuous`` or ``prismatic``.
        parent: link it hangs on.
        child: link it carries.
        position: of the child's frame in the parent's at zero, metres, [3].
        rotation: its rotation, matrix [3, 3].
        axis: unit axis in the child's frame, [3].
        limits: lowest and highest position, radians or metres.
    """

    name: str
    kind: str
    parent: str
    child: str
    position: np.ndarray
    rotation: np.ndarray
    axis: np.ndarray
    limits: tuple[float, float]

    @property
    def moves(self) -> bool:
        """Whether it has a degree of freedom."""
        return self.kind != "fixed"


@dataclass(frozen=True)
class Urdf:
    """The joints of a robot.

    Attributes:
        name: the robot's name.
        joints: name -> joint, in the order of the file.
    """

    name: str
    joints: Mapping[str, Joint]

    @property
    def moving(self) -> tuple[str, ...]:
        """Names of the joints with a degree of freedom, in the order of the file."""
        return tuple(joint.name for joint in self.joints.values() if joint.moves)

    def path(self, link: str) -> list[Joint]:
        """Joints from the root to a link.

        Raises:
            KinematicsError: no such link, or the joints go round in a circle.
        """
        above = {joint.child: joint for joint in self.joints.values()}
        if link not in above and link not in {joint.parent for joint in self.joints.values()}:
            raise KinematicsError(f"robot {self.name!r} has no link {link!r}")
        found: list[Joint] = []
        while link in above:
            found.append(above[link])
            link = found[-1].parent
            if len(found) > len(self.joints):
                raise KinematicsError(f"robot {self.name!r}: the joints above {link!r} go round in a circle")
        return found[::-1]

    def limits(self, names: Sequence[str]) -> np.ndarray:
        """Lowest and highest positions of joints, [n, 2].

        Raises:
            KinematicsError: no such joint.
        """
        return np.array([self._joint(name).limits for name in names])

    def chain(self, link: str, order: Sequence[str]) -> Chain:
        """The kinematics of a link.

        Args:
            link: its name.
            order: names of the robot's moving joints, in the order of the columns of qpos.

        Raises:
            KinematicsError: no such link, no moving joint above it, or one that ``order`` leaves out.
        """
        fixed_pos, fixed_rot, position, rotation, used = [], [], np.zeros(3), np.eye(3), []
        for joint in self.path(link):
            position, rotation = position + rotation @ joint.position, rotation @ joint.rotation
            if joint.moves:
                if joint.name not in order:
                    raise KinematicsError(f"joint {joint.name!r} above {link!r} is not among {list(order)}")
                fixed_pos.append(position)
                fixed_rot.append(rotation)
                used.append(joint)
                position, rotation = np.zeros(3), np.eye(3)
        if not used:
            raise KinematicsError(f"no joint moves link {link!r} of robot {self.name!r}")
        return Chain(
            width=len(order),
            columns=np.array([list(order).index(joint.name) for joint in used]),
            fixed_pos=np.array(fixed_pos),
            fixed_rot=np.array(fixed_rot),
            axis=np.array([joint.axis for joint in used]),
            slides=np.array([joint.kind == "prismatic" for joint in used]),
            tip_pos=position,
            tip_rot=rotation,
        )

    def _joint(self, name: str) -> Joint:
        if name not in self.joints:
            raise KinematicsError(f"robot {self.name!r} has no joint {name!r}: {', '.join(self.joints)}")
        return self.joints[name]


def read_urdf(path: Path) -> Urdf:
    """The joints of a robot description.

    Raises:
        FileNotFoundError: there is no such file.
        KinematicsError: it is not a URDF file, or a joint has a kind or a number that cannot be used.
    """
    try:
        root = ET.fromstring(path.read_bytes())  # nosec B314 # a file of the asset tree
    except ET.ParseError as error:
        raise KinematicsError(f"{path}: not XML: {error}") from error
    if root.tag != "robot":
        raise KinematicsError(f"{path}: the root element is <{root.tag}>, not <robot>")
    try:
        joints = [_read_joint(element) for element in root.findall("joint")]
    except (KinematicsError, ValueError) as error:
        raise KinematicsError(f"{path}: {error}") from error
    return Urdf(root.get("name", path.stem), {joint.name: joint for joint in joints})


def _read_joint(element: ET.Element) -> Joint:
    name, kind = element.get("name", ""), element.get("type", "")
    if kind not in _KINDS:
        raise KinematicsError(f"joint {name!r} is {kind!r}; known: {', '.join(_KINDS)}")
    origin, limit = element.find("origin"), element.find("limit")
    return Joint(
        name=name,
        kind=kind,
        parent=_link(element, "parent", name),
        child=_link(element, "child", name),
        position=_triple(origin, "xyz", name),
        rotation=rotation_from_rpy(_triple(origin, "rpy", name)),
        axis=_axis(element, name) if kind != "fixed" else np.array([1.0, 0.0, 0.0]),
        limits=_limits(limit, name) if kind in ("revolute", "prismatic") else (-math.inf, math.inf),
    )


def _link(element: ET.Element, tag: str, name: str) -> str:
    found = element.find(tag)
    link = found.get("link") if found is not None else None
    if link is None:
        raise KinematicsError(f"joint {name!r} names no {tag} link")
    return link


def _triple(element: ET.Element | None, key: str, name: str, default: str = "0 0 0") -> np.ndarray:
    values = np.array((element.get(key, default) if element is not None else default).split(), np.float64)
    if values.shape != (3,):
        raise KinematicsError(f"joint {name!r}: {key} has {values.size} numbers, not 3")
    return values


def _axis(element: ET.Element, name: str) -> np.ndarray:
    axis = _triple(element.find("axis"), "xyz", name, "1 0 0")
    length = np.linalg.norm(axis)
    if not length:
        raise KinematicsError(f"joint {name!r} has an axis without direction")
    return axis / length


def _limits(element: ET.Element | None, name: str) -> tuple[float, float]:
    if element is None:
        raise KinematicsError(f"joint {name!r} has no limits")
    return float(element.get("lower", 0)), float(element.get("upper", 0))
