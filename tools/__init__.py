"""Maintainers' commands that build the files under ``cvthead/assets``; not installed."""
