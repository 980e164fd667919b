"""What makes an episode: drawn values, actions and their latency, and the reasons for which it ends."""

__all__: list[str] = []
