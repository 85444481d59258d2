"""Which contacts a model has: those of the MuJoCo that LIBERO was made with, or those of the one that is installed.

``"published"``: what MuJoCo 2.3 to 3.3 computed, on whichever MuJoCo runs. LIBERO's demonstrations, stored starts and
published checkpoints come from there. Five things have changed since:

* 3.4.0 doubled the depth of contacts between the faces of two boxes, and 3.12.0 replaced their collider
  (``vecenv.libero.physics.colliders.boxbox``).
* 3.13.0 keeps more vertices of a mesh on a plane (``vecenv.libero.physics.colliders.planemesh``).
* 3.8.0 lets a flat cylinder touch in several points; the flag ``multiccd`` off brings the one point back.
* 3.3.2 computes the depth of convex shapes whose pair has no margin to the last digit, where EPA used to stop within
  1e-6 m: occasionally the contact of an arm's mesh with a box then moves by millimetres. A margin of
  1e-12 m on meshes takes the earlier path.
* 3.11.0 stops the solver when it expects the next Newton step to gain less than the tolerance; before, it took that
  step. A tighter tolerance, with the line search's kept as it was, gives the published accelerations to 1e-9.

``"current"``: what the installed MuJoCo computes.

The choice is part of the compiled model: solver options, and a custom number that MuJoCo itself ignores. It is copied,
cached and exported with the model, and every backend reads it there.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, cast

import mujoco

from vecenv.errors import InvalidInput

Contacts: TypeAlias = Literal["published", "current"]
CONTACTS: tuple[Contacts, ...] = ("published", "current")
# The custom number, which comes first in a model, and its value for published contacts: a random one, which no other
# model has by chance.
NUMERIC = "published_contacts"
MARK = 0.8352461937105713
# Options of either choice, as MJCF names them. The product of the two tolerances ends a line search: it stays 1e-10.
OPTIONS: dict[Contacts, dict[str, Any]] = {
    "published": {"tolerance": 1e-13, "ls_tolerance": 1e3, "ccd_iterations": 50},
    "current": {"tolerance": 1e-8, "ls_tolerance": 1e-2, "ccd_iterations": 35},
}


# Contact margin of meshes in published contacts, metres.
MESH_MARGIN = 1e-12


class ContactsError(InvalidInput):
    """A value that ``contacts`` cannot have; the message lists the allowed ones."""


def checked(contacts: str) -> Contacts:
    """The value itself.

    Raises:
        ContactsError: it is not one of ``CONTACTS``.
    """
    if contacts not in CONTACTS:
        raise ContactsError(f"contacts={contacts!r} is not available; available: {', '.join(CONTACTS)}")
    return cast(Contacts, contacts)


def mark(model: mujoco.MjModel, contacts: Contacts) -> None:
    """Choose a model's contacts, in place.

    Raises:
        ContactsError: another value, or a model without custom numbers.
    """
    published = checked(contacts) == "published"
    if not model.nnumericdata:
        raise ContactsError("the model has no custom number to hold the choice; compile it with vecenv")
    model.numeric_data[0] = MARK if published else 0.0
    one_point = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
    model.opt.disableflags = (model.opt.disableflags & ~one_point) | (one_point if published else 0)
    for name, value in OPTIONS[contacts].items():
        setattr(model.opt, name, value)
    before, after = (0.0, MESH_MARGIN) if published else (MESH_MARGIN, 0.0)
    meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    model.geom_margin[meshes & (model.geom_margin == before)] = after


def remark(model: mujoco.MjModel) -> None:
    """Give a model that was just compiled from marked MJCF what belongs to its mark, in place."""
    if of(model) == "published":
        mark(model, "published")


def of(model: mujoco.MjModel) -> Contacts:
    """A model's contacts; ``"current"`` for models that are not ours."""
    return "published" if model.nnumericdata and model.numeric_data[0] == MARK else "current"
