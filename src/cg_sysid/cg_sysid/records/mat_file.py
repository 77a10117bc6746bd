"""Vectors of numbers in a MAT file, version 4 to 7.2, by the format's public description.

A library's decoder that trusts lengths and kinds ends the process at a changed byte. Here every
length is compared with what is there before it is used. What is no real vector is passed over:
scalars, matrices, text, cells, sparse and complex arrays, arrays of structs.
"""

import math
import struct
import zlib
from collections.abc import Iterator

import numpy as np

MOST = 400_000_000  # bytes of a file, and of what it unpacks to
DEEPEST = 40  # structs within each other
HEADER = 128  # bytes, from version 5 on

# Kinds of data elements.
NUMBERS = {
    1: 'i1',
    2: 'u1',
    3: 'i2',
    4: 'u2',
    5: 'i4',
    6: 'u4',
    7: 'f4',
    9: 'f8',
    12: 'i8',
    13: 'u8',
}
MATRIX, COMPRESSED = 14, 15
# Classes of arrays.
STRUCT, NUMERIC = 2, range(6, 16)
COMPLEX = 0x0800
NUMBERS_4 = ('f8', 'f4', 'i4', 'i2', 'u2', 'u1')


class MatError(ValueError):
    """No MAT file that can be read; the message says why, without the file's name."""


def vectors(data: bytes) -> dict[str, np.ndarray]:
    """Name -> values of every real vector, as floats; fields of structs are `struct.field`.

    Raises:
        MatError: This is no MAT file, it is damaged, too large, or of version 7.3.
    """
    if len(data) > MOST:
        raise MatError(f'larger than {MOST} bytes, the most that is read')
    if len(data) < 20:
        raise MatError('too short to be one')
    if 0 in data[:4]:
        return dict(_version_4(data))
    order = {b'IM': '<', b'MI': '>'}.get(data[126:128])
    if order is None:
        raise MatError('its head names no order of bytes')
    (version,) = struct.unpack(f'{order}H', data[124:126])
    if version >> 8 == 2:
        raise MatError('of version 7.3; save it again with -v7')
    if version >> 8 != 1:
        raise MatError('of no version that is known')
    return dict(_Reader(order).variables(data[HEADER:]))


class _Reader:
    """Of one file from version 5 on; keeps count of what was unpacked."""

    def __init__(self, order: str):
        self.order, self.left = order, MOST

    def variables(self, data: bytes) -> Iterator[tuple[str, np.ndarray]]:
        for kind, content in self.elements(data):
            if kind == COMPRESSED:
                unpacked = list(self.elements(self.unpacked(content)))
                if len(unpacked) != 1:
                    raise MatError('a packed element holds other than one array')
                ((kind, content),) = unpacked
            if kind == MATRIX:
                yield from self.array(content, None, 0)

    def unpacked(self, content: bytes) -> bytes:
        try:
            unpacker = zlib.decompressobj()
            unpacked = unpacker.decompress(content, self.left)
        except zlib.error:
            raise MatError('damaged: an element does not unpack') from None
        self.left -= len(unpacked)
        if self.left <= 0:
            raise MatError(f'it unpacks to more than {MOST} bytes, the most that is read')
        if not unpacker.eof:
            raise MatError('damaged: a packed element is cut off')
        return unpacked

    def elements(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Kind and content of the elements that follow each other."""
        at = 0
        while at < len(data):
            if at + 8 > len(data):
                raise MatError('damaged: cut off in the head of an element')
            kind, size = struct.unpack_from(f'{self.order}II', data, at)
            if kind >> 16:  # a small one lies in its own head
                size, kind = kind >> 16, kind & 0xFFFF
                start, following = at + 4, at + 8
                if size > 4:
                    raise MatError('damaged: a small element is too long')
            else:
                start = at + 8
                padding = 0 if kind == COMPRESSED else -size % 8
                following = start + size + padding
            if start + size > len(data):
                raise MatError('damaged: an element is longer than the file')
            yield kind, data[start : start + size]
            at = following

    def numbers(self, element: tuple[int, bytes]) -> np.ndarray:
        kind, content = element
        if kind not in NUMBERS:
            raise MatError('damaged: an element of numbers has another kind')
        form = np.dtype(self.order + NUMBERS[kind])
        if len(content) % form.itemsize:
            raise MatError('damaged: an element holds a part of a number')
        return np.frombuffer(content, form)

    def integers(self, element: tuple[int, bytes]) -> np.ndarray:
        """Sizes, flags and characters, which have no fractions."""
        found = self.numbers(element)
        if found.dtype.kind == 'f':
            raise MatError('damaged: a size, a flag or a name is a number with a fraction')
        return found

    def array(
        self, content: bytes, called: str | None, depth: int
    ) -> Iterator[tuple[str, np.ndarray]]:
        """The vectors in an array; `called` is the name of a field, which has none of its own."""
        if not content:
            return  # an empty field
        if depth > DEEPEST:
            raise MatError(f'structs are nested more than {DEEPEST} deep')
        parts = self.elements(content)
        flags, dimensions, named = (self.integers(self.next_of(parts)) for _ in range(3))
        if not len(flags) or len(dimensions) < 2 or (dimensions < 0).any():
            raise MatError('damaged: an array without class or dimensions')
        name = named.astype(np.uint8).tobytes().decode('latin-1') if called is None else called
        if not name or name.startswith('__') or not name.isprintable():
            return
        shape = [int(n) for n in dimensions]
        of = int(flags[0]) & 0xFF
        if of == STRUCT and math.prod(shape) == 1:
            yield from self.fields(name, parts, depth)
        elif of in NUMERIC and not int(flags[0]) & COMPLEX:
            yield from self.vector(name, shape, self.numbers(self.next_of(parts)))

    def fields(
        self, name: str, parts: Iterator[tuple[int, bytes]], depth: int
    ) -> Iterator[tuple[str, np.ndarray]]:
        width = self.integers(self.next_of(parts))
        _, names = self.next_of(parts)
        if len(width) != 1 or not 0 < width[0] <= 1024 or len(names) % width[0]:
            raise MatError('damaged: a struct whose fields have no names')
        length = int(width[0])
        for k in range(0, len(names), length):
            field = names[k : k + length].partition(b'\0')[0].decode('latin-1')
            kind, content = self.next_of(parts)
            if kind != MATRIX:
                raise MatError('damaged: a field of a struct is no array')
            yield from self.array(content, f'{name}.{field}', depth + 1)

    @staticmethod
    def vector(
        name: str, shape: list[int], values: np.ndarray
    ) -> Iterator[tuple[str, np.ndarray]]:
        if math.prod(shape) != len(values):
            raise MatError(f'damaged: {name!r} holds {len(values)} numbers for {shape}')
        if len(values) > 1 and max(shape) == len(values):
            yield name, values.astype(float)

    @staticmethod
    def next_of(parts: Iterator[tuple[int, bytes]]) -> tuple[int, bytes]:
        found = next(parts, None)
        if found is None:
            raise MatError('damaged: an array is cut off')
        return found


def _version_4(data: bytes) -> Iterator[tuple[str, np.ndarray]]:
    """Of the oldest format: matrices one after the other, each behind five numbers."""
    at = 0
    while at < len(data):
        if at + 20 > len(data):
            raise MatError('damaged: cut off in the head of a matrix')
        # The order of bytes is the one in which the first number makes sense.
        for order in '<>':
            kind, rows, columns, imaginary, length = struct.unpack_from(f'{order}5i', data, at)
            if 0 <= kind < 5000 and kind // 1000 == '<>'.index(order):
                break
        else:
            raise MatError('its head makes no sense')
        number, of = kind // 10 % 10, kind % 10
        if number >= len(NUMBERS_4) or of > 2 or min(rows, columns) < 0 or not 0 < length <= 256:
            raise MatError('its head makes no sense')
        form = np.dtype(order + NUMBERS_4[number])
        start = at + 20 + length
        stop = start + rows * columns * form.itemsize * (2 if imaginary else 1)
        if stop > len(data):
            raise MatError('damaged: a matrix is longer than the file')
        name = data[at + 20 : start].partition(b'\0')[0].decode('latin-1')
        values = np.frombuffer(data, form, rows * columns, start)
        if of == 0 and not imaginary and name.isprintable():
            yield from _Reader.vector(name, [rows, columns], values)
        at = stop
