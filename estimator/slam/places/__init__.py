"""Place recognition: features, a vocabulary and its index, and the verification of matches by geometry."""

__all__: list[str] = []
