"""Pictures of worlds and vehicles for people, and the texturedness that a camera sees."""

__all__: list[str] = []
