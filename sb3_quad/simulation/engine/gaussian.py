"""Standard normal numbers for a block of rows: Philox4x32 and Box-Muller in float32, lane by lane.

The logarithm, sine and cosine are short polynomials instead of library calls, so that the loops vectorise; their error
(1e-7) is far below what any test of the numbers could see. The largest number there can be is 6.6.
"""

from __future__ import annotations

import math

import numpy as np
from numba import float32, int32, uint32

from sb3_quad.simulation.engine.blocks import KEY_ROW, NOISE, WORD
from sb3_quad.simulation.engine.lowlevel import LANES, as_float32, as_int32, compiled, float32_rows, uint32_rows
from sb3_quad.simulation.engine.streams import EPISODE, KEY_HI, KEY_LO, OBSERVATION_NOISE, STEP, philox

NORMALS = 18  # per row and control step
_SQRT_HALF_BITS = 0x3F3504F3  # of sqrt(1/2)
_ONE_BITS = 0x3F800000
_LN2 = float32(math.log(2.0))
_TO_UNIT = float32(2.0**-31)
_TO_ANGLE = float32(2.0 * math.pi * 2.0**-32)


@compiled
def draw_words(scratch):
    """20 random words per lane, from the lane's key and counter."""
    w = uint32_rows(scratch)
    for block in range((NORMALS + 3) // 4):
        for lane in range(LANES):
            w0, w1, w2, w3 = philox(
                uint32(block),
                w[KEY_ROW + STEP, lane],
                w[KEY_ROW + EPISODE, lane],
                uint32(OBSERVATION_NOISE),
                w[KEY_ROW + KEY_LO, lane],
                w[KEY_ROW + KEY_HI, lane],
            )
            w[WORD + 4 * block, lane] = w0
            w[WORD + 4 * block + 1, lane] = w1
            w[WORD + 4 * block + 2, lane] = w2
            w[WORD + 4 * block + 3, lane] = w3


@compiled(forceinline=True)
def _log(x):
    """ln x of a positive float32: the exponent, and a polynomial on [sqrt(1/2), sqrt(2))."""
    bits = as_int32(x)
    exponent = int32(int32(bits - int32(_SQRT_HALF_BITS)) >> int32(23))
    m = as_float32(int32(bits - int32(exponent << int32(23)))) - float32(1.0)
    p = float32(7.0376836292e-2)
    for coefficient in (
        *(-1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1),
        *(-1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1),
    ):
        p = p * m + float32(coefficient)
    return m + m * m * (m * p - float32(0.5)) + float32(exponent) * _LN2


@compiled(fastmath=True)
def draw_normals(scratch):
    """18 standard normals per lane from its 20 words."""
    w = uint32_rows(scratch)
    b = float32_rows(scratch)
    for pair in range(NORMALS // 2):
        for lane in range(LANES):
            u = (float32(int32(w[WORD + 2 * pair, lane] >> uint32(1))) + float32(0.5)) * _TO_UNIT
            radius = np.sqrt(float32(-2.0) * _log(u))
            word = w[WORD + 2 * pair + 1, lane]
            quadrant = int32(uint32(word + uint32(0x20000000)) >> uint32(30))
            t = float32(int32(uint32(word - (uint32(quadrant) << uint32(30))))) * _TO_ANGLE
            t2 = t * t
            sine = t + t * t2 * (float32(-1.6666654611e-1) + t2 * (float32(8.3321608736e-3) + t2 * float32(-1.9515295891e-4)))
            p = float32(4.166664568298827e-2) + t2 * (float32(-1.388731625493765e-3) + t2 * float32(2.443315711809948e-5))
            cosine = float32(1.0) - float32(0.5) * t2 + t2 * t2 * p
            odd = (quadrant & 1) != 0
            first = sine if odd else cosine
            second = cosine if odd else sine
            first_sign = int32((quadrant ^ (quadrant >> int32(1))) & int32(1)) << int32(31)
            second_sign = int32(quadrant >> int32(1)) << int32(31)
            b[NOISE + 2 * pair, lane] = radius * as_float32(int32(as_int32(first) ^ first_sign))
            b[NOISE + 2 * pair + 1, lane] = radius * as_float32(int32(as_int32(second) ^ second_sign))
