"""The case studies of NISME on the 68-bus network, judged."""

from holdfast.papers.rows import Row


def cases() -> list[Row]:
    """All rows of Section 7."""
    return []
