"""Systems for Drake Diagrams, one LeafSystem per file."""
