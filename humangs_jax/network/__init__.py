"""The network `humangs`, one module over exchangeable `parts`. Also presets, weights files, and
conversion.
"""
