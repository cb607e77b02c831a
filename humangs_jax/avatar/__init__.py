"""Reconstruct, animate, light, frames, layers, videos; `export`: a table of formats."""
