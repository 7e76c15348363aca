"""Counter-based random numbers: a stream per row, so that neither threads nor neighbouring rows
change the numbers of a row.

Every number is Philox4x32 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011)
of a key and a counter: the key names the row, the counter is ``(block, step, episode, purpose)``.
No state is kept between numbers.

``streams``, uint32 of shape ``(4, n)``: key_lo, key_hi, episode, step. Resetting a row adds one to
``episode`` and sets ``step`` to 0; each control step adds one to ``step``.

Normals are Box-Muller in float32, lane by lane. The logarithm, sine and cosine are short
polynomials instead of library calls, so that the loops vectorise; their error (1e-7) is far below
what any test of the numbers could see. The largest possible normal is 6.7.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from numba import float32, int32, uint32, uint64

from sb3_quad.base.compiled import LANES, called, fast, inlined, inner
from sb3_quad.base.seeds import seed_errors
from sb3_quad.envs.simulation.vectors import polynomial

KEY_LO, KEY_HI, EPISODE, STEP = range(4)
# Purposes: the last word of the counter. numba would compile a function for each int.
OBSERVATION_NOISE, EPISODE_START, VEHICLE, DISTURBANCE, GUST = np.arange(5, dtype=np.uint32)
DISTRIBUTION, WIND, REFERENCE, AIR, ESTIMATOR, RECORDING = np.arange(5, 11, dtype=np.uint32)
RATE_LOOP = np.uint32(11)
ROUNDS = 10
BLOCKS = 8  # as many as any purpose takes
_MASK = uint64(0xFFFFFFFF)
_SHIFT = uint64(32)
# The bits of sqrt(1/2) in float32
_SQRT_HALF_BITS = 0x3F3504F3
_LN2 = float32(math.log(2.0))
# Coefficients of the polynomials, the highest power first
_LOG = tuple(
    np.array(
        [
            7.0376836292e-2,
            -1.1514610310e-1,
            1.1676998740e-1,
            -1.2420140846e-1,
            1.4249322787e-1,
            -1.6668057665e-1,
            2.0000714765e-1,
            -2.4999993993e-1,
            3.3333331174e-1,
        ],
        np.float32,
    )
)
_SINE = tuple(np.array([-1.9515295891e-4, 8.3321608736e-3, -1.6666654611e-1], np.float32))
_COSINE = tuple(
    np.array([2.443315711809948e-5, -1.388731625493765e-3, 4.166664568298827e-2], np.float32)
)
_TO_UNIT = float32(2.0**-31)
_TO_ANGLE = float32(2.0 * math.pi * 2.0**-32)


def new_streams(seeds: Sequence[int | None]) -> npt.NDArray[np.uint32]:
    """Return streams before their first episode, shape (4, n), from n seeds.

    A key is the first number of NumPy's generator of the seed, which is Gymnasium's as well. With
    None it comes from the operating system's entropy.
    """
    streams = np.zeros((4, len(seeds)), dtype=np.uint32)
    for row, seed in enumerate(seeds):
        with seed_errors(seed):
            key = np.random.default_rng(seed).integers(2**64, dtype=np.uint64)
        streams[KEY_LO : KEY_HI + 1, row] = divmod(int(key), 2**32)[::-1]
    return streams


@inner
def _round(c0, c1, c2, c3, k0, k1):
    # In uint64 whose upper half may hold anything: AVX2 multiplies the lower halves of 64-bit
    # lanes.
    p0 = uint64(0xD2511F53) * (c0 & _MASK)
    p1 = uint64(0xCD9E8D57) * (c2 & _MASK)
    return (p1 >> _SHIFT) ^ c1 ^ k0, p1, (p0 >> _SHIFT) ^ c3 ^ k1, p0


@inner
def philox(c0, c1, c2, c3, k0, k1):
    """Return four uint32 of Philox4x32-10 from a counter of four and a key of two."""
    c0, c1, c2, c3, k0, k1 = uint64(c0), uint64(c1), uint64(c2), uint64(c3), uint64(k0), uint64(k1)
    for _ in range(ROUNDS):
        c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
        k0 += uint64(0x9E3779B9)
        k1 += uint64(0xBB67AE85)
    return uint32(c0), uint32(c1), uint32(c2), uint32(c3)


@inner
def _words(streams, row, block, purpose):
    counter = uint32(block), streams[STEP, row], streams[EPISODE, row], uint32(purpose)
    return philox(*counter, streams[KEY_LO, row], streams[KEY_HI, row])


@called
def uniforms(streams, row, purpose):
    """Return doubles uniform on (0, 1), of 53 bits each, two per block: shape (2 BLOCKS,)."""
    numbers = np.empty(2 * BLOCKS)
    for block in range(BLOCKS):
        w0, w1, w2, w3 = _words(streams, row, block, purpose)
        numbers[2 * block] = _to_uniform(w0, w1)
        numbers[2 * block + 1] = _to_uniform(w2, w3)
    return numbers


@inner
def _to_uniform(high, low):
    return (((uint64(high) << _SHIFT | uint64(low)) >> uint64(11)) + 0.5) * 2.0**-53


@called
def random_words(b, purpose):
    """Write ``b.word``: random words of every lane, a multiple of 4, from its key and counter."""
    word = b.word
    for lane in range(LANES):
        # All blocks of a lane share its keys and their first round.
        for block in range(word.shape[0] // 4):
            # Written out, since a loop over the four would not be vectorised.
            (
                word[4 * block, lane],
                word[4 * block + 1, lane],
                word[4 * block + 2, lane],
                word[4 * block + 3, lane],
            ) = _words(b.stream, lane, block, purpose)


@inner
def gust_words(word, stream):
    """Write two random words of every lane to ``word``, (2, LANES), for the gusts of the wind."""
    for lane in range(LANES):
        word[0, lane], word[1, lane], _, _ = _words(stream, lane, 0, WIND)


@inner
def _log(x):
    """Return ln x of a positive float32: the exponent, and a polynomial on [√½, √2)."""
    bits = np.float32(x).view(np.int32)
    exponent = int32(int32(bits - int32(_SQRT_HALF_BITS)) >> int32(23))
    m = np.int32(bits - int32(exponent << int32(23))).view(np.float32) - float32(1.0)
    p = m * polynomial(m, _LOG) - float32(0.5)
    return m + m * m * p + float32(exponent) * _LN2


@fast
def standard_normals(b):
    """Write ``b.noise``: standard normals of every lane, two from each pair of its first words
    (Box-Muller).
    """
    word = b.word
    noise = b.noise
    for pair in range(noise.shape[0] // 2):
        for lane in range(LANES):
            u = (float32(int32(word[2 * pair, lane] >> uint32(1))) + float32(0.5)) * _TO_UNIT
            radius = np.sqrt(float32(-2.0) * _log(u))
            turn = word[2 * pair + 1, lane]
            quadrant = int32(uint32(turn + uint32(0x20000000)) >> uint32(30))
            t = float32(int32(uint32(turn - (uint32(quadrant) << uint32(30))))) * _TO_ANGLE
            t2 = t * t
            sine = t + t * t2 * polynomial(t2, _SINE)
            cosine = float32(1.0) - float32(0.5) * t2 + t2 * t2 * polynomial(t2, _COSINE)
            odd = (quadrant & 1) != 0
            first = sine if odd else cosine
            second = cosine if odd else sine
            first_sign = int32((quadrant ^ (quadrant >> int32(1))) & int32(1)) << int32(31)
            second_sign = int32(quadrant >> int32(1)) << int32(31)
            noise[2 * pair, lane] = radius * _flip_sign(first, first_sign)
            noise[2 * pair + 1, lane] = radius * _flip_sign(second, second_sign)


@inlined
def _flip_sign(x, sign_bit):
    return np.int32(np.float32(x).view(np.int32) ^ sign_bit).view(np.float32)
