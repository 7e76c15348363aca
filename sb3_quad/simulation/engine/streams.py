"""Counter-based random numbers: a stream per row, so that neither threads nor neighbours change what a row draws.

Every number is Philox4x32 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) of a key and a
counter: the key names the row, the counter is ``(block, step, episode, purpose)``. Nothing is remembered between draws.

``streams``, uint32 of shape ``(4, n)``: key_lo, key_hi, episode, step. Resetting a row adds one to ``episode`` and sets
``step`` to 0; each control step adds one to ``step``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import uint32, uint64

from sb3_quad.simulation.engine.lowlevel import compiled

KEY_LO, KEY_HI, EPISODE, STEP = 0, 1, 2, 3
ROUNDS = 10
_MASK, _SHIFT = uint64(0xFFFFFFFF), uint64(32)
OBSERVATION_NOISE, EPISODE_START = 0, 1  # purposes: the last word of the counter

UIntArray = npt.NDArray[np.uint32]


def stream_key(np_random: np.random.Generator) -> int:
    """A 64-bit key drawn from a seeded generator (Gymnasium's ``self.np_random``)."""
    return int(np_random.integers(2**64, dtype=np.uint64))


def new_streams(keys: npt.NDArray[np.uint64]) -> UIntArray:
    """Streams before their first episode, shape (4, n), from 64-bit keys of shape (n,)."""
    keys = np.asarray(keys, dtype=np.uint64)
    streams = np.zeros((4, keys.shape[0]), dtype=np.uint32)
    streams[KEY_LO] = keys & np.uint64(0xFFFFFFFF)
    streams[KEY_HI] = keys >> np.uint64(32)
    return streams


@compiled(forceinline=True)
def _round(c0, c1, c2, c3, k0, k1):
    # In uint64 whose upper half is left to hold anything: AVX2 multiplies the lower halves of 64-bit lanes.
    p0 = uint64(0xD2511F53) * (c0 & _MASK)
    p1 = uint64(0xCD9E8D57) * (c2 & _MASK)
    return (p1 >> _SHIFT) ^ c1 ^ k0, p1, (p0 >> _SHIFT) ^ c3 ^ k1, p0


@compiled(forceinline=True)
def philox(c0, c1, c2, c3, k0, k1):
    """Philox4x32-10: four uint32 from a counter of four and a key of two."""
    c0, c1, c2, c3, k0, k1 = uint64(c0), uint64(c1), uint64(c2), uint64(c3), uint64(k0), uint64(k1)
    for _ in range(ROUNDS):
        c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
        k0 += uint64(0x9E3779B9)
        k1 += uint64(0xBB67AE85)
    return uint32(c0), uint32(c1), uint32(c2), uint32(c3)


@compiled
def uniforms(streams, row, blocks, purpose):
    """Doubles uniform on (0, 1), of 53 bits each, two per block: shape (2 blocks,)."""
    numbers = np.empty(2 * blocks)
    for block in range(blocks):
        w0, w1, w2, w3 = philox(
            uint32(block),
            streams[STEP, row],
            streams[EPISODE, row],
            uint32(purpose),
            streams[KEY_LO, row],
            streams[KEY_HI, row],
        )
        numbers[2 * block] = (((uint64(w0) << _SHIFT | uint64(w1)) >> uint64(11)) + 0.5) * 2.0**-53
        numbers[2 * block + 1] = (((uint64(w2) << _SHIFT | uint64(w3)) >> uint64(11)) + 0.5) * 2.0**-53
    return numbers
