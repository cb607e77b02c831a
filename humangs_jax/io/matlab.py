"""MATLAB's files of version 5 to 7: arrays, strings, cells and structures of one variable.

scipy reads them, too, and dies of cells that are nested some thousand times. Here every value is read within the bytes of
the one that holds it. https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf
"""

import math
import os
import struct
import zlib
from typing import Any, NamedTuple

import numpy as np

from humangs_jax.io.reading import Refused, check_limit, check_unpacked, limits, open_file, reading

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""dtypes of data types; 16 (UTF-8) is text."""
CELL, STRUCT, CHAR = 1, 2, 4
CLASSES = {6: "f8", 7: "f4", 8: "i1", 9: "u1", 10: "i2", 11: "u2", 12: "i4", 13: "u4", 14: "i8", 15: "u8"}
COMPLEX = 0x0800
PIECE = 1 << 20


class Cells(NamedTuple):
    """A cell array: its values in MATLAB's order (the first index runs fastest)."""

    shape: tuple[int, ...]
    values: list[Any]


def read_matlab(path: str | os.PathLike, variable: str) -> Any:
    """The value of a variable: an array, a string, `Cells`, a list of dicts (structures), or None for what is not read.

    Raises: FileNotFoundError; FileError if the file is of another version, is damaged or has no such variable.
    """
    with reading(path, "MATLAB file"), open_file(path) as file:
        size = os.path.getsize(path)
        header = file.read(HEADER_BYTES)
        if header[:10] == b"MATLAB 7.3":
            raise Refused("MATLAB files of version 7.3 are not supported")
        if header[:10] != b"MATLAB 5.0" or header[126:128] != b"IM":
            raise Refused("expected a MATLAB file of version 5 with little-endian numbers")
        while tag := file.read(8):
            kind, count = struct.unpack("<II", tag)
            if count > size - file.tell():
                raise EOFError("cut off")
            if kind == COMPRESSED:
                content = _unpacked(file, count, size)
                kind, count = struct.unpack_from("<II", content)
                content = memoryview(content)[8 : 8 + count]
            else:
                content = memoryview(file.read(count))
                file.seek(-count % 8, os.SEEK_CUR)
            if kind == MATRIX:
                name, value = _Reader().matrix(content, variable)
                if name == variable:
                    return value
        raise Refused(f"no variable {variable!r}")


def _unpacked(file, count, size):
    """The bytes of a compressed variable, never more of them than the limits allow."""
    stream, pieces, total = zlib.decompressobj(), [], 0
    for start in range(0, count, PIECE):
        piece = file.read(min(PIECE, count - start))
        while piece:
            pieces.append(stream.decompress(piece, 16 * PIECE))
            piece = stream.unconsumed_tail
            total += len(pieces[-1])
            check_unpacked(size, total)
    return b"".join(pieces)


class _Reader:
    def __init__(self) -> None:
        self.matrices = 0

    def matrix(self, content: memoryview, wanted: str | None = None, depth: int = 0) -> tuple[str, Any]:
        """Name and value of a matrix element; the value is None if `wanted` is another name."""
        if not len(content):
            return "", np.zeros((0, 0))
        self.matrices += 1
        check_limit("members", self.matrices, "values")
        if depth > limits().nesting:
            raise Refused(f"nested too deeply, the limit nesting is {limits().nesting} (docs/security.md)")
        parts = _elements(content)
        flags, dimensions, name = (next(parts) for _ in range(3))
        word = struct.unpack("<I", flags[1][:4])[0]
        shape = tuple(np.frombuffer(dimensions[1], "<i4").tolist())
        name = bytes(name[1]).decode("latin1")
        if min(shape, default=0) < 0 or len(shape) > 32:
            raise Refused(f"{name}: shape {shape}")
        if wanted is not None and name != wanted:
            return name, None
        return name, self.value(word & 0xFF, word & COMPLEX, shape, parts, len(content), depth)

    def value(self, kind, is_complex, shape, parts, most, depth):
        count = math.prod(shape)
        if kind in (CELL, STRUCT) and count > most:
            raise Refused(f"{count:,} values in {most:,} bytes")
        if kind == CELL:
            return Cells(shape, [self.child(next(parts), depth) for _ in range(count)])
        if kind == STRUCT:
            length = struct.unpack("<i", next(parts)[1][:4])[0]
            names = bytes(next(parts)[1])
            if length < 1 or len(names) % length or len(names) // length * count > most:
                raise Refused("a structure with damaged names of fields")
            fields = [names[i : i + length].split(b"\0")[0].decode("latin1") for i in range(0, len(names), length)]
            return [{field: self.child(next(parts), depth) for field in fields} for _ in range(count)]
        if kind == CHAR:
            dtype, data = next(parts)
            return bytes(data).decode("utf-16-le" if dtype == 4 else "utf-8", "replace")
        if kind not in CLASSES or is_complex:
            return None
        dtype, data = next(parts)
        if dtype not in NUMBERS or len(data) != count * np.dtype(NUMBERS[dtype]).itemsize:
            raise Refused(f"shape {shape} does not fit {len(data):,} bytes")
        numbers = np.frombuffer(data, f"<{NUMBERS[dtype]}")
        check_limit("array_bytes", count * np.dtype(CLASSES[kind]).itemsize, "bytes of numbers")
        return numbers.astype(CLASSES[kind]).reshape(shape[::-1]).T

    def child(self, part, depth):
        kind, content = part
        if kind != MATRIX:
            raise Refused("a value that is no matrix")
        return self.matrix(content, None, depth + 1)[1]


def _elements(content: memoryview):
    """Type and bytes of each data element, one after the other."""
    at = 0
    while at + 8 <= len(content):
        kind, count = struct.unpack_from("<II", content, at)
        if kind >> 16:  # a small one, its bytes in the tag
            kind, count, start, step = kind & 0xFFFF, kind >> 16, at + 4, 8
        else:
            start, step = at + 8, 8 + count + -count % 8
        if start + count > len(content) or (step == 8 and count > 4):
            raise Refused("an element that is larger than what holds it")
        yield kind, content[start : start + count]
        at += step
    raise EOFError("cut off")
