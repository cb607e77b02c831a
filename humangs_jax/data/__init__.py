"""Captures, network inputs, masks; tables of the formats that are read; `loading`, `datasets`,
`preprocess`.
"""
