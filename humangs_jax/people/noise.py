"""Random choices; smooth random functions of position: plane waves (cheap, band-limited) and lattice noise (irregular)."""

from collections.abc import Mapping

import numpy as np


def choice(rng: np.random.Generator, odds: Mapping[str, float | int]) -> str:
    """One of the names, by its odds."""
    shares = np.asarray(list(odds.values()), float)
    return str(rng.choice(list(odds), p=shares / shares.sum()))


class Ripples:
    """A random band-limited function of points with features of a wavelength: a sum of plane waves, of unit amplitude or so."""

    def __init__(self, rng: np.random.Generator, wavelength: float, waves: int = 6):
        direction = rng.normal(size=(3, waves))
        direction /= np.linalg.norm(direction, axis=0)
        scale = 2 * np.pi / wavelength * rng.uniform(0.6, 1.5, waves)
        self.k = (direction * scale).astype(np.float32)
        self.phase = rng.uniform(0, 2 * np.pi, waves).astype(np.float32)
        self.amplitude = np.float32(np.sqrt(2 / waves) * 0.7)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """(n,) values at (n, 3) points."""
        return self.amplitude * np.sin(points.astype(np.float32) @ self.k + self.phase).sum(-1)


def ripples(rng: np.random.Generator, points: np.ndarray, wavelength: float) -> np.ndarray:
    """(n,) values of new `Ripples` at points (n, 3)."""
    return Ripples(rng, wavelength)(points)


class Folds:
    """Creases of cloth: ridges in a few directions, each in patches of its own. The same object is the same function always.

    upright: all of them run along y.
    """

    def __init__(self, rng: np.random.Generator, wavelength: float = 0.09, directions: int = 6, upright: bool = False):
        tilt = rng.uniform(*((1.25, 1.57) if upright else (0.5, 1.5)), directions)
        turn = rng.uniform(0, 2 * np.pi, directions)
        k = np.stack([np.sin(tilt) * np.cos(turn), np.cos(tilt), np.sin(tilt) * np.sin(turn)], -1)
        self.directions = k.astype(np.float32)
        self.k = (k * (2 * np.pi / wavelength * rng.uniform(0.6, 1.4, (directions, 1)))).astype(np.float32)
        self.phase = rng.uniform(0, 2 * np.pi, directions).astype(np.float32)
        self.warp = Ripples(rng, 3 * wavelength)
        self.patches = [Ripples(rng, 4 * wavelength) for _ in range(directions)]

    def slope(self, points: np.ndarray) -> np.ndarray:
        """(n, 3) slopes at (n, 3) points, about 1 on the flanks of a crease, 0 between patches."""
        points = points.astype(np.float32)
        total, warp = np.zeros_like(points), 3.0 * self.warp(points)
        for k, direction, phase, patch in zip(self.k, self.directions, self.phase, self.patches, strict=True):
            angle = points @ k + phase + warp
            crest = np.sin(angle)
            flank = np.cos(angle) * crest / np.sqrt(crest * crest + 0.15)  # of a ridge |sin| with a rounded top
            total += (np.clip(patch(points) - 0.3, 0, 1) * flank)[:, None] * direction
        return total


def lattice(points: np.ndarray, seed: int) -> np.ndarray:
    """(n,) value noise in [0, 1] of (n, d) points: random values on the integer lattice, blended smoothly; d = 1, 2 or 3."""
    base = np.floor(points)
    t = (points - base).astype(np.float32)
    t = t * t * (3 - 2 * t)
    cell = base.astype(np.int64)
    total = np.zeros(len(points), np.float32)
    for corner in range(1 << points.shape[1]):
        bits = [(corner >> axis) & 1 for axis in range(points.shape[1])]
        weight = np.float32(1)
        for axis, bit in enumerate(bits):
            weight = weight * (t[:, axis] if bit else 1 - t[:, axis])
        total += weight * hashed(cell + np.asarray(bits), seed)
    return total


def hashed(cells: np.ndarray, seed: int) -> np.ndarray:
    """(n,) uniform [0, 1) numbers of integer cells (n, d), the same for the same cell and seed."""
    primes = np.asarray([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], np.uint64)[: cells.shape[1]]
    mixed = (cells.astype(np.uint64) * primes).sum(-1, dtype=np.uint64) + np.uint64(seed * 0x27D4EB2F & 0xFFFFFFFF)
    mixed = (mixed ^ (mixed >> np.uint64(15))) * np.uint64(0x2C1B3C6D) & np.uint64(0xFFFFFFFF)
    mixed = (mixed ^ (mixed >> np.uint64(12))) * np.uint64(0x297A2D39) & np.uint64(0xFFFFFFFF)
    return ((mixed ^ (mixed >> np.uint64(15))) & np.uint64(0xFFFFFF)).astype(np.float32) / np.float32(1 << 24)
