"""Evaluation: protocols, cases, scores, and the report."""
