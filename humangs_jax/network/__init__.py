"""The network: `humangs` is one module over exchangeable `parts`. Also presets, weights files, and
conversion.
"""
