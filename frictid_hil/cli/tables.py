"""Tables that a narrow terminal folds and never cuts."""

from __future__ import annotations

from collections.abc import Collection

from rich.table import Column, Table


def folding(*headings: str, whole: Collection[str] = (), title: str | None = None) -> Table:
    """A table for a person.

    Args:
        headings: of its columns; long text in them is folded.
        whole: headings of columns with names and numbers, which are narrowed last and not folded.
        title: above it.
    """
    columns = (Column(heading, overflow="fold", no_wrap=heading in whole) for heading in headings)
    return Table(*columns, title=title)
