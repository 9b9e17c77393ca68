"""Public recordings of other projects, into our format."""
