"""`splatting`, the API, composes `projection`, `tiling` and `compositing`. `reference` is a plain
renderer to compare with. `mesh` has the rasterizer and position maps.
"""
