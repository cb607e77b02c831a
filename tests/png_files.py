"""Parts of PNG files, written by hand."""

import struct
import zlib


def chunk(name, data):
    """Returns a chunk of a PNG file: length, name (4 bytes), data and checksum."""
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
