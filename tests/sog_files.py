"""Writes `.sog` bundles from the published layout."""

import io
import json
import zipfile

import numpy as np
from PIL import Image

C0 = 0.5 / np.sqrt(np.pi)
LARGEST = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))


def pixels(rows, width=7):
    """Returns bytes (g, c) as a picture of that width."""
    height = -(-len(rows) // width)
    padded = np.zeros((height * width, rows.shape[1]), np.uint8)
    padded[: len(rows)] = rows
    return padded.reshape(height, width, rows.shape[1])


def encoded(picture, kind):
    stream = io.BytesIO()
    image = Image.fromarray(picture)
    image.save(stream, kind, **({"lossless": True, "exact": True} if kind == "WEBP" else {}))
    return stream.getvalue()


def nearest(values, codebook):
    return np.abs(np.asarray(values)[..., None] - codebook).argmin(axis=-1)


def sog_parts(gaussians, kind="WEBP"):
    """Returns (content of meta.json, pictures by name)."""
    g = gaussians
    logs = np.sign(g.means) * np.log1p(np.abs(np.asarray(g.means, np.float64)))
    low, high = logs.min(axis=0), logs.max(axis=0)
    words = np.rint((logs - low) / (high - low) * 65_535).astype(np.uint16)
    quats = np.asarray(g.quats, np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    place = np.abs(quats).argmax(axis=1)
    quats *= np.sign(quats[np.arange(len(quats)), place])[:, None]
    three = np.stack([q[list(LARGEST[p])] for q, p in zip(quats, place, strict=True)])
    packed = np.rint((three * np.sqrt(2) + 1) / 2 * 255)
    scales, dc = np.log(g.scales), (np.asarray(g.colors) - 0.5) / C0
    books = {
        "scales": np.linspace(scales.min(), scales.max(), 256),
        "sh0": np.linspace(dc.min(), dc.max(), 256),
    }
    opacity = np.rint(255 * np.asarray(g.opacities))[:, None]
    suffix = kind.lower()
    pictures = {
        f"means_l.{suffix}": pixels((words & 255).astype(np.uint8)),
        f"means_u.{suffix}": pixels((words >> 8).astype(np.uint8)),
        f"quats.{suffix}": pixels(np.column_stack([packed, 252 + place]).astype(np.uint8)),
        f"scales.{suffix}": pixels(nearest(scales, books["scales"]).astype(np.uint8)),
        f"sh0.{suffix}": pixels(
            np.concatenate([nearest(dc, books["sh0"]), opacity], axis=1).astype(np.uint8)
        ),
    }
    meta = {
        "version": 2,
        "count": len(words),
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": [f"means_l.{suffix}", f"means_u.{suffix}"],
        },
        "scales": {"codebook": books["scales"].tolist(), "files": [f"scales.{suffix}"]},
        "quats": {"files": [f"quats.{suffix}"]},
        "sh0": {"codebook": books["sh0"].tolist(), "files": [f"sh0.{suffix}"]},
    }
    if g.harmonics is not None:
        functions = g.harmonics.shape[1]
        book = np.linspace(float(g.harmonics.min()), float(g.harmonics.max()), 256)
        rows = np.zeros((-(-len(words) // 64) * 64, functions, 3), np.uint8)
        rows[: len(words)] = nearest(g.harmonics, book)[::-1]  # a row for each, from the last
        label = np.arange(len(words))[::-1]
        pictures |= {
            f"shN_centroids.{suffix}": rows.reshape(-1, 64 * functions, 3),
            f"shN_labels.{suffix}": pixels(
                np.stack([label & 255, label >> 8, 0 * label], axis=-1).astype(np.uint8)
            ),
        }
        meta["shN"] = {
            "count": len(words),
            "bands": {3: 1, 8: 2, 15: 3}[functions],
            "codebook": book.tolist(),
            "files": [f"shN_centroids.{suffix}", f"shN_labels.{suffix}"],
        }
    return meta, pictures


def write_sog(path, gaussians, kind="WEBP", change=None, folder=""):
    """Writes a bundle; `change` alters meta and pictures in place before."""
    meta, pictures = sog_parts(gaussians, kind)
    if change is not None:
        change(meta, pictures)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{folder}meta.json", json.dumps(meta))
        for name, picture in pictures.items():
            archive.writestr(f"{folder}{name}", encoded(picture, kind))
    return path
