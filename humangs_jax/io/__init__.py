"""Untrusted files: read within one set of limits, refused in one line; atomic writes."""
