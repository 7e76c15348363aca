"""Triangle meshes for what PyBullet has no shape for: an arrow and a ring, as surfaces of revolution."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Mesh = dict[str, list[list[float]] | list[int]]


def arrow(length: float, radius: float) -> Mesh:
    """An arrow along +z from the origin, as the arguments of ``createVisualShape``."""
    neck, head = 0.72 * length, 2.4 * radius
    profile = [(0, 0), (radius, 0), (radius, neck), (head, neck), (0, length)]
    return revolve(np.repeat(np.array(profile, dtype=np.float64), 2, axis=0)[1:-1], segments=20)


def ring(radius: float, thickness: float) -> Mesh:
    """A ring about the z axis, as the arguments of ``createVisualShape``."""
    angle = np.linspace(0.0, 2.0 * np.pi, 9)
    profile = np.stack([radius + thickness * np.cos(angle), thickness * np.sin(angle)], axis=1)
    return revolve(profile, segments=48)


def revolve(profile: npt.NDArray[np.float64], segments: int) -> Mesh:
    """The surface that a line in the r-z half plane sweeps out about the z axis.

    :param profile: (k, 2), radius and height, so that the outside lies to the right of its direction; a doubled point
        makes an edge.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, segments, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = np.diff(profile, axis=0)
    slope = np.stack([along[:, 1], -along[:, 0]], axis=1)
    slope /= np.maximum(np.linalg.norm(slope, axis=1, keepdims=True), 1e-12)
    # A point's normal is the mean of its two lines'; a doubled point's line between has none, which keeps the edge.
    normal = np.concatenate([slope[:1], slope]) + np.concatenate([slope, slope[-1:]])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)

    def sweep(points: npt.NDArray[np.float64]) -> list[list[float]]:
        around = points[:, None, :1] * direction[None]
        height = np.broadcast_to(points[:, None, 1:], (len(points), segments, 1))
        return np.concatenate([around, height], axis=2).reshape(-1, 3).tolist()

    row, column = np.meshgrid(np.arange(len(profile) - 1), np.arange(segments), indexing="ij")
    a, b = row * segments + column, row * segments + (column + 1) % segments
    c, d = a + segments, b + segments
    indices = np.stack([a, b, d, a, d, c], axis=-1).ravel().tolist()
    return {"vertices": sweep(profile), "indices": indices, "normals": sweep(normal)}
