"""Objects of the worlds: furniture, machines, vegetation, vehicles and people."""

__all__: list[str] = []
