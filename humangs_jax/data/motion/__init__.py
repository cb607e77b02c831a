"""Motions: one body pose per frame, read from the files that people have. `load_motion` is the one door.

`motion`: what one is in memory. Readers (`data.formats.MOTIONS` is their table): `arrays`, by key; `bvh`, `gltf`, of skeletons
of other programs, which `skeleton` brings to our joints. `rules`: what all of them and the page know, as tables.
"""

from humangs_jax.data.motion.motion import Motion, MotionError, grounded, load_motion, save_motion
from humangs_jax.data.motion.rules import PELVIS, UPRIGHT

__all__ = ["PELVIS", "UPRIGHT", "Motion", "MotionError", "grounded", "load_motion", "save_motion"]
