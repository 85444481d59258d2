"""The two robots of SIMPLER, WidowX and Google Robot, as data: joints, drives, grippers, contacts.

Constants are those of SIMPLER's ``prepackaged_config`` (ManiSkill2_real2sim, commit ef7a4d4, ``agents/configs``).
Nothing here needs SAPIEN; the controllers are in ``controllers.py``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from types import MappingProxyType

from vecenv.errors import InvalidInput
from vecenv.simpler.control.chain import Chain
from vecenv.simpler.control.urdf import read_urdf

_DESCRIPTIONS = PurePosixPath("mani_skill2_real2sim/assets/descriptions")


class RobotError(InvalidInput):
    """Arrays of the wrong shape, or a URDF version that a robot does not have; the message says which."""


@dataclass(frozen=True, kw_only=True)
class Drive:
    """Spring and damper of one joint; the torque is limited, gravity and Coriolis forces are compensated.

    Attributes:
        joint: joint name.
        stiffness: N·m/rad, or N/m.
        damping: N·m·s/rad, or N·s/m.
        force_limit: N·m, or N.
    """

    joint: str
    stiffness: float
    damping: float
    force_limit: float


@dataclass(frozen=True, kw_only=True)
class LinkMaterial:
    """Contact of a link that differs from the scene's default.

    Attributes:
        static_friction, dynamic_friction: coefficients.
        patch_radius: metres, for torsional friction; also its minimum.
    """

    static_friction: float
    dynamic_friction: float
    patch_radius: float


@dataclass(frozen=True, kw_only=True)
class Finger:
    """One side of a gripper, as far as grasping goes.

    Attributes:
        links: links that may press on the object.
        opening: +1 when the y axis of those links points where the finger goes to open, -1 when against it.
    """

    links: tuple[str, ...]
    opening: float


@dataclass(frozen=True, kw_only=True)
class Robot:
    """What is known of a robot apart from its URDF file.

    Attributes:
        name: ``widowx`` or ``google_robot``.
        urdf: path of its URDF file in the asset tree.
        versions: suffixes of the recoloured variants; "" is the plain one.
        root: root link, to which the base pose belongs.
        tool: link that actions move.
        drives: one a moving joint, in the order of qpos.
        arm: columns of qpos that the arm's controller commands.
        gripper: columns of the two fingers.
        control_hz: control steps a second.
        sim_hz: physics substeps a second.
        gripper_range: set-points of the fingers that the gripper's controller may command, radians or metres.
        materials: link -> contact, where it is not the default.
        fingers: the left and the right side.
        grasp_angle: largest angle between a finger's push and its opening direction that counts as a grasp, degrees.
        never_touch: pairs of links whose contact is ignored.
        still: columns of qpos that no action moves: joints which hang on the fixed root, beside the arm.
    """

    name: str
    urdf: PurePosixPath
    versions: tuple[str, ...] = ("",)
    root: str
    tool: str
    drives: tuple[Drive, ...]
    arm: tuple[int, ...]
    gripper: tuple[int, int]
    control_hz: int
    sim_hz: int
    gripper_range: tuple[float, float]
    materials: Mapping[str, LinkMaterial] = field(default_factory=lambda: MappingProxyType({}))
    fingers: tuple[Finger, Finger]
    grasp_angle: float
    never_touch: tuple[tuple[str, str], ...] = ()
    still: tuple[int, ...] = ()

    @property
    def dof(self) -> int:
        """N, the width of qpos."""
        return len(self.drives)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names in the order of qpos."""
        return tuple(drive.joint for drive in self.drives)

    @property
    def substeps(self) -> int:
        """S, physics substeps in a control step."""
        return self.sim_hz // self.control_hz

    def urdf_path(self, version: str = "") -> PurePosixPath:
        """Path of a version's URDF file in the asset tree.

        Raises:
            RobotError: the robot has no such version.
        """
        if version not in self.versions:
            raise RobotError(f"{self.name} has no URDF version {version!r}; versions: {list(self.versions)}")
        return self.urdf.with_name(f"{self.urdf.stem}_{version}.urdf") if version else self.urdf

    def chain(self, urdf: Path) -> Chain:
        """Kinematics of the tool, from a URDF file; all versions have the same.

        Raises:
            FileNotFoundError, KinematicsError: there is no such file, or it is not this robot's.
        """
        return read_urdf(urdf).chain(self.tool, self.joints)


def _drives(joints: Mapping[str, tuple[float, float, float]]) -> tuple[Drive, ...]:
    return tuple(
        Drive(joint=name, stiffness=stiffness, damping=damping, force_limit=limit)
        for name, (stiffness, damping, limit) in joints.items()
    )


def _material(friction: float, patch_radius: float) -> LinkMaterial:
    return LinkMaterial(static_friction=friction, dynamic_friction=friction, patch_radius=patch_radius)


def _wheel(static_friction: float) -> LinkMaterial:
    return LinkMaterial(static_friction=static_friction, dynamic_friction=0.0, patch_radius=0.1)


WIDOWX = Robot(
    name="widowx",
    urdf=_DESCRIPTIONS / "widowx_description/wx250s.urdf",
    root="base_link",
    tool="ee_gripper_link",
    drives=_drives(
        {
            "waist": (1169.7891719504198, 330.0, 200.0),
            "shoulder": (730.0, 180.0, 200.0),
            "elbow": (808.4601346394447, 152.12036565582588, 100.0),
            "forearm_roll": (1229.1299089624076, 309.6215302722146, 100.0),
            "wrist_angle": (1272.2760456418862, 201.04998711007383, 100.0),
            "wrist_rotate": (1056.3326605132252, 269.51458932695414, 100.0),
            "left_finger": (1000.0, 200.0, 60.0),
            "right_finger": (1000.0, 200.0, 60.0),
        }
    ),
    arm=(0, 1, 2, 3, 4, 5),
    gripper=(6, 7),
    control_hz=5,
    sim_hz=500,
    # A millimetre beyond the joints' range on both sides, so that a closed gripper presses.
    gripper_range=(0.014, 0.038),
    materials=MappingProxyType({f"{side}_finger_link": _material(2.0, 0.01) for side in ("left", "right")}),
    fingers=(Finger(links=("left_finger_link",), opening=1.0), Finger(links=("right_finger_link",), opening=-1.0)),
    grasp_angle=60.0,
    never_touch=(("gripper_bar_link", "left_finger_link"), ("gripper_bar_link", "right_finger_link")),
)

GOOGLE_ROBOT = Robot(
    name="google_robot",
    urdf=_DESCRIPTIONS / "googlerobot_description/google_robot_meta_sim_fix_wheel_fix_fingertip.urdf",
    versions=(
        "",
        "recolor_tabletop_visual_matching_1",
        "recolor_tabletop_visual_matching_2",
        "recolor_cabinet_visual_matching_1",
    ),
    root="link_base",
    tool="link_gripper_tcp",
    drives=_drives(
        {
            "joint_torso": (1700.0, 1059.9791902443303, 300.0),
            "joint_shoulder": (1737.0471680861954, 1010.4720585373592, 300.0),
            "joint_bicep": (979.975871856535, 767.2803161582076, 100.0),
            "joint_elbow": (930.0, 680.0, 100.0),
            "joint_forearm": (1212.154500274304, 674.9946964336588, 100.0),
            "joint_wrist": (432.96500923932535, 274.613381336198, 100.0),
            "joint_gripper": (468.0013365498738, 340.532560578637, 100.0),
            "joint_finger_right": (200.0, 8.0, 60.0),
            "joint_finger_left": (200.0, 8.0, 60.0),
            "joint_head_pan": (2000.0, 900.0, 100.0),
            "joint_head_tilt": (2000.0, 900.0, 100.0),
        }
    ),
    arm=(0, 1, 2, 3, 4, 5, 6, 9, 10),
    gripper=(7, 8),
    still=(9, 10),
    control_hz=3,
    sim_hz=513,
    # A hundredth of a radian beyond the joints' range (-0.0001 to 1.3), for the same reason.
    gripper_range=(-0.0101, 1.31),
    materials=MappingProxyType(
        {
            "link_base": LinkMaterial(static_friction=0.1, dynamic_friction=0.0, patch_radius=0.1),
            **{f"link_wheel_{side}": _wheel(1.0) for side in ("left", "right")},
            **{f"link_finger_{side}": _material(2.0, 0.1) for side in ("left", "right")},
            **{f"link_finger_tip_{side}": _material(2.0, 0.1) for side in ("left", "right")},
            **{f"link_finger_nail_{side}": _material(0.1, 0.01) for side in ("left", "right")},
        }
    ),
    fingers=(
        Finger(links=("link_finger_tip_left", "link_finger_left"), opening=1.0),
        Finger(links=("link_finger_tip_right", "link_finger_right"), opening=1.0),
    ),
    grasp_angle=80.0,
)

ROBOTS: Mapping[str, Robot] = MappingProxyType({robot.name: robot for robot in (WIDOWX, GOOGLE_ROBOT)})
