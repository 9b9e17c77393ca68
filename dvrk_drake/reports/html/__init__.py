"""HTML reports: the page builder, and one module per kind of result."""
