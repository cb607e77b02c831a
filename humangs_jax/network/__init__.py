"""`humangs`, one module over exchangeable `parts`; presets, weights files, conversion."""
