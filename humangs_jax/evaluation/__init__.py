"""Protocols, cases, scores, the report."""
