"""What `dvrk-drake demo` shows."""
