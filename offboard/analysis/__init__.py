"""Reads logs: score, identification, comparison, and their pages."""
