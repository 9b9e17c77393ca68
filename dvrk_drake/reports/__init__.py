"""Results as people read them: tables in a terminal, figures, pages."""
