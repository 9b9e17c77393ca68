"""What runs as a process of its own beside others, over LCM and by the wall clock."""
