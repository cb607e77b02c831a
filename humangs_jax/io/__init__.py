"""Files: reads untrusted files within one set of limits, refuses them in one line, and writes files
whole or not at all.
"""
