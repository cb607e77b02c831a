"""Captures, network inputs, masks, and tables of the formats that are read. The packages are
`loading`, `datasets` and `preprocess`.
"""
