"""The light that arrives at a surface, as GL computes it: ambient, diffuse and specular, without shadows.

In: the lights of a world and a point of a surface. Out: the light that its colour is multiplied with, and the
highlights that are added. Unlike MuJoCo Warp, and like GL, a light's ambient part fades with the rest of it.
"""

# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOperatorIssue=false
# pyright: reportCallIssue=false, reportReturnType=false, reportIndexIssue=false, reportGeneralTypeIssues=false

from __future__ import annotations

import mujoco
import warp as wp

from vecenv.libero.render.ray_types import Lights, Surface

# The type of a light that shines where the camera looks; MuJoCo's own types are smaller numbers.
HEADLIGHT = 100
_HEADLIGHT = wp.constant(HEADLIGHT)
_DIRECTIONAL = wp.constant(int(mujoco.mjtLightType.mjLIGHT_DIRECTIONAL))
_SPOT = wp.constant(int(mujoco.mjtLightType.mjLIGHT_SPOT))
# The exponent that GL uses for a shininess of 1.
_MAX_EXPONENT = wp.constant(128.0)


@wp.func
def _strength(
    kind: int,
    towards: wp.vec3,
    distance: float,
    aim: wp.vec3,
    attenuation: wp.vec3,
    cutoff: float,
    exponent: float,
) -> float:
    """The share of a light that arrives, from its distance and, for a spot, its aim."""
    if kind == _DIRECTIONAL:
        return 1.0
    strength = 1.0 / (attenuation[0] + distance * (attenuation[1] + distance * attenuation[2]))
    if kind == _SPOT:
        cosine = -wp.dot(towards, aim)
        if cosine < wp.cos(wp.radians(cutoff)):
            return 0.0
        if exponent != 0.0:
            strength *= wp.pow(wp.max(cosine, 0.0), exponent)
    return strength


@wp.func
def _highlight(normal: wp.vec3, towards: wp.vec3, back: wp.vec3, shininess: float) -> float:
    """The share of a light that a surface mirrors to the viewer; 1 everywhere if the shininess is 0."""
    if shininess == 0.0:
        return 1.0
    cosine = wp.max(0.0, wp.dot(normal, wp.normalize(towards + back)))
    return wp.pow(cosine, shininess * _MAX_EXPONENT)


@wp.func
def arriving_light(lights: Lights, world: int, facing: wp.vec3, surface: Surface) -> tuple[wp.vec3, wp.vec3]:
    """The light of all lamps at a surface, and their highlights; ``facing`` is the camera's z axis."""
    light, shine = wp.vec3(0.0), wp.vec3(0.0)
    for lamp in range(lights.type.shape[1]):
        if lights.active[world % lights.active.shape[0], lamp]:
            kind = lights.type[world % lights.type.shape[0], lamp]
            aim = lights.dir[world, lamp]
            if kind == _HEADLIGHT:
                kind = _DIRECTIONAL
                aim = -facing
            towards = lights.pos[world, lamp] - surface.point
            away = wp.length(towards)
            towards = wp.where(kind == _DIRECTIONAL, -aim, towards / away)
            attenuation = lights.attenuation[world % lights.attenuation.shape[0], lamp]
            cutoff = lights.cutoff[world % lights.cutoff.shape[0], lamp]
            exponent = lights.exponent[world % lights.exponent.shape[0], lamp]
            strength = _strength(kind, towards, away, aim, attenuation, cutoff, exponent)
            if strength > 0.0:
                light += strength * lights.ambient[world % lights.ambient.shape[0], lamp]
                cosine = wp.dot(surface.normal, towards)
                if cosine > 0.0:
                    light += (strength * cosine) * lights.diffuse[world % lights.diffuse.shape[0], lamp]
                    highlight = strength * _highlight(surface.normal, towards, surface.back, surface.shininess)
                    shine += highlight * lights.specular[world % lights.specular.shape[0], lamp]
    return light, shine
