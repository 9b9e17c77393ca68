"""What runs inside a Drake Diagram; one LeafSystem a file."""
