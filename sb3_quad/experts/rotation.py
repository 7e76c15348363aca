"""Rotation matrices and quaternions (w, x, y, z; body to world)."""

import numpy as np

from sb3_quad.base.arrays import FloatArray


def nearest_rotation(matrices: FloatArray) -> FloatArray:
    """The rotation nearest to each matrix in the Frobenius norm, shape (n, 3, 3) (orthogonal Procrustes problem)."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return np.asarray(u @ vt)


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternions, shape (n, 4), of rotation matrices of shape (n, 3, 3); w is not negative.

    Each row is taken from the largest of the four squared components, so no division is by a small number.
    """
    r = rotation
    trace = np.einsum("nii->n", r)
    diagonal = np.einsum("nii->ni", r)
    products = np.empty((len(r), 4, 4))  # 4 q qᵀ
    products[:, 0, 0] = 1 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[:, i + 1, i + 1] = 1 - trace + 2 * diagonal[:, i]
        products[:, 0, i + 1] = products[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        products[:, j + 1, k + 1] = products[:, k + 1, j + 1] = r[:, k, j] + r[:, j, k]
    largest = np.argmax(np.einsum("nii->ni", products), axis=1)
    quaternion = products[np.arange(len(r)), largest]
    quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
    return np.asarray(quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True))
