"""Pieces of Markdown that the report and the pages of recorded results are made of."""

from collections.abc import Iterable, Sequence


def table(head: Sequence[str], rows: Iterable[Sequence[str]], alignment: str) -> str:
    """A Markdown table; alignment has a letter a column, l or r."""
    rule = ["---:" if letter == "r" else "---" for letter in alignment]
    lines = [head, rule, *rows]
    return "\n".join(f"| {' | '.join(cell.replace('|', '¦') for cell in line)} |" for line in lines)
