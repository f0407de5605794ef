"""A pinhole camera: the rays of its pixels, and where points appear."""

from dataclasses import dataclass

import numpy as np

from gi_core.arrays import Float32, Float64

ASPECT = 9 / 16


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole. eye, look : (3,) float64 [m], world frame; fov_degrees is horizontal; width in pixels."""

    eye: Float64
    look: Float64
    fov_degrees: float
    width: int

    @property
    def height(self) -> int:
        return max(int(self.width * ASPECT), 1)

    @property
    def axes(self) -> Float64:
        """(3, 3) unit, world frame: towards the right of the picture, up, and into it."""
        forward = (self.look - self.eye) / np.linalg.norm(self.look - self.eye)
        up_hint = np.array([0.0, 1.0, 0.0]) if abs(forward[1]) < 0.9999 else np.array([0.0, 0.0, -1.0])
        right = np.cross(forward, up_hint)
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    @property
    def pixel_size(self) -> float:
        """Edge of a pixel at the picture's centre, as a share of the distance."""
        return float(2 * np.tan(np.radians(self.fov_degrees) / 2) / self.width)

    def rays(self) -> Float32:
        """(height * width, 3) float32 unit directions through pixel centres, rows from the top, world frame."""
        right, up, forward = self.axes
        across = (np.arange(self.width) + 0.5 - self.width / 2) * self.pixel_size
        down = (np.arange(self.height) + 0.5 - self.height / 2) * self.pixel_size
        directions = forward + across[None, :, None] * right - down[:, None, None] * up
        directions /= np.linalg.norm(directions, axis=2, keepdims=True)
        return np.ascontiguousarray(directions.reshape(-1, 3), np.float32)

    def project(self, points: Float64) -> Float64:
        """Where world points (n, 3) [m] appear: (n, 3) of column, row [pixels, a pixel's centre is whole] and depth along the view [m].

        Column and row of points at a depth of 0 and less mean nothing.
        """
        across, up, depth = self.axes @ (points - self.eye).T
        scale = self.pixel_size * np.where(depth > 0, depth, 1.0)
        return np.stack([across / scale + (self.width - 1) / 2, (self.height - 1) / 2 - up / scale, depth], axis=1)
