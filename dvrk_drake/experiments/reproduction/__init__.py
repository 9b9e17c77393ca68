"""The paper's experiments redone; `reports.reproduction` sets them beside the published numbers."""
