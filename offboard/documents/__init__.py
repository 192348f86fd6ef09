"""Strict YAML documents: the shipped files, reading, validation, and errors as sentences."""
