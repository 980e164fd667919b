"""The visual front end: features detected, tracked and matched across the cameras of a rig."""

__all__: list[str] = []
