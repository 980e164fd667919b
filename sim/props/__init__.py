"""What worlds are furnished with."""

__all__: list[str] = []
