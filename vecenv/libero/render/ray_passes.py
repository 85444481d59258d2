"""The passes of an image: one ray a pixel, or some more where neighbouring pixels differ.

MuJoCo Warp's renderer launches its kernel once for each sample of a pixel, adds the samples up, and divides the sums by
their number. With antialiasing there are four such passes, which do something else:

0. every pixel's ray through its middle is traced, and counts as all four samples;
1. pixels that differ from their neighbours are collected in a queue, so that threads next to each other have work;
2. the pixels in the queue are traced through four other points, those where GL takes its samples;
3. nothing.

The queue of a world is a row: a slot for each pixel, in segments whose counts are behind the slots. Which slot of its
segment a pixel gets depends on the order of threads, but the image does not.
"""

# Warp tells variables from constants by calls such as `float(0.0)`, and knows `wp.static` only alone in a test.
# ruff: noqa: UP018, RUF046, SIM102
# Type checkers know neither its arrays nor its arithmetic.
# pyright: reportArgumentType=false, reportAssignmentType=false, reportAttributeAccessIssue=false
# pyright: reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# pyright: reportOperatorIssue=false, reportReturnType=false

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import warp as wp

from vecenv.libero.physics.private import build_rays, pack_rgba_to_uint32
from vecenv.libero.render.ray_trace import make_follow
from vecenv.libero.render.ray_types import Cameras, Images, Scene

if TYPE_CHECKING:
    from vecenv.libero.physics.private import RenderContext

# Where Mesa and NVIDIA take four samples of a pixel, in eighths of its width and height.
EIGHTHS = ((3, 1), (7, 3), (1, 5), (5, 7))
# The passes of MuJoCo Warp's renderer, samples per pixel along each side squared, which antialiasing needs.
PASSES_PER_SIDE = 2
# Pixels of a segment of the queue.
SEGMENT = 2048
# Pixels are traced again if a channel's second difference to two opposite neighbours is larger than this, of 255.
CONTRAST = 64.0


def aimed_rays(model: mujoco.MjModel, cameras: Sequence[int], height: int, width: int) -> wp.array:
    """Directions of the rays of antialiasing, in the frames of the cameras, vec3 [5 * C * H * W].

    First those through the middles of all pixels, rows from the top, then those through the four other points.
    """
    points = [(1, 0, 0), *((4, x // 2, y // 2) for x, y in EIGHTHS)]
    area = height * width
    found, unused = (wp.zeros(len(points) * len(cameras) * area, dtype=wp.vec3) for _ in range(2))
    for number, ((per_side, x, y), camera) in enumerate(itertools.product(points, cameras)):
        lens = [
            int(model.cam_projection[camera]),
            float(model.cam_fovy[camera]),
            wp.vec2(*model.cam_sensorsize[camera].tolist()),
            wp.vec4(*model.cam_intrinsic[camera].tolist()),
            float(model.vis.map.znear * model.stat.extent),
        ]
        inputs = [number * area, width, height, *lens, per_side, x, y]
        wp.launch(build_rays, dim=(width, height), inputs=inputs, outputs=[found, unused])
    return found


def empty_queue(num_worlds: int, pixels: int) -> wp.array:
    """A queue: for each world a slot for each of its pixels, and a count for each segment."""
    return wp.zeros((num_worlds, pixels + -(-pixels // SEGMENT)), dtype=int)


def make_contrast(height: int, width: int, tile: tuple[int, int]) -> wp.Function:
    """A device function for how much a pixel differs from its neighbours, in a buffer in the order of tiles.

    Args:
        height, width: of each image, pixels.
        tile: rows and columns of a tile, which divide them.
    """
    rows, columns = tile
    across, area = width // columns, rows * columns

    @wp.func
    def place(image: int, row: int, column: int) -> int:
        """Index into the buffer."""
        block = (row // wp.static(rows)) * wp.static(across) + column // wp.static(columns)
        inside = (row % wp.static(rows)) * wp.static(columns) + column % wp.static(columns)
        return image * wp.static(height * width) + block * wp.static(area) + inside

    @wp.func
    def contrast(sums: wp.array2d[wp.vec3], world: int, pixel: int) -> float:
        """The largest second difference of a channel, across or down; pixels beyond the border equal the pixel."""
        image, rest = pixel // wp.static(height * width), pixel % wp.static(height * width)
        block, inside = rest // wp.static(area), rest % wp.static(area)
        row = (block // wp.static(across)) * wp.static(rows) + inside // wp.static(columns)
        column = (block % wp.static(across)) * wp.static(columns) + inside % wp.static(columns)
        own = sums[world, pixel]
        left = sums[world, place(image, row, wp.max(column - 1, 0))]
        right = sums[world, place(image, row, wp.min(column + 1, wp.static(width - 1)))]
        above = sums[world, place(image, wp.max(row - 1, 0), column)]
        below = sums[world, place(image, wp.min(row + 1, wp.static(height - 1)), column)]
        return wp.max(wp.max(wp.abs(left + right - 2.0 * own)), wp.max(wp.abs(above + below - 2.0 * own)))

    return contrast


def make_trace(model: mujoco.MjModel, context: RenderContext, tile: tuple[int, int], antialias: bool) -> wp.Function:
    """A device function that traces one pixel in one pass and writes what it found.

    Args:
        model: the scenery's model.
        context: its render context.
        tile: rows and columns of the tiles that the context's rays and buffers are in.
        antialias: whether the passes are those of antialiasing, or one for each sample.
    """
    follow = make_follow(model, context)
    width, height = (int(side) for side in context.cam_res.numpy()[0])
    contrast = make_contrast(height, width, tile)
    pixels, supersampled = int(context.total_rays), context.samples_per_pixel > 1
    has_rgb, samples = bool(context.render_rgb.numpy().all()), len(EIGHTHS)

    @wp.func
    def trace(scene: Scene, cameras: Cameras, images: Images, world: int, pixel: int):
        turn = cameras.first_ray // wp.static(pixels)
        first, count, target = turn, int(1), pixel
        if wp.static(antialias):
            segment, slot = pixel // wp.static(SEGMENT), pixel % wp.static(SEGMENT)
            if turn > 0:
                count = 0
            elif slot == 0:
                images.queue[world, wp.static(pixels) + segment] = 0
            if turn == 1:
                if contrast(images.sums, world, pixel) > wp.static(samples * CONTRAST):
                    slot = wp.atomic_add(images.queue, world, wp.static(pixels) + segment, 1)
                    images.queue[world, segment * wp.static(SEGMENT) + slot] = pixel
            if turn == 2:
                if slot < images.queue[world, wp.static(pixels) + segment]:
                    first, count = 1, wp.static(samples)
                    target = images.queue[world, pixel]
        seen, done = wp.vec3(0.0), int(0)
        while done < count:
            seen += follow(scene, cameras, images, world, target, first + done) + wp.vec3(0.5)  # packing truncates
            done += 1
        if wp.static(has_rgb):
            if wp.static(not supersampled):
                images.rgb[world, pixel] = pack_rgba_to_uint32(seen[0], seen[1], seen[2], 255.0)
            if wp.static(supersampled and not antialias):
                images.sums[world, pixel] += seen
            if wp.static(antialias):
                if turn == 0:
                    images.sums[world, pixel] = wp.static(float(samples)) * seen
                elif count > 0:
                    images.sums[world, target] = seen

    return trace
