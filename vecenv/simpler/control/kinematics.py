"""Where a robot's tool is and which joint angles bring it elsewhere, read from its URDF file, for a batch of arms.

In: a URDF file (``read_urdf``) and the name of a link; joint positions [B, N] of the whole robot, in the order of the
drives. Out: a ``Chain`` of the joints between the root and that link, which gives the link's pose and Jacobian in the
robot's root frame, and solves inverse kinematics with the closed-loop iteration that SAPIEN runs on Pinocchio (CLIK,
Pinocchio's example "Inverse kinematics (clik)"; damped pseudo-inverse, Wampler 1986).

The arithmetic is compiled by numba, as in ``controllers/osc_numba.py``: a slot takes tens of iterations, each far
cheaper than a call into an array library. Everything is float64, slot by slot, so no slot depends on its neighbours.
"""

from __future__ import annotations

import functools
import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numba import types

from vecenv.errors import InvalidInput
from vecenv.util.compiled import compile_function, part


class KinematicsError(InvalidInput):
    """A robot description that cannot be used, or arrays of the wrong shape; the message names the part."""


@dataclass(frozen=True, kw_only=True)
class Clik:
    """Settings of the inverse kinematics; the defaults are SAPIEN's.

    Attributes:
        tolerance: done when the error, metres and radians in one norm at the last joint, is below this.
        max_iterations: give up after so many steps.
        damping: added to the diagonal of J Jᵀ.
        step: fraction of the solution that one iteration takes.
    """

    tolerance: float = 1e-4
    max_iterations: int = 100
    damping: float = 1e-6
    step: float = 0.1


@dataclass(frozen=True, kw_only=True)
class Joint:
    """One joint of a URDF file.

    Attributes:
        name: joint name.
        kind: ``fixed``, ``revolute``, ``continuous`` or ``prismatic``.
        parent: link it hangs on.
        child: link it carries.
        position: of the child's frame in the parent's at zero, metres, [3].
        rotation: likewise, matrix [3, 3].
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
            order: names of the robot's moving joints, as they stand in the columns of qpos.

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Chain:
    """The joints between a robot's root and one link.

    Attributes:
        width: N, columns of qpos.
        columns: which column of qpos each joint of the chain is, int [n].
        fixed_pos: from the previous joint's frame to the joint's at zero, metres, [n, 3].
        fixed_rot: likewise, matrices [n, 3, 3].
        axis: unit axes in the joint's own frame, [n, 3].
        slides: prismatic, bool [n].
        tip_pos: from the last joint's frame to the link, metres, [3].
        tip_rot: likewise, [3, 3].
    """

    width: int
    columns: np.ndarray
    fixed_pos: np.ndarray
    fixed_rot: np.ndarray
    axis: np.ndarray
    slides: np.ndarray
    tip_pos: np.ndarray
    tip_rot: np.ndarray

    def pose(self, qpos: Any) -> tuple[np.ndarray, np.ndarray]:
        """Position [B, 3] (metres) and rotation [B, 3, 3] of the link in the root's frame, for qpos [B, N]."""
        rows = self._rows(qpos)
        position, rotation = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        jacobian = np.empty((len(rows), 6, len(self.columns)))
        _compiled()[0](*self._constants(), self.tip_pos, self.tip_rot, rows, position, rotation, jacobian)
        return position, rotation

    def jacobian(self, qpos: Any) -> np.ndarray:
        """Velocity of the link (linear, then angular, root frame) per joint velocity, [B, 6, N]."""
        rows = self._rows(qpos)
        position, rotation = np.empty((len(rows), 3)), np.empty((len(rows), 3, 3))
        jacobian = np.empty((len(rows), 6, len(self.columns)))
        _compiled()[0](*self._constants(), self.tip_pos, self.tip_rot, rows, position, rotation, jacobian)
        wide = np.zeros((len(rows), 6, self.width))
        wide[:, :, self.columns] = jacobian
        return wide

    def solve(
        self, qpos: Any, position: np.ndarray, rotation: np.ndarray, settings: Clik | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions that bring the link to a pose, starting from ``qpos``.

        Joint limits are not heeded, joints off the chain stay.

        Args:
            qpos: where the joints are, [B, N].
            position: target position in the root's frame, metres, [B, 3].
            rotation: target rotation, [B, 3, 3].
            settings: of the iteration; SAPIEN's by default.

        Returns:
            Joint positions [B, N], equal to ``qpos`` where nothing was found, and where something was, bool [B].
        """
        rows, how = self._rows(qpos), settings or Clik()
        # The error is measured at the last joint, as SAPIEN does: it decides when the iteration ends.
        joint_rot = np.ascontiguousarray(np.asarray(rotation, np.float64) @ self.tip_rot.T)
        joint_pos = np.asarray(position, np.float64) - joint_rot @ self.tip_pos
        found, converged = rows.copy(), np.zeros(len(rows), bool)
        numbers = np.array([how.tolerance, how.damping, how.step])
        _compiled()[1](*self._constants(), joint_pos, joint_rot, numbers, how.max_iterations, found, converged)
        return np.where(converged[:, None], found, rows), converged

    def _constants(self) -> tuple[np.ndarray, ...]:
        return self.columns, self.fixed_pos, self.fixed_rot, self.axis, self.slides

    def _rows(self, qpos: Any) -> np.ndarray:
        rows = np.ascontiguousarray(qpos, np.float64)
        if rows.ndim != 2 or rows.shape[1] != self.width:
            raise KinematicsError(f"qpos must have shape [B, {self.width}], got {list(rows.shape)}")
        return rows


# ---------------------------------------------------------------------------------------------------------------------
# Reading URDF.

_KINDS = ("fixed", "revolute", "continuous", "prismatic")


def read_urdf(path: Path) -> Urdf:
    """The joints of a robot description.

    Raises:
        FileNotFoundError: there is no such file.
        KinematicsError: it is not a URDF file, or a joint has a kind or a number that cannot be used.
    """
    try:
        root = ET.fromstring(path.read_bytes())
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


def rotation_from_rpy(rpy: np.ndarray) -> np.ndarray:
    """Matrix [3, 3] of URDF's roll, pitch and yaw (about the fixed x, y and z axes, in that order), radians."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


# ---------------------------------------------------------------------------------------------------------------------
# Rotations, any leading axes.


def rotation_from_rotvec(rotvec: Any) -> np.ndarray:
    """Matrices [..., 3, 3] of rotation vectors [..., 3] (axis times angle, radians)."""
    vector = np.asarray(rotvec, np.float64)
    half = np.linalg.norm(vector, axis=-1, keepdims=True) / 2
    # sin(half) / angle, whose limit at 0 is 1/2; np.sinc is sin(pi x) / (pi x).
    return rotation_from_quat(np.concatenate([np.cos(half), vector * np.sinc(half / np.pi) / 2], axis=-1))


def rotvec_from_rotation(rotation: Any) -> np.ndarray:
    """Rotation vectors [..., 3] of matrices [..., 3, 3], the shorter way round."""
    quat = quat_from_rotation(rotation)
    sine = np.linalg.norm(quat[..., 1:], axis=-1, keepdims=True)
    angle = 2 * np.arctan2(sine, quat[..., :1])
    return quat[..., 1:] * np.where(sine > 0, angle / np.where(sine > 0, sine, 1), 2)


def rotation_from_quat(quat: Any) -> np.ndarray:
    """Matrices [..., 3, 3] of quaternions wxyz [..., 4], which need not have unit length."""
    q = np.asarray(quat, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quat_from_rotation(rotation: Any) -> np.ndarray:
    """Unit quaternions wxyz [..., 4] with w >= 0 of matrices [..., 3, 3]; Shepperd's method."""
    m = np.asarray(rotation, np.float64)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = ([m[..., i, j] for j in range(3)] for i in range(3))
    rows = [
        [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
        [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
        [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
        [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.argmax(np.stack([rows[i][i] for i in range(4)], axis=-1), axis=-1)
    quat = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[..., :1] < 0, -quat, quat)


# ---------------------------------------------------------------------------------------------------------------------
# Compiling. Once a machine, in a few seconds, and read from numba's cache afterwards.

_R1, _R2, _R3 = (types.Array(types.float64, n, "C", readonly=True) for n in (1, 2, 3))
_W2, _W3 = (types.Array(types.float64, n, "C") for n in (2, 3))
_FLAGS, _WRITE_FLAGS = types.Array(types.boolean, 1, "C", readonly=True), types.Array(types.boolean, 1, "C")
_CHAIN = (types.Array(types.intp, 1, "C", readonly=True), _R2, _R3, _R2, _FLAGS)


@functools.cache
def _compiled() -> tuple[Callable[..., None], Callable[..., None]]:
    """``_forward`` and ``_inverse``, compiled."""
    return (
        compile_function(types.void(*_CHAIN, _R1, _R2, _R2, _W2, _W3, _W3), _forward),
        compile_function(types.void(*_CHAIN, _R2, _R3, _R1, types.intp, _W2, _WRITE_FLAGS), _inverse),
    )


# ---------------------------------------------------------------------------------------------------------------------
# Compiled code, one slot at a time. ``frame`` is [4, 3]: rows 0 to 2 the rotation, row 3 the position.


def _forward(
    columns: Any,
    fixed_pos: Any,
    fixed_rot: Any,
    axis: Any,
    slides: Any,
    tip_pos: Any,
    tip_rot: Any,
    qpos: Any,
    position: Any,
    rotation: Any,
    jacobian: Any,
) -> None:
    """See ``Chain.pose`` and ``Chain.jacobian``."""
    frame, origins, axes = np.empty((4, 3)), np.empty((columns.size, 3)), np.empty((columns.size, 3))
    for i in range(len(qpos)):
        _follow(columns, fixed_pos, fixed_rot, axis, slides, qpos[i], frame, origins, axes)
        _attach(frame, tip_pos, tip_rot)
        for row in range(3):
            position[i, row] = frame[3, row]
            for column in range(3):
                rotation[i, row, column] = frame[row, column]
        _fill_jacobian(frame, origins, axes, slides, jacobian[i])


def _inverse(
    columns: Any,
    fixed_pos: Any,
    fixed_rot: Any,
    axis: Any,
    slides: Any,
    target_pos: Any,
    target_rot: Any,
    numbers: Any,
    max_iterations: int,
    qpos: Any,
    converged: Any,
) -> None:
    """See ``Chain.solve``; ``numbers`` are the tolerance, the damping and the step."""
    count = columns.size
    frame, origins, axes = np.empty((4, 3)), np.empty((count, 3)), np.empty((count, 3))
    jacobian, system, error = np.empty((6, count)), np.empty((6, 6)), np.empty(6)
    for i in range(len(qpos)):
        for iteration in range(max_iterations + 1):
            _follow(columns, fixed_pos, fixed_rot, axis, slides, qpos[i], frame, origins, axes)
            if _pose_error(frame, target_pos[i], target_rot[i], error) < numbers[0]:
                converged[i] = True
                break
            if iteration < max_iterations:
                _fill_jacobian(frame, origins, axes, slides, jacobian)
                _damped_system(jacobian, numbers[1], system)
                _solve_in_place(system, error)
                for j in range(count):
                    total = 0.0
                    for row in range(6):
                        total += jacobian[row, j] * error[row]
                    qpos[i, columns[j]] -= numbers[2] * total


@part
def _follow(
    columns: Any,
    fixed_pos: Any,
    fixed_rot: Any,
    axis: Any,
    slides: Any,
    q: Any,
    frame: Any,
    origins: Any,
    axes: Any,
) -> None:
    """Frame of the last joint, and every joint's position and axis in the root's frame."""
    turn = np.empty((3, 3))
    for row in range(4):
        for column in range(3):
            frame[row, column] = 1.0 if row == column else 0.0
    for j in range(columns.size):
        _attach(frame, fixed_pos[j], fixed_rot[j])
        x, y, z = axis[j, 0], axis[j, 1], axis[j, 2]
        for row in range(3):
            axes[j, row] = frame[row, 0] * x + frame[row, 1] * y + frame[row, 2] * z
        value = q[columns[j]]
        if slides[j]:
            for row in range(3):
                frame[3, row] += value * axes[j, row]
        else:
            _rotation_about(axis[j], value, turn)
            _turn(frame, turn)
        for row in range(3):
            origins[j, row] = frame[3, row]


@part
def _attach(frame: Any, position: Any, rotation: Any) -> None:
    for row in range(3):
        frame[3, row] += frame[row, 0] * position[0] + frame[row, 1] * position[1] + frame[row, 2] * position[2]
    _turn(frame, rotation)


@part
def _turn(frame: Any, rotation: Any) -> None:
    for row in range(3):
        a, b, c = frame[row, 0], frame[row, 1], frame[row, 2]
        for column in range(3):
            frame[row, column] = a * rotation[0, column] + b * rotation[1, column] + c * rotation[2, column]


@part
def _rotation_about(axis: Any, angle: float, out: Any) -> None:
    """Rodrigues' formula."""
    x, y, z = axis[0], axis[1], axis[2]
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    out[0, 0], out[0, 1], out[0, 2] = c + x * x * d, x * y * d - z * s, x * z * d + y * s
    out[1, 0], out[1, 1], out[1, 2] = y * x * d + z * s, c + y * y * d, y * z * d - x * s
    out[2, 0], out[2, 1], out[2, 2] = z * x * d - y * s, z * y * d + x * s, c + z * z * d


@part
def _fill_jacobian(frame: Any, origins: Any, axes: Any, slides: Any, out: Any) -> None:
    """Linear and angular velocity of the frame's origin, root axes."""
    for j in range(slides.size):
        ax, ay, az = axes[j, 0], axes[j, 1], axes[j, 2]
        if slides[j]:
            out[0, j], out[1, j], out[2, j] = ax, ay, az
            out[3, j] = out[4, j] = out[5, j] = 0.0
        else:
            x, y, z = frame[3, 0] - origins[j, 0], frame[3, 1] - origins[j, 1], frame[3, 2] - origins[j, 2]
            out[0, j], out[1, j], out[2, j] = ay * z - az * y, az * x - ax * z, ax * y - ay * x
            out[3, j], out[4, j], out[5, j] = ax, ay, az


@part
def _pose_error(frame: Any, target_pos: Any, target_rot: Any, error: Any) -> float:
    """Twist that takes the target to the frame in unit time, in root axes at the frame's origin; and its length.

    It is the logarithm of target⁻¹ frame (Lynch and Park 2017, section 3.3.3), which is the same in the frame's axes as
    in the target's, turned into the root's. The length does not depend on the axes.
    """
    w, x, y, z = _quaternion_between(frame, target_rot)
    sine = math.sqrt(x * x + y * y + z * z)
    half = math.atan2(sine, w)
    scale = 2.0 * half / sine if sine > 0.0 else 2.0
    x, y, z = x * scale, y * scale, z * scale  # rotation vector, in the frame's axes
    # The displacement, in the target's axes.
    d = np.empty(3)
    for row in range(3):
        d[row] = 0.0
        for k in range(3):
            d[row] += target_rot[k, row] * (frame[3, k] - target_pos[k])
    # alpha = half / tan(half); beta = (1 - alpha) / angle².
    if half > 1e-4:
        alpha = half / math.tan(half) if half < math.pi / 2 - 1e-12 else 0.0
        beta = (1.0 - alpha) / (4.0 * half * half)
    else:
        alpha, beta = 1.0 - half * half / 3.0, 1.0 / 12.0
    along = beta * (x * d[0] + y * d[1] + z * d[2])
    u = alpha * d[0] - 0.5 * (y * d[2] - z * d[1]) + along * x
    v = alpha * d[1] - 0.5 * (z * d[0] - x * d[2]) + along * y
    t = alpha * d[2] - 0.5 * (x * d[1] - y * d[0]) + along * z
    for row in range(3):
        error[row] = frame[row, 0] * u + frame[row, 1] * v + frame[row, 2] * t
        error[3 + row] = frame[row, 0] * x + frame[row, 1] * y + frame[row, 2] * z
    return math.sqrt(u * u + v * v + t * t + x * x + y * y + z * z)


@part
def _quaternion_between(frame: Any, target_rot: Any) -> tuple[float, float, float, float]:
    """Unit quaternion with w >= 0 of target_rotᵀ frame; Shepperd's method, as in ``controllers/rotations.py``."""
    m = np.empty((3, 3))
    for row in range(3):
        for column in range(3):
            m[row, column] = 0.0
            for k in range(3):
                m[row, column] += target_rot[k, row] * frame[k, column]
    xx, yy, zz = m[0, 0], m[1, 1], m[2, 2]
    a, b, c = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    d, e, f = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    sizes = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    if sizes[0] >= max(sizes[1], sizes[2], sizes[3]):
        w, x, y, z = sizes[0], a, b, c
    elif sizes[1] >= max(sizes[2], sizes[3]):
        w, x, y, z = a, sizes[1], d, e
    elif sizes[2] >= sizes[3]:
        w, x, y, z = b, d, sizes[2], f
    else:
        w, x, y, z = c, e, f, sizes[3]
    length = math.sqrt(w * w + x * x + y * y + z * z)
    if w < 0.0:
        length = -length
    return w / length, x / length, y / length, z / length


@part
def _damped_system(jacobian: Any, damping: float, out: Any) -> None:
    """J Jᵀ + damping."""
    for row in range(6):
        for column in range(row + 1):
            total = damping if row == column else 0.0
            for j in range(jacobian.shape[1]):
                total += jacobian[row, j] * jacobian[column, j]
            out[row, column] = out[column, row] = total


@part
def _solve_in_place(system: Any, right: Any) -> None:
    """Solve a positive definite system by its LDLᵀ factorisation; both arguments are overwritten."""
    n = right.size
    for k in range(n):
        for row in range(k + 1, n):
            factor = system[row, k] / system[k, k]
            for column in range(k + 1, row + 1):
                system[row, column] -= factor * system[column, k]
        for row in range(k + 1, n):
            system[row, k] /= system[k, k]
    for row in range(n):
        for k in range(row):
            right[row] -= system[row, k] * right[k]
    for row in range(n):
        right[row] /= system[row, row]
    for row in range(n - 1, -1, -1):
        for k in range(row + 1, n):
            right[row] -= system[k, row] * right[k]
