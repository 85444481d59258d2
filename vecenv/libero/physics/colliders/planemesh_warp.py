"""Contacts of a mesh on a plane as MuJoCo 2.3 to 3.3 chose them, as a Warp function for CUDA and the CPU.

The method is that of ``vecenv.libero.physics.colliders.planemesh``; signature and result are those of MuJoCo Warp's
``plane_convex``, in whose place it is called (``vecenv.libero.physics.mjx.contacts``), and which still serves meshes
without a hull.
"""

# In Warp, int(0) makes a variable that a loop may change; a literal is a constant.
# ruff: noqa: RUF046, UP018
# The bodies are Warp's language, whose overloads pyright does not know.
# pyright: basic, reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportReturnType=false, reportAttributeAccessIssue=false

from __future__ import annotations

import warp as wp

from vecenv.libero.physics.private import Geom, mat43, warp_collision_primitive

MOST = 3
_APART = 0.3
_FAR = 1e10

_without_hull = warp_collision_primitive.plane_convex

wp.set_module_options({"enable_backward": False})


@wp.func
def plane_convex(plane_normal: wp.vec3, plane_pos: wp.vec3, convex: Geom, margin: float):
    """Distances [4] and positions [4, 3] of the contacts, and the plane's normal; distances of the others are huge.

    Args:
        plane_normal: unit normal, world frame.
        plane_pos: a point of the plane, metres.
        convex: the mesh, with the graph of its hull.
        margin: contacts up to this distance are reported, metres.
    """
    if convex.graphadr < 0:
        return _without_hull(plane_normal, plane_pos, convex, margin)
    dist = wp.vec4(_FAR)
    pos = mat43()
    hull_vertices = convex.graph[convex.graphadr]
    edges_begin = convex.graphadr + 2
    vertex_ids = edges_begin + hull_vertices
    neighbours = vertex_ids + hull_vertices
    lowest = _lowest(plane_normal, convex, edges_begin, vertex_ids, neighbours)
    first = _vertex(convex, vertex_ids + lowest)
    height = wp.dot(plane_normal, first - plane_pos)
    if height > margin:
        return dist, pos, plane_normal
    dist[0] = height
    pos[0] = first - 0.5 * height * plane_normal
    apart = _APART * _radius(convex)
    found = int(1)
    edge = neighbours + convex.graph[edges_begin + lowest]
    while convex.graph[edge] >= 0 and found < wp.static(MOST):
        place = _vertex(convex, vertex_ids + convex.graph[edge])
        height = wp.dot(plane_normal, place - plane_pos)
        if height <= margin and wp.length(place - pos[0]) >= apart:
            dist[found] = height
            pos[found] = place - 0.5 * height * plane_normal
            found += 1
        edge += 1
    return dist, pos, plane_normal


@wp.func
def _vertex(convex: Geom, vertex_id: int) -> wp.vec3:
    """A vertex of the hull, world frame."""
    return convex.pos + convex.rot @ convex.vert[convex.vertadr + convex.graph[vertex_id]]


@wp.func
def _lowest(plane_normal: wp.vec3, convex: Geom, edges_begin: int, vertex_ids: int, neighbours: int) -> int:
    """Number of the hull's lowest vertex, reached from the first along its edges."""
    down = -(wp.transpose(convex.rot) @ plane_normal)
    best = int(0)
    depth = wp.dot(down, convex.vert[convex.vertadr + convex.graph[vertex_ids]])
    before = int(-1)
    while best != before:
        before = best
        edge = neighbours + convex.graph[edges_begin + before]
        while convex.graph[edge] >= 0:
            value = wp.dot(down, convex.vert[convex.vertadr + convex.graph[vertex_ids + convex.graph[edge]]])
            if value > depth:
                best = convex.graph[edge]
                depth = value
            edge += 1
    return best


@wp.func
def _radius(convex: Geom) -> float:
    """The bounding radius that MuJoCo gives a mesh: as far as its furthest coordinates together reach."""
    furthest = wp.vec3()
    for n in range(convex.vertnum):
        furthest = wp.max(furthest, wp.abs(convex.vert[convex.vertadr + n]))
    return wp.length(furthest)
