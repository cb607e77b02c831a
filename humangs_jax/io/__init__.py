"""Reads untrusted files within one set of limits, refuses bad files with an error of one line, and
writes files so that no unfinished one appears.
"""
