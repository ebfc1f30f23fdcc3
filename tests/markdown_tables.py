"""Reads the tables of a Markdown text."""


def tables(markdown: str) -> list[list[list[str]]]:
    """Cells of every table, row by row, the rule below the head left out."""
    found: list[list[list[str]]] = [[]]
    for line in markdown.splitlines():
        if line.startswith("|"):
            found[-1].append([cell.strip() for cell in line.strip("|").split("|")])
        elif found[-1]:
            found.append([])
    return [[table[0], *table[2:]] for table in found if table]
