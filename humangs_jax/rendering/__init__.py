"""`projection`, `tiling`, `compositing`, composed in `splatting`, the API; `reference` is the
oracle; `mesh`: rasterizer, position maps.
"""
