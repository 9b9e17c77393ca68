"""What an arm carries, from two recordings of the same motion."""
