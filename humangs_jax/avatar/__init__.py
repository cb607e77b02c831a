"""Reconstruction, animation, light, frames, layers and videos of avatars. `export` has the table of
formats.
"""
