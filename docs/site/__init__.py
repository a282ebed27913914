"""Assemble and build the documentation site."""
