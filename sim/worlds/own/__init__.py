"""Worlds of one's own: described by a YAML or MJCF file, or built by a `WorldBuilder` of the user's package."""

__all__: list[str] = []
