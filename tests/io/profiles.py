"""Writes ICC profiles from their specification (ICC.1): Pillow makes none but sRGB."""

import struct

import numpy as np

D50 = (0.9642, 1.0, 0.8249)
ADOBE = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
P3 = ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06))
PROPHOTO_TO_XYZ = np.asarray(
    [[0.7976749, 0.1351917, 0.0313534], [0.2880402, 0.7118741, 0.0000857], [0, 0, 0.8252100]]
)
"""From ProPhoto RGB to XYZ of D50, which profiles have, too."""
P3_TO_XYZ = np.asarray(
    [[0.5151, 0.2920, 0.1571], [0.2412, 0.6922, 0.0666], [-0.0011, 0.0419, 0.7841]]
)
ADOBE_TO_XYZ = np.asarray(
    [[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]]
)
SRGB_TO_XYZ = np.asarray(
    [[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]]
)
"""From sRGB to XYZ, in the digits that the profiles of Apple and Adobe have."""


def numbers(*values):
    return struct.pack(f">{len(values)}i", *(round(65536 * each) for each in values))


def gamma(exponent):
    return b"curv" + bytes(4) + struct.pack(">IH", 1, round(256 * exponent)) + bytes(2)


def table(values):
    return (
        b"curv"
        + bytes(4)
        + struct.pack(">I", len(values))
        + np.rint(65535 * np.asarray(values)).astype(">u2").tobytes()
    )


def formula(kind, *values):
    return b"para" + bytes(4) + struct.pack(">HH", kind, 0) + numbers(*values)


SRGB_CURVE = formula(3, 2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def description(text):
    return b"desc" + bytes(4) + struct.pack(">I", len(text) + 1) + text.encode() + bytes(79)


def profile(tags, space=b"RGB ", kind=b"mntr", pcs=b"XYZ "):
    """Returns a version 2 profile with these tags by name."""
    tags = {b"desc": description("made up"), b"wtpt": b"XYZ " + bytes(4) + numbers(*D50), **tags}
    at, entries, body = 132 + 12 * len(tags), b"", b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        entries += name + struct.pack(">II", at + len(body), len(content))
        body += content
    size = at + len(body)
    head = (
        struct.pack(">I4xI", size, 0x02400000)
        + kind
        + space
        + pcs
        + bytes(12)
        + b"acsp"
        + bytes(28)
        + numbers(*D50)
    )
    return head.ljust(128, b"\0") + struct.pack(">I", len(tags)) + entries + body


def of_colors(to_xyz, curve, **options):
    """Returns a profile of one curve and three primaries, the columns of `to_xyz`."""
    columns = {
        name + b"XYZ": b"XYZ " + bytes(4) + numbers(*to_xyz[:, i])
        for i, name in enumerate((b"r", b"g", b"b"))
    }
    return profile(columns | {name + b"TRC": curve for name in (b"r", b"g", b"b")}, **options)


def of_grey(curve):
    return profile({b"kTRC": curve}, b"GRAY")


def of_tables(space, inputs, to_lab):
    """Returns a profile whose colors are a table (lut8) of Lab.

    `to_lab` is applied to the corners of the cube, the first channel slowest.
    """
    grid = np.stack(np.meshgrid(*[[0, 1]] * inputs, indexing="ij"), axis=-1).reshape(-1, inputs)
    lab = np.asarray([to_lab(*corner) for corner in grid])
    levels = np.rint(lab * [2.55, 1, 1] + [0, 128, 128]).clip(0, 255).astype(np.uint8)
    ramp = bytes(range(256))
    body = b"mft1" + bytes(4) + bytes([inputs, 3, 2, 0]) + numbers(1, 0, 0, 0, 1, 0, 0, 0, 1)
    return profile(
        {b"A2B0": body + ramp * inputs + levels.tobytes() + ramp * 3}, space, b"prtr", b"Lab "
    )
