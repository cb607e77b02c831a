"""Avatars: reconstruction, animation, light, frames, layers and videos. `export` has the table of
formats.
"""
