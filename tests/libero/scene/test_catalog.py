"""Category facts are upstream's: where files lie, and at which joint positions something is open or on."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import pytest
from support import upstream

from vecenv import assets
from vecenv.libero.scene import catalog
from vecenv.libero.scene.catalog import JointTest, UnknownCategory, articulation, asset_file

STATES = {"is_open": "is_open", "is_close": "is_close", "turn_on": "turn_on", "turn_off": "turn_off"}


@functools.cache
def classes() -> dict[str, Any]:
    """Upstream's object classes by category."""
    upstream.peer_of(upstream.tasks_of("libero_object-0")[0].bddl_path)
    from libero.libero.envs.base_object import OBJECTS_DICT

    return {name: cls for name, cls in OBJECTS_DICT.items() if name != "target_zone"}


@functools.cache
def instance(category: str) -> Any:
    return classes()[category](name=category)


def installed(category: str) -> bool:
    try:
        instance(category)
    except Exception:  # upstream registers categories whose files are not in the package
        return False
    return True


def test_every_category_upstream_can_load_has_the_same_file() -> None:
    root = assets.libero_assets_root()
    loadable = [category for category in classes() if installed(category)]
    assert len(loadable) > 60
    for category in loadable:
        assert asset_file(category, root).resolve() == Path(instance(category).file).resolve(), category


def test_categories_are_found_whatever_their_case() -> None:
    root = assets.libero_assets_root()
    assert asset_file("Akita_Black_Bowl", root) == asset_file("akita_black_bowl", root)


def test_an_unknown_category_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(UnknownCategory, match=rf"'teapot' has no asset file below {tmp_path}") as caught:
        asset_file("teapot", tmp_path)
    assert isinstance(caught.value, KeyError)


def passes(test: JointTest, qpos: float) -> bool:
    sign, bound, inclusive = test.sign_form()
    return sign * qpos >= bound if inclusive else sign * qpos > bound


@pytest.mark.parametrize("category", sorted(catalog.ARTICULATIONS))
@pytest.mark.parametrize("state", STATES)
def test_joint_tests_agree_with_upstreams_on_both_sides_and_on_the_bound(category: str, state: str) -> None:
    test: JointTest | None = getattr(articulation(category), state)
    theirs = getattr(instance(category), state, None)
    if test is None:
        assert theirs is None or raises_not_implemented(theirs)
        return
    assert theirs is not None
    for qpos in (test.bound - 1e-9, test.bound, test.bound + 1e-9, -3.0, -0.1, 0.0, 0.1, 3.0):
        assert passes(test, qpos) == theirs(qpos), qpos


def raises_not_implemented(test: Any) -> bool:
    try:
        test(0.0)
    except NotImplementedError:
        return True
    return False


def test_categories_that_upstream_can_open_or_turn_on_are_all_listed() -> None:
    for category in classes():
        if installed(category):
            for state in STATES:
                theirs = getattr(instance(category), state, None)
                known = theirs is not None and not raises_not_implemented(theirs)
                assert (getattr(articulation(category), state) is not None) == known, (category, state)


def test_things_without_joints_have_no_states() -> None:
    assert articulation("plate") == catalog.Articulation()


@pytest.mark.parametrize(("op", "qpos"), [("<", -1.0), (">", 3.0), (">=", 2.0)])
def test_each_comparison_has_a_sign_form(op: str, qpos: float) -> None:
    test = JointTest(op=op, bound=2.0)
    assert passes(test, qpos)
    assert passes(test, 2.0) == (op == ">=")
    assert passes(test, 4.0 - qpos if op == "<" else 1.0) is False
