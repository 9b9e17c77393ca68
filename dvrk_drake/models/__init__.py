"""What an arm is, and what a recording of one is."""
