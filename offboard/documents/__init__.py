"""Strict YAML documents: shipped files, reading and validation. Also the errors of all commands."""
