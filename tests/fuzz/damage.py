"""Random damage to files: flipped bits, truncation, and blocks that are removed, repeated, exchanged or zeroed."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Sequence
from random import Random

Damage = Callable[[Random, bytearray], None]
Engine = Callable[[Random, bytes], bytes]  # returns damaged contents

MAX_BLOCK = 400  # bytes that one damage affects
INTEGER_FORMATS = "bhiq"  # of `struct`: whole numbers of 1, 2, 4 and 8 bytes, as headers hold them
BOUNDARIES = (0, 1, -1, 2, 7, 16, 255, 256, 1000, 65535, 65536, 10**6, 2**31 - 1, -(2**31), 2**32, 2**62, 2**63 - 1)


def _position(rng: Random, data: bytearray) -> int:
    return rng.randrange(len(data)) if data else 0


def flip(rng: Random, data: bytearray) -> None:
    """Flip a bit."""
    if data:
        data[_position(rng, data)] ^= 1 << rng.randrange(8)


def overwrite(rng: Random, data: bytearray) -> None:
    """Overwrite some bytes."""
    start = _position(rng, data)
    data[start : start + rng.randint(1, 16)] = rng.randbytes(rng.randint(1, 16))


def number(rng: Random, data: bytearray) -> None:
    """Overwrite some bytes by a boundary value, as a header may hold it."""
    start, size = _position(rng, data), struct.calcsize(rng.choice(INTEGER_FORMATS))
    value = rng.choice(BOUNDARIES) % 2 ** (8 * size)
    data[start : start + size] = value.to_bytes(size, rng.choice(("little", "big")))


def truncate(rng: Random, data: bytearray) -> None:
    """Remove the end."""
    del data[_position(rng, data) :]


def remove(rng: Random, data: bytearray) -> None:
    """Remove a block."""
    start = _position(rng, data)
    del data[start : start + rng.randint(1, MAX_BLOCK)]


def insert(rng: Random, data: bytearray) -> None:
    """Insert a random block."""
    start = _position(rng, data)
    data[start:start] = rng.randbytes(rng.randint(1, MAX_BLOCK))


def zero(rng: Random, data: bytearray) -> None:
    """Overwrite a block by zeros, as a failing disk does."""
    start = _position(rng, data)
    size = min(rng.randint(1, MAX_BLOCK), len(data) - start)
    data[start : start + size] = bytes(size)


def repeat(rng: Random, data: bytearray) -> None:
    """Repeat a block."""
    start = _position(rng, data)
    data[start:start] = data[start : start + rng.randint(1, MAX_BLOCK)]


def swap(rng: Random, data: bytearray) -> None:
    """Exchange two blocks of the same size."""
    size = rng.randint(1, max(1, min(MAX_BLOCK, len(data) // 2)))
    start, other = sorted(rng.randrange(max(1, len(data) - size + 1)) for _ in range(2))
    first, second = bytes(data[start : start + size]), bytes(data[other : other + size])
    if other - start >= size:
        data[start : start + size], data[other : other + size] = second, first


DAMAGES: tuple[Damage, ...] = (flip, flip, overwrite, number, truncate, remove, insert, zero, repeat, swap)


def damaged(rng: Random, original: bytes) -> bytes:
    """Return the bytes after one to four random damages."""
    data = bytearray(original)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(DAMAGES)(rng, data)
    return bytes(data)


def damaged_near(rng: Random, original: bytes, marks: Sequence[bytes], room: int = 24) -> bytes:
    """Return the bytes with a number or some bytes changed within `room` bytes after one of the marks of a header."""
    data = bytearray(original)
    for _ in range(rng.choice((1, 1, 2))):
        ends = [found.end() for found in re.finditer(b"(?s)" + re.escape(rng.choice(marks)), bytes(data))]
        if ends:
            start = rng.choice(ends)
            window = data[start : start + room]
            rng.choice((number, number, overwrite, flip, zero))(rng, window)
            data[start : start + room] = window
    return bytes(data)


def marked(*marks: bytes) -> Engine:
    """Damage near the marks of a header or anywhere."""
    return lambda rng, original: damaged_near(rng, original, marks) if rng.random() < 0.5 else damaged(rng, original)


def words_exchanged(separators: bytes, *extreme: str) -> Engine:
    """Exchange one or two words between separators, a regular expression, for extreme ones, or damage any bytes."""

    def exchange(rng: Random, original: bytes) -> bytes:
        if rng.random() < 0.3:
            return damaged(rng, original)
        words = re.split(b"(" + separators + b")", original)
        for _ in range(rng.choice((1, 1, 2))):
            words[2 * rng.randrange((len(words) + 1) // 2)] = rng.choice(extreme).encode(errors="surrogatepass")
        return b"".join(words)

    return exchange
