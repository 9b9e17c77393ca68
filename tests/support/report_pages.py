"""Text of a page as a terminal shows it."""

from io import StringIO

from dvrk_drake.reports.terminal import TABLE_WIDTH, TableConsole, print_page


def printed(page, verbose=False, columns=TABLE_WIDTH):
    """Returns the text that a terminal shows of a page."""
    console = TableConsole(file=StringIO(), highlight=False, width=columns)
    print_page(console, page, verbose=verbose)
    return console.file.getvalue()
