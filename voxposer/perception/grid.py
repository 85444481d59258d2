"""The voxel grid over a workspace: world positions in, voxel indices out, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from voxposer.planning import maps

# Voxels along each axis, upstream's; and the fewest with which a path has neighbours to go to
# (``voxposer.planning.config.reach``).
MAP_SIZE, LEAST_MAP_SIZE = 100, 50


@dataclass(frozen=True)
class VoxelGrid:
    """Voxels over a workspace.

    Attributes:
        lo: centre of the first voxel, metres, world frame, [3].
        hi: centre of the last voxel, [3].
        size: N, voxels along each axis.
    """

    lo: np.ndarray
    hi: np.ndarray
    size: int = MAP_SIZE

    @property
    def resolution(self) -> np.ndarray:
        """Edge lengths of a voxel, metres, [3]."""
        return (self.hi - self.lo) / self.size

    def voxel(self, points: np.ndarray) -> np.ndarray:
        """Nearest voxels, int [..., 3], of world positions [..., 3]; positions outside give a voxel at the border."""
        return maps.to_voxel(np.asarray(points), self.lo, self.hi, self.size).astype(int)

    def world(self, voxels: np.ndarray) -> np.ndarray:
        """Centres of voxels [..., 3], metres; voxels may be fractions."""
        return maps.to_world(np.asarray(voxels), self.lo, self.hi, self.size).astype(float)

    def occupancy(self, points: np.ndarray) -> np.ndarray:
        """Voxels that hold one of the points [M, 3], bool [N, N, N]; outside ones count at the border, as upstream."""
        taken = np.zeros((self.size,) * 3, bool)
        taken[tuple(self.voxel(points).T)] = True
        return taken
