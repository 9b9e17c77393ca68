"""Output of results as tables in a terminal, figures and pages."""
