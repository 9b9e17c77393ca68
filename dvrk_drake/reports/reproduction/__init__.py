"""The paper's figures and tables redone, as a page."""
