"""Settings on the command line: which of them are options, and how ``--set`` and ``--settings`` reach all of them."""

__all__: list[str] = []
