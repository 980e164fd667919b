"""Estimators by name, the user's classes and other programs among them, and the loop that runs one on a recording."""

__all__: list[str] = []
