"""Protocols, cases, scores, and the report."""
