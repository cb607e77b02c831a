"""Draws Gaussians and meshes. `splatting` is the API for Gaussians. It composes `projection`,
`tiling` and `compositing`. `reference` is a plain renderer to compare with. `mesh` has the
rasterizer, position maps and UV atlases.
"""
