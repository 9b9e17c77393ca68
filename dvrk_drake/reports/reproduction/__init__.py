"""The paper's figures and tables redone, a module each, as sections of a page."""
