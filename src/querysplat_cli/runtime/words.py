"""Words of messages that several parts of the program need."""


def counted(count: int, what: str) -> str:
    """A number of things, whose name takes an s in the plural."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"
