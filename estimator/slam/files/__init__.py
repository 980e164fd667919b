"""Files of maps: our own, which can be continued, and pose graphs in the g2o format."""

__all__: list[str] = []
