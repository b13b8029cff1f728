"""Comparison of results with references: the tables of the papers."""
