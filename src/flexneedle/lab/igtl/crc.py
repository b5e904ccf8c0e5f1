"""CRC-64 of OpenIGTLink: ECMA-182, not reflected, start value 0, no final inversion.

With start value 0 a CRC is linear: the CRC of a block is the exclusive or of one table entry per byte, chosen by the
byte and its distance from the end of the block. The CRC of the data before a block is added to its first eight bytes.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray

_POLYNOMIAL = 0x42F0E1EBA9EA3693
_BLOCK = 512  # bytes; the table has 1 MB


def crc64(data: bytes) -> int:
    """Return the CRC of a body."""
    first = len(data) % _BLOCK
    crc = _reduce(data[:first])
    for begin in range(first, len(data), _BLOCK):
        head = crc ^ int.from_bytes(data[begin : begin + 8], "big")
        crc = _reduce(head.to_bytes(8, "big") + data[begin + 8 : begin + _BLOCK])
    return crc


def _reduce(block: bytes) -> int:
    table, offsets = _tables()
    places = np.frombuffer(block, np.uint8) + offsets[_BLOCK - len(block) :]
    return int(np.bitwise_xor.reduce(table[places]))


@cache
def _tables() -> tuple[NDArray[np.uint64], NDArray[np.intp]]:
    """Return the entries by position in a block and byte, as one row, and the offset of each position."""
    last = np.arange(256, dtype=np.uint64) << np.uint64(56)
    for _ in range(8):
        last = (last << np.uint64(1)) ^ np.where(last >> np.uint64(63), np.uint64(_POLYNOMIAL), np.uint64(0))
    rows = [last]
    for _ in range(_BLOCK - 1):
        rows.append((rows[-1] << np.uint64(8)) ^ last[rows[-1] >> np.uint64(56)])
    return np.concatenate(rows[::-1]), 256 * np.arange(_BLOCK)
