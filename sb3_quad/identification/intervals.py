"""What logs tell: intervals of the fitted parameters, and which of them remain unknown.

Intervals follow from leaving out one block of the flights at a time (jackknife), with the equations
linearised at the optimum.
"""

import numpy as np
from scipy.stats import t as student

from sb3_quad.base.types import FloatArray
from sb3_quad.identification.prediction_error import Model, Optimum

BLOCKS = 20
# Half an interval, as a part of its value, beyond which the logs do not tell a parameter
LARGEST_WIDTH = 1.0


def jackknife(slopes: FloatArray, errors: FloatArray) -> FloatArray:
    """Return half of the 95 % intervals by leaving out one block of windows at a time, (keys,).

    :param slopes: of the errors, (windows, n, keys).
    :param errors: (windows, n).
    """
    count = min(BLOCKS, len(errors))
    squares = []
    products = []
    for rows in np.array_split(np.arange(len(errors)), count):
        block = np.concatenate(slopes[rows])
        squares.append(block.T @ block)
        products.append(block.T @ errors[rows].ravel())
    left = np.sum(squares, axis=0) - squares
    right = np.sum(products, axis=0) - products
    shifts = np.einsum("bij,bj->bi", np.linalg.pinv(left), right)
    spread = np.std(shifts, axis=0) * np.sqrt(count - 1)
    widths: FloatArray = student.ppf(0.975, count - 1) * spread
    return widths


def not_told(model: Model, optimum: Optimum) -> dict[int, str]:
    """Return which elements of the vector the logs do not tell, and why.

    The least certain one is held first, which makes the others more certain.
    """
    held = {}
    free = model.free()
    values = optimum.vector[free]
    units = model.scale[free]
    # A value that runs away says nothing.
    least, most = model.table.loc[free, ["least", "most"]].to_numpy().T
    far = (least > 0.0) & ((values < 1.02 * least) | (values > 0.98 * most))
    for k in np.flatnonzero(far):
        held[k] = f"it would run to {values[k] * units[k]:.2g}"
    # Thrust and delay are always fitted.
    always = len(model.start.curve.coefficients) + 1
    while True:
        kept = np.setdiff1d(range(len(free)), [*held])
        widths = jackknife(optimum.slopes[:, :, kept], optimum.errors)
        shares = widths / np.maximum(np.abs(values[kept]), 1e-9)
        shares[:always] = 0.0
        worst = shares.argmax()
        if shares[worst] <= LARGEST_WIDTH:
            break
        k = kept[worst]
        held[k] = f"its interval would be ± {widths[worst] * units[k]:.2g}"
    return {int(free[k]): reason for k, reason in held.items()}
