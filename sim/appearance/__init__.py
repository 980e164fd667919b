"""What surfaces look like: geometry, paint and light, laid out on textures."""

__all__: list[str] = []
