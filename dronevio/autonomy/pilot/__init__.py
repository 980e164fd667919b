"""The pilot: maps while it flies, chooses targets and paths, and decides the course."""

__all__: list[str] = []
