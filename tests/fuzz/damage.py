"""What happens to files on the way: bits flip, ends go missing, blocks come twice, elsewhere or as zeros."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from random import Random

Harm = Callable[[Random, bytearray], None]

MOST = 400  # bytes that one damage touches, at most
WIDTHS = "bhiq"  # of whole numbers in headers, as `struct` calls them: 1, 2, 4 and 8 bytes
TELLING = (0, 1, -1, 2, 7, 16, 255, 256, 1000, 65535, 65536, 10**6, 2**31 - 1, -(2**31), 2**32, 2**62, 2**63 - 1)


def _place(rng: Random, data: bytearray) -> int:
    return rng.randrange(len(data)) if data else 0


def flip(rng: Random, data: bytearray) -> None:
    """Flip a bit."""
    if data:
        data[_place(rng, data)] ^= 1 << rng.randrange(8)


def overwrite(rng: Random, data: bytearray) -> None:
    """Write other bytes over some."""
    start = _place(rng, data)
    data[start : start + rng.randint(1, 16)] = rng.randbytes(rng.randint(1, 16))


def number(rng: Random, data: bytearray) -> None:
    """Write a number that means something over some bytes, as a header may hold it."""
    start, width = _place(rng, data), rng.choice(WIDTHS)
    size = struct.calcsize(width)
    value = rng.choice(TELLING) % 2 ** (8 * size)
    data[start : start + size] = value.to_bytes(size, rng.choice(("little", "big")))


def cut(rng: Random, data: bytearray) -> None:
    """Lose the end."""
    del data[_place(rng, data) :]


def remove(rng: Random, data: bytearray) -> None:
    """Lose some bytes in the middle."""
    start = _place(rng, data)
    del data[start : start + rng.randint(1, MOST)]


def insert(rng: Random, data: bytearray) -> None:
    """Gain some bytes in the middle."""
    start = _place(rng, data)
    data[start:start] = rng.randbytes(rng.randint(1, MOST))


def zero(rng: Random, data: bytearray) -> None:
    """Have zeros in place of a block, as a disk leaves them."""
    start = _place(rng, data)
    size = min(rng.randint(1, MOST), len(data) - start)
    data[start : start + size] = bytes(size)


def double(rng: Random, data: bytearray) -> None:
    """Have a block twice."""
    start = _place(rng, data)
    block = data[start : start + rng.randint(1, MOST)]
    data[start:start] = block


def swap(rng: Random, data: bytearray) -> None:
    """Have two blocks of one size change their places."""
    size = rng.randint(1, max(1, min(MOST, len(data) // 2)))
    one, other = sorted(rng.randrange(max(1, len(data) - size + 1)) for _ in range(2))
    first, second = bytes(data[one : one + size]), bytes(data[other : other + size])
    if other - one >= size:
        data[one : one + size], data[other : other + size] = second, first


HARMS: tuple[Harm, ...] = (flip, flip, overwrite, number, cut, remove, insert, zero, double, swap)


def damaged(rng: Random, original: bytes) -> bytes:
    """The bytes after one to four accidents."""
    data = bytearray(original)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        rng.choice(HARMS)(rng, data)
    return bytes(data)


def near(rng: Random, original: bytes, marks: Sequence[bytes], room: int = 24) -> bytes:
    """The bytes with a number or a few bytes changed within `room` behind one of some marks, as headers have them."""
    data = bytearray(original)
    for _ in range(rng.choice((1, 1, 2))):
        places = _after(bytes(data), rng.choice(tuple(marks)))
        if not places:
            continue
        start = rng.choice(places)
        window = data[start : start + room]
        rng.choice((number, number, overwrite, flip, zero))(rng, window)
        data[start : start + room] = window
    return bytes(data)


def _after(data: bytes, mark: bytes) -> list[int]:
    found: list[int] = []
    start = data.find(mark)
    while start >= 0:
        found.append(start + len(mark))
        start = data.find(mark, start + 1)
    return found
