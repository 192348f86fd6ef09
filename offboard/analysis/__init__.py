"""Reads logs: score, identification, and their pages."""
