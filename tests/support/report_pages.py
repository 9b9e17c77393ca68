"""Text of a page as a terminal shows it."""

from io import StringIO

from dvrk_drake.reports.terminal import TABLE_WIDTH, TableConsole, print_page


def printed(page, verbose=False):
    """Returns the text that a terminal of 80 columns shows of a page."""
    console = TableConsole(file=StringIO(), highlight=False, width=TABLE_WIDTH)
    print_page(console, page, verbose=verbose)
    return console.file.getvalue()
